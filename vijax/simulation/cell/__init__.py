"""The state of a cell on its lane: its sums over impacts, the conditions that end it, and its program.

Begin with `cell`, then `cell_program`.
"""
