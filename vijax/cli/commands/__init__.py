"""The subcommands of `vijax`, one module each.

Begin with `sweep`.
"""
