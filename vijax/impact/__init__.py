"""Methods that simulate one impact: the flight to a wall, the contact there, and the state after it.

`exact` has the robust event-driven step, the reference for all others, and the sampled step. `fast` computes regular
impacts in straight-line arithmetic; impacts that it does not certify fall back to the sampled step, then to the exact
step. `taylor` integrates the motion under any excitation, `ode` and `rk4` step through time with any membrane law.
Begin with `impact`, then `exact/exact_step`.
"""
