"""What holds, in the folders of the package; `helpers` has what several of them need."""
