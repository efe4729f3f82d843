"""Optimisation of a device for harvested power.

Tuned quantities, surveys of devices (`survey`), gradient ascents on orbits, ensembles for aperiodic motion
(`aperiodic`), tolerances and the surroundings of an optimum (`robustness`), and the report. Begin with `optimise`, then
`design_search`.
"""
