"""The device that harvests most.

What may vary, where ascents begin, the ascent, tolerances, what lies around an optimum, and the report on it. Begin
with `optimise`.
"""
