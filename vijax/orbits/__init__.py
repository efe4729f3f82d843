"""Periodic orbits, stable or unstable: search, Floquet multipliers, verification, steady states.

Orbits are computed by multiple shooting with Newton's method. `steady` returns the steady state on an orbit, with
derivatives. Begin with `periodic`, then `orbit_search`.
"""
