"""Scripts: one file for each subcommand of `vijax`; `paper` draws the figures of the paper and checks its claims."""
