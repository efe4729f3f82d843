"""Computation of the contents of each panel, and the texts that show the results.

Begin with `motion`.
"""
