"""The device and its closed forms.

The harvester in SI units, the nondimensional pair, flight and contact, the energy of an impact, walls (`walls`),
forcing (`forcing`), and the labels of attractors. Begin with `pair`, then `flow`.
"""
