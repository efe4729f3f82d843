"""Dense output of a solver step, and roots on it.

The dense output is the quintic in theta = s/h, 0 <= theta <= 1, through position, velocity and acceleration at both
ends of a step of length h.
"""

import equinox as eqx
import jax.numpy as jnp

from vijax.runtime.arrays import Scalar
from vijax.runtime.compilation.xla import materialise

_ROUNDS = 5  # Iterations for a root. If they do not reach a crossing, a shorter step locates it again.


class SolverState(eqx.Module):
    """State of the solver: u and u' in flight, w and w' in contact; optionally the work and the tangent map."""

    x: Scalar
    z: Scalar
    work: Scalar | None = None
    tangent: tuple[Scalar, ...] | None = None  # row by row


class DenseOutput(eqx.Module):
    """Dense output of a step at theta in [0, 1]: the quintic through position, velocity and acceleration at both ends.

    The accelerations need no additional work, because the equation of motion is of second order. The quintic has a
    higher order than diffrax's own interpolants.
    """

    c0: Scalar
    c1: Scalar
    c2: Scalar
    c3: Scalar
    c4: Scalar
    c5: Scalar

    def position(self, s: Scalar) -> Scalar:
        """Return the position at theta = s."""
        return self.c0 + s * (self.c1 + s * (self.c2 + s * (self.c3 + s * (self.c4 + s * self.c5))))

    def slope(self, s: Scalar) -> Scalar:
        """Return the first derivative of the position by theta."""
        return self.c1 + s * (2 * self.c2 + s * (3 * self.c3 + s * (4 * self.c4 + s * (5 * self.c5))))

    def curvature(self, s: Scalar) -> Scalar:
        """Return the second derivative of the position by theta."""
        return 2 * self.c2 + s * (6 * self.c3 + s * (12 * self.c4 + s * (20 * self.c5)))

    def third_derivative(self, s: Scalar) -> Scalar:
        """Return the third derivative of the position by theta."""
        return 6 * self.c3 + s * (24 * self.c4 + s * (60 * self.c5))


def dense_output(h: Scalar, y0: SolverState, f0: SolverState, y1: SolverState, f1: SolverState) -> DenseOutput:
    """Return the dense output of a step of length h from states (y0, y1) and time derivatives (f0, f1) at its ends."""
    # Derivatives by theta: a factor h for each order. The three coefficients of highest degree remove the misfit in
    # position, velocity and acceleration that a parabola from the start leaves at the end.
    z, a = y0.z * h, f0.z * h * h
    rise, gain, change = y1.x - y0.x - z - 0.5 * a, y1.z * h - z - a, f1.z * h * h - a
    return DenseOutput(
        y0.x,
        z,
        0.5 * a,
        10 * rise - 4 * gain + 0.5 * change,
        -15 * rise + 7 * gain - change,
        6 * rise - 3 * gain + 0.5 * change,
    )


def increasing_root(function, low: Scalar, high: Scalar) -> Scalar:
    """Return the root of a rising function in [low, high] by Newton's method inside a bracket.

    A Newton step that leaves the bracket is replaced by a bisection.

    `function(x)` returns value and slope. The number of iterations is fixed, so that lanes do not wait for one another.
    """
    x = 0.5 * (low + high)
    for _ in range(_ROUNDS):
        value, slope = function(x)
        low, high = jnp.where(value <= 0, x, low), jnp.where(value > 0, x, high)
        # A slope that is not positive gives no Newton step; `inside` then selects the bisection.
        newton = x - value / jnp.where(slope > 0, slope, jnp.inf)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        x = materialise(jnp.where(inside, newton, 0.5 * (low + high)))
    return x
