"""Survey of the motions of many devices, as starts of ascents.

Begin with `device_survey`.
"""
