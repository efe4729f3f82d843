"""The command `vijax`, to whose pages the scripts are doors.

A page for each subcommand: its options in sections, what is checked before anything runs, the run under a progress
bar, the closing lines. Begin with `sweep`; `main` finds the pages.
"""
