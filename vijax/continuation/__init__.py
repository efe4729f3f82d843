"""Branches of periodic orbits along a parameter, and curves of bifurcations in two parameters.

Pseudo-arclength continuation passes folds and, at soft walls, grazings. `arclength_step` is one step, `branch_events`
locates special points, `branch_switching` starts new branches, `grazing_switch` continues past a grazing. `curves`
follows bifurcations in two parameters, `from_map` starts them from a map. Begin with `branch_continuation`, then
`path_following`.
"""
