"""One impact: fly, touch, leave.

Begin with `exact`, the careful step that the others are measured by: `quick` does the regular impact in straight
lines, `sampled` what that declines, `ode` and `rk4` step through time, `driven` goes from sample to sample
of any excitation.
"""
