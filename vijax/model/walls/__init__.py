"""Walls: membrane laws, the damping calibrated by restitution, and values that differ between the walls.

Begin with `membrane`, then `sides`.
"""
