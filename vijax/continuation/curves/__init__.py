"""Curves of bifurcations in a plane of two parameters, with their points of codimension 2.

Begin with `curves`, then `curve_equations`.
"""
