"""Criticality of a flip: the sign of a cubic coefficient decides whether stable or unstable doubled orbits begin there.

The coefficient is computed from the multiple-shooting equations, without a return map.
Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import ImpactUnknowns, Sequence
from vijax.runtime.numerics import ring_solve
from vijax.runtime.numerics.ring_solve import BlockRing


def cubic_coefficient(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> Float[Array, ""]:
    """Compute b of the normal form x -> -x + b x^3 at an orbit with a multiplier of -1.

    With b > 0 the orbit at the bifurcation attracts, and stable orbits of twice the period begin there (at a pitchfork,
    a stable mirror pair); with b < 0 unstable ones begin there. The magnitude of b depends on the scale of x; its sign
    does not.

    The equations of one period are F(period, next period) = 0. Insert two successive periods

        x + e q + e^2 h,  x - e q + e^2 h

    with q the null vector of F at the multiplier -1. The second order in e determines h. The third order leaves a
    residual along the left null vector p, which the term x^3 compensates:

        b = -p F_3 / (p F_next q).

    Bordered by the column F_next q, the singular matrix of the equations for q becomes regular. The quotient is the
    unknown of that column in the solution for the right side F_3, so that p is not needed.
    Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45), written for equations in place of a map.
    """
    shape, jacobian = impact_unknowns.shape, shooting.linearise(pair, sequence, impact_unknowns).ring

    def residual(period: ImpactUnknowns, next_period: ImpactUnknowns) -> Float[Array, "impact 3"]:
        return shooting.residuals(pair, sequence, period, next_period).reshape(shape)

    def next_period_derivative(q: ImpactUnknowns) -> Float[Array, "impact 3"]:
        return jax.jvp(lambda next_period: residual(impact_unknowns, next_period), (impact_unknowns,), (q,))[1]

    def displaced_residual(h: ImpactUnknowns) -> Callable[[Float[Array, ""]], Float[Array, "impact 3"]]:
        return lambda e: residual(impact_unknowns + e * q + e * e * h, impact_unknowns - e * q + e * e * h)

    # The next period is displaced in the opposite direction, so that the blocks which close the ring change sign.
    flip_jacobian = jacobian._replace(
        next_block=jnp.where(jacobian.is_closing[:, None, None], -jacobian.next_block, jacobian.next_block)
    )
    zero, unit = jnp.zeros_like(impact_unknowns), jnp.ones((1, 1), impact_unknowns.dtype)
    # Any row and column make a singular matrix of rank n - 1 regular, unless they are orthogonal to its null vectors. A
    # second solution, bordered by the approximate null vectors, is better conditioned.
    guess = jnp.where(sequence.real[:, None], jnp.cos(jnp.arange(impact_unknowns.size)).reshape(shape), 0.0)
    q = _unit(_bordered(flip_jacobian, guess, guess, zero, unit)[0])
    q = _unit(_bordered(flip_jacobian, next_period_derivative(q), q, zero, unit)[0])
    # Second order: F_x h + F_2/2 = 0, where F_2 is the second derivative along +-q. No multiplier is +1 here, so that
    # F_x, the matrix of one closed period, is regular.
    second_order = _derivative(displaced_residual(zero), 2)
    h, _ = ring_solve.solve(jacobian, -0.5 * second_order[..., None], jnp.zeros((0, 1), impact_unknowns.dtype))
    _, coefficient = _bordered(
        flip_jacobian, next_period_derivative(q), q, _derivative(displaced_residual(h[..., 0]), 3) / 6, 0 * unit
    )
    return -coefficient


def _derivative(function: Callable, order: int) -> Float[Array, "impact 3"]:
    """Compute the derivative of the given order of a function at zero."""
    for _ in range(order):
        function = _first_derivative(function)
    return function(jnp.zeros(()))


def _first_derivative(function: Callable) -> Callable:
    return lambda e: jax.jvp(function, (e,), (jnp.ones_like(e),))[1]


def _bordered(
    ring: BlockRing, column: ImpactUnknowns, row: ImpactUnknowns, right: ImpactUnknowns, bottom: Float[Array, "1 1"]
) -> tuple[ImpactUnknowns, Float[Array, ""]]:
    """Solve equations with one more unknown, given by its column, and one more equation, given by its row."""
    corner = jnp.zeros((1, 1), column.dtype)
    bordered_ring = ring._replace(border_columns=column[..., None], border_rows=row[None], border_corner=corner)
    solution, border_solution = ring_solve.solve(bordered_ring, right[..., None], bottom)
    return solution[..., 0], border_solution[0, 0]


def _unit(q: ImpactUnknowns) -> ImpactUnknowns:
    return q / jnp.linalg.norm(q)
