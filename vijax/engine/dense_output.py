"""A solver step between its ends: the dense output, and roots on it."""

import equinox as eqx
import jax.numpy as jnp

from vijax.runtime.arrays import Scalar
from vijax.runtime.xla import share

_ROUNDS = 5  # a root takes so many; a crossing that they miss is located again, on a shorter step


class SolverState(eqx.Module):
    """A state of the solver: u and u' in flight, w and w' in contact; where asked for, the work and the tangent map."""

    x: Scalar
    z: Scalar
    work: Scalar | None = None
    tangent: tuple[Scalar, ...] | None = None  # row by row


class Dense(eqx.Module):
    """Dense output of a step at theta in [0, 1]: the quintic through position, velocity and acceleration at both ends.

    A second-order equation gives it for nothing, and it is of higher order than diffrax's own interpolants.
    """

    c0: Scalar
    c1: Scalar
    c2: Scalar
    c3: Scalar
    c4: Scalar
    c5: Scalar

    def place(self, s: Scalar) -> Scalar:
        """Compute the position."""
        return self.c0 + s * (self.c1 + s * (self.c2 + s * (self.c3 + s * (self.c4 + s * self.c5))))

    def rate(self, s: Scalar) -> Scalar:
        """Differentiate the position by theta."""
        return self.c1 + s * (2 * self.c2 + s * (3 * self.c3 + s * (4 * self.c4 + s * (5 * self.c5))))

    def bend(self, s: Scalar) -> Scalar:
        """Differentiate it twice."""
        return 2 * self.c2 + s * (6 * self.c3 + s * (12 * self.c4 + s * (20 * self.c5)))

    def jerk(self, s: Scalar) -> Scalar:
        """Differentiate it three times."""
        return 6 * self.c3 + s * (24 * self.c4 + s * (60 * self.c5))


def dense_output(h: Scalar, y0: SolverState, f0: SolverState, y1: SolverState, f1: SolverState) -> Dense:
    """Make the dense output of a step of length h from the states at its ends and their derivatives."""
    z, a = y0.z * h, f0.z * h * h
    rise, gain, change = y1.x - y0.x - z - 0.5 * a, y1.z * h - z - a, f1.z * h * h - a
    return Dense(
        y0.x,
        z,
        0.5 * a,
        10 * rise - 4 * gain + 0.5 * change,
        -15 * rise + 7 * gain - change,
        6 * rise - 3 * gain + 0.5 * change,
    )


def root(function, low: Scalar, high: Scalar) -> Scalar:
    """Find the root of a rising function in [low, high], by Newton with bisection where that leaves the bracket."""
    x = 0.5 * (low + high)
    for _ in range(_ROUNDS):
        value, slope = function(x)
        low, high = jnp.where(value <= 0, x, low), jnp.where(value > 0, x, high)
        newton = x - value / jnp.where(slope > 0, slope, jnp.inf)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        x = share(jnp.where(inside, newton, 0.5 * (low + high)))
    return x
