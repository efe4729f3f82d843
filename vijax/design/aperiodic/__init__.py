"""Averages of aperiodic motion and their ascent, by ensembles of samples and response surfaces.

Begin with `average`, then `aperiodic_search`.
"""
