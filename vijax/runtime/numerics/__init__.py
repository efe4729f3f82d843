"""Numerical methods without physics: derivatives at concrete numbers, small linear systems, low-discrepancy points.

Begin with `derivatives`.
"""
