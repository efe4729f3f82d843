"""The methods that integrate a cell, and the numbers each one is told."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from vijax.membrane import Law
from vijax.model import Impact, Real, State

SOLVERS = ("Bosh3", "Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno4", "Kvaerno5")
METHODS = ("exact", "ode", "rk4")


class Passage(eqx.Module):
    """A finished impact of a stepping engine: from the exit of the last contact to the exit of this one.

    Attributes:
        impact: The impact.
        flight: Time from the last exit (or the start) to the onset.
        after: The ball as it leaves.
        tangent: Tangent map of the whole, row by row, saltations included; None where nobody asked for it.
    """

    impact: Impact
    flight: Float[Array, "..."]
    after: State
    tangent: tuple[Any, ...] | None


class Ode(eqx.Module):
    """An adaptive Runge-Kutta method of diffrax with located events.

    Attributes:
        solver: One of `SOLVERS`.
        rtol, atol: Tolerances of position and velocity, step by step.
        law: The membrane.
        dt: A constant step instead, for measuring orders of convergence.
    """

    solver: str = eqx.field(static=True)
    rtol: Real
    atol: Real
    law: Law
    dt: float | None = eqx.field(static=True, default=None)


class Rk4(eqx.Module):
    """The paper's method: classical Runge-Kutta steps of constant length, no event located.

    Attributes:
        steps: Steps per forcing period.
        law: The membrane.
    """

    steps: Real
    law: Law


Method = Ode | Rk4
