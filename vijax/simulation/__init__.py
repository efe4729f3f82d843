"""Batch simulation of many cells in one compiled program.

Lanes and their schedulers (`scheduler`), the state of a cell and its sums (`cell`), the search for its attractor
(`attractor`), the summary of a cell, and trajectories, impact by impact. Begin with `simulate`, then
`scheduler/lane_scheduler`.
"""
