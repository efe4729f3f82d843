"""Labelled maps over axes of parameters, in memory or on disk.

Sweeps and their refinement, basins, orbit diagrams, comparisons; tiles computed on all devices or on a cluster
(`execution`); and the tiled store from which an interrupted run continues (`storage`). Begin with `sweep`.
"""
