"""Curves of bifurcations that explain the borders between the labels of a map.

Begin with `map_curves`.
"""
