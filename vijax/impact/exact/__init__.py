"""The exact event-driven step and the sampled step: searches that cannot miss a wall crossing.

Begin with `exact_step`, then `sampled_step`.
"""
