"""Search for the attractor of a cell: recurrence of the motion, then Newton rounds that confirm its orbit.

Begin with `attractor_search`.
"""
