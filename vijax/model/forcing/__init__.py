"""Forcing of the capsule: harmonics, records and noise, and the closed-form motion under harmonics.

Begin with `excitation`, then `waves`.
"""
