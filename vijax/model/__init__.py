"""The device and its closed forms.

The harvester in SI units, the nondimensional pair, flight and contact, the energy of an impact, the names of
attractors. Begin with `pair`, then `flow`.
"""
