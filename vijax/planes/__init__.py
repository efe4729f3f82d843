"""From axes to labelled maps, in memory or on disk.

Sweeps and their refinement, basins, orbit diagrams, comparisons, and the tiled store with which a killed run goes
on. Begin with `sweep`.
"""
