"""Periodic orbits, stable or not.

They are found by shooting, followed along a parameter through folds and at soft walls through grazes, and
differentiated as steady states. Begin with `periodic` and `orbit_search`, then `continuation`: a step is
`arclength_step`, what a branch meets `events`, what is beyond a graze `soft_graze`, where others begin `switching`;
curves of bifurcations in two parameters are `curves`, those over a map `map_curves`.
"""
