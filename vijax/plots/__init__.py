"""Pictures of maps, orbit diagrams, branches and designs: the only folder that imports matplotlib.

`style` knows before a run what can be drawn, and loads none of it. Begin with `maps`.
"""
