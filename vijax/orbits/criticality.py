"""On which side of a flip the doubled orbit lies: the cubic coefficient of its normal form, by multiple shooting."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import Knots, Sequence
from vijax.runtime import ring_solve
from vijax.runtime.ring_solve import Ring


def cubic_coefficient(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Float[Array, ""]:
    """Compute b of the normal form x -> -x + b x^3 at an orbit with a multiplier of -1.

    With b > 0 the orbit at the bifurcation attracts, and stable orbits of twice the period (pitchfork: a stable mirror
    pair) begin there; with b < 0 unstable ones. Its size depends on how x is measured, its zero does not.

    Two turns x + e q + e^2 h, x - e q + e^2 h are put into the equations F(turn, next turn) of one. To the second order
    that gives h. To the third, what is left along the left null vector p is what x^3 has to make up for:
    b = -p F_3 / (p F_next q). Bordered by the column F_next q the equations of q are regular, and what they give that
    column for F_3 is that quotient, so that p need not be known.
    Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45), written for equations in place of a map.
    """
    shape, whole = knots.shape, shooting.linearise(pair, sequence, knots).ring

    def turn(here: Knots, after: Knots) -> Float[Array, "impact 3"]:
        return shooting.gap(pair, sequence, here, after).reshape(shape)

    def onward(q: Knots) -> Float[Array, "impact 3"]:
        return jax.jvp(lambda after: turn(knots, after), (knots,), (q,))[1]

    def leaning(h: Knots) -> Callable[[Float[Array, ""]], Float[Array, "impact 3"]]:
        return lambda e: turn(knots + e * q + e * e * h, knots - e * q + e * e * h)

    # The next turn leans the other way.
    opposite = whole._replace(there=jnp.where(whole.closes[:, None, None], -whole.there, whole.there))
    none, one = jnp.zeros_like(knots), jnp.ones((1, 1), knots.dtype)
    # Any row and column border a singular matrix to a regular one, unless orthogonal to its null vectors; then those
    # that were found do it better.
    begin = jnp.where(sequence.real[:, None], jnp.cos(jnp.arange(knots.size)).reshape(shape), 0.0)
    q = _unit(_bordered(opposite, begin, begin, none, one)[0])
    q = _unit(_bordered(opposite, onward(q), q, none, one)[0])
    second = _derivative(leaning(none), 2)
    h, _ = ring_solve.solve(whole, -0.5 * second[..., None], jnp.zeros((0, 1), knots.dtype))
    _, left = _bordered(opposite, onward(q), q, _derivative(leaning(h[..., 0]), 3) / 6, 0 * one)
    return -left


def _derivative(of: Callable, order: int) -> Float[Array, "impact 3"]:
    """Compute the derivative of an order at zero."""
    for _ in range(order):
        of = _once(of)
    return of(jnp.zeros(()))


def _once(of: Callable) -> Callable:
    return lambda e: jax.jvp(of, (e,), (jnp.ones_like(e),))[1]


def _bordered(
    ring: Ring, column: Knots, row: Knots, right: Knots, bottom: Float[Array, "1 1"]
) -> tuple[Knots, Float[Array, ""]]:
    """Solve equations with one unknown more, by its column, and one equation more, by its row."""
    none = jnp.zeros((1, 1), column.dtype)
    wide = ring._replace(beside=column[..., None], below=row[None], corner=none)
    found, more = ring_solve.solve(wide, right[..., None], bottom)
    return found[..., 0], more[0, 0]


def _unit(q: Knots) -> Knots:
    return q / jnp.linalg.norm(q)
