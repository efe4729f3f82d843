"""On which side of a flip the doubled orbit lies: the cubic coefficient of its normal form, by multiple shooting."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import Knots, Sequence
from vijax.runtime import linear_solve


def cubic_coefficient(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Float[Array, ""]:
    """Compute b of the normal form x -> -x + b x^3 at an orbit with a multiplier of -1.

    With b > 0 the orbit at the bifurcation attracts, and stable orbits of twice the period (pitchfork: a stable mirror
    pair) begin there; with b < 0 unstable ones. Its size depends on how x is measured, its zero does not.

    Two turns x + e q + e^2 h, x - e q + e^2 h are put into the equations F(turn, next turn) of one. To the second order
    that gives h. To the third, what is left along the left null vector p is what x^3 has to make up for:
    b = -p F_3 / (p F_next q).
    Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45), written for equations in place of a map.
    """
    shape = knots.shape

    def turn(here: Float[Array, "n"], after: Float[Array, "n"]) -> Float[Array, "3*impact"]:
        return shooting.gap(pair, sequence, here.reshape(shape), after.reshape(shape))

    x = knots.reshape(-1)
    onward = jax.jacfwd(lambda after: turn(x, after))(x)
    whole = shooting.linearise(pair, sequence, knots).slope
    p, q = _null_vectors(whole - 2 * onward)

    def leaning(h: Float[Array, "n"]) -> Callable[[Float[Array, ""]], Float[Array, "3*impact"]]:
        return lambda e: turn(x + e * q + e * e * h, x - e * q + e * e * h)

    h = linear_solve.solve(whole, -0.5 * _derivative(leaning(jnp.zeros_like(x)), 2))
    third = _derivative(leaning(h), 3) / 6
    return -(p @ third) / (p @ (onward @ q))


def _derivative(of: Callable, order: int) -> Float[Array, "n"]:
    """Compute the derivative of an order at zero."""
    for _ in range(order):
        of = _once(of)
    return of(jnp.zeros(()))


def _once(of: Callable) -> Callable:
    return lambda e: jax.jvp(of, (e,), (jnp.ones_like(e),))[1]


def _null_vectors(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Find the left and the right null vector of a matrix that has one each, of length 1.

    Bordered by a row and a column the matrix is regular, unless these happen to be orthogonal to what is sought. So
    they are any at first, and then what was found.
    """
    size = matrix.shape[0]
    left = right = jnp.cos(jnp.arange(size, dtype=matrix.dtype))
    for _ in range(2):
        left, right = _bordered(matrix.T, right, left), _bordered(matrix, left, right)
    return left, right


def _bordered(matrix: Float[Array, "n n"], column, row) -> Float[Array, "n"]:
    wide = jnp.block([[matrix, column[:, None]], [row[None], jnp.zeros((1, 1), matrix.dtype)]])
    found = linear_solve.solve(wide, jnp.zeros_like(wide[0]).at[-1].set(1.0))[:-1]
    return found / jnp.linalg.norm(found)
