"""Execution of a map: its starts, the division into calls, their distribution over devices or a cluster, and estimates.

Begin with `dispatch`.
"""
