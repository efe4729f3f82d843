"""Literal types of the words that arguments may take: walls, methods, precision, objectives.

Each set of words is defined once, here. This module does not import JAX, so that help and completion of the command are
fast. The modules that act on a word document its meaning.
"""

from typing import Literal

# "rigid_left" and "rigid_right" make one wall rigid; the other is a soft membrane.
Walls = Literal["soft", "rigid", "rigid_left", "rigid_right"]
Until = Literal["attractor", "window"]
MethodName = Literal["exact", "ode", "rk4"]
# Runge-Kutta methods of diffrax that method="ode" accepts.
SolverName = Literal["Bosh3", "Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno4", "Kvaerno5"]
Precision = Literal["float64", "float32"]
Direction = Literal["down", "up", "both"]
Objective = Literal["P", "power", "speed", "mean", "worst", "expected"]
Motion = Literal["any", "periodic"]
Periods = int | Literal["all"]
"""Number of forcing periods of a run; "all" selects every whole period of a record that ends."""
