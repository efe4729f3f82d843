"""Motion under any excitation by certified Taylor steps, without a step size to choose.

Begin with `driven`.
"""
