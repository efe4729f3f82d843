"""Fit of a device to impact times measured on a test bench.

`fit` is the public function. `interval` computes the motion between two impacts, `time_equations` the equations between
the times, `adjustment`, `assignment` and `least_squares` the least squares, `evaluation` the resulting record.
"""
