"""Options that subcommands share: their types, their sections of help, and checks of output files.

Begin with `options`.
"""
