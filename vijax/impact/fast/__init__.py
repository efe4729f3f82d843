"""The fast step: one flight and one contact in straight-line arithmetic, certified or rejected.

Begin with `fast_step`.
"""
