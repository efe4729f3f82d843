"""Doors to the command `vijax`, one file each, and `paper`, which draws the paper's figures and checks its claims."""
