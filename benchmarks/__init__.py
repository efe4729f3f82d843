"""Benchmarks of vijax's speed, accuracy and robustness: every file answers one question, and runs on its own.

`yardstick` holds references in many digits, `peers` and `naive` alternative implementations, `charts` the pictures.
"""
