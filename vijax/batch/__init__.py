"""Many cells or balls in one compiled program.

Lanes that take the next cell, what a cell has seen, when its motion recurs, what is kept of it; chains of cells;
motions impact by impact. Begin with `simulate`, then `lanes`.
"""
