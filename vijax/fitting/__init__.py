"""A device from the impacts that a bench has measured.

What lies between two impacts, how well a series of impacts hangs together, the least squares, and what they tell.
Begin with `fit`.
"""
