"""The paper once more: its figures 3 to 16, and its claims beside ours.

`captions` says what every figure shows, `__main__` is the command. Begin with `figures`.
"""
