"""Periodic orbits, stable or not.

They are found by shooting, followed along a parameter through folds up to grazing, and differentiated as steady
states. Begin with `periodic`, then `continuation`.
"""
