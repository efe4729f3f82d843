"""Performance of a design away from its nominal values: tolerances, surroundings, and limits.

Begin with `surroundings`, then `tolerance`.
"""
