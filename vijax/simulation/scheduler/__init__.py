"""Schedulers that run many cells on a fixed number of lanes, on CPU cores or on an accelerator.

Begin with `lane_scheduler`, then `lane_rounds`.
"""
