"""Reproduction of the paper: its figures 3 to 16, and its claims beside the results of vijax.

`captions` describes every figure, `__main__` is the command. Begin with `figures`.
"""
