"""The command `vijax`.

Every module of `commands` is a subcommand: it checks the arguments, runs under a progress bar and prints the closing
lines. `options` has the options that subcommands share. Begin with `commands/sweep`; `main` imports the subcommands.
"""
