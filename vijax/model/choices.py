"""The words that arguments choose among, each set of them once.

Nothing here loads JAX, so that help and completion of the command can tell the words at once. What a word means is
known to the room that acts on it.
"""

from typing import Literal

Walls = Literal["soft", "rigid", "rigid_left", "rigid_right"]
Until = Literal["attractor", "window"]
MethodName = Literal["exact", "ode", "rk4"]
SolverName = Literal["Bosh3", "Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno4", "Kvaerno5"]
Precision = Literal["float64", "float32"]
Direction = Literal["down", "up", "both"]
Objective = Literal["P", "power", "speed", "mean", "worst", "expected"]
Motion = Literal["any", "periodic"]
Periods = int | Literal["all"]
"""Forcing periods of a run; "all" are those of a record that ends."""
