"""A branch of periodic orbits as a curve in the space of knots and one parameter, and one step along it.

The orbit's equations go on through grazing into orbits that are none (`shooting`). What makes an orbit real, and what
marks a bifurcation, are smooth functions along the curve: its test functions.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import grazing, shooting
from vijax.orbits.parameter import Values, moved
from vijax.orbits.shooting import Sequence
from vijax.runtime import linear_solve, tiles
from vijax.runtime.programs import jitted

_BATCHES = (8, 64, 512)  # lanes of one compiled call


class Tests(NamedTuple):
    """Functions whose sign changes mark what happens on a branch; those from `speed` on are positive on real orbits."""

    fold: Float[Array, ""]  # the parameter's share of the tangent
    plus: Float[Array, ""]  # det(M - 1): a multiplier passes +1
    minus: Float[Array, ""]  # det(M + 1): a multiplier passes -1
    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall, over that into it: the ball stays
    low: Float[Array, ""]
    high: Float[Array, ""]


FOLD, PLUS = Tests._fields.index("fold"), Tests._fields.index("plus")
FIRST_END = Tests._fields.index("speed")


class Arc(eqx.Module):
    """What a lane follows: the orbit's parameters where it began, its walls, and which parameter moves.

    Attributes:
        start: The parameter where the orbit began.
        steepest: g/A of the device, gamma of a vertical tube (along="beta" only).
        low, high: Bounds of the parameter; their distance is the unit of its share of the arclength.
        along: Which parameter moves.
        newton_tolerance, max_corrections: When a step has arrived; see `ContinuationSettings`. Static, as all else that
            the compiled loop asks before each correction.
    """

    pair: ImpactPair
    sequence: Sequence
    start: Values
    steepest: Values
    low: Values
    high: Values
    along: str = eqx.field(static=True)
    newton_tolerance: float = eqx.field(static=True)
    max_corrections: int = eqx.field(static=True)

    def at(self, x: Values) -> ImpactPair:
        """Give the pair at a value of the parameter."""
        return moved(self.pair, self.along, x, self.start, self.steepest)


def unpack(arc: Arc, y):
    """Split a point of the curve, or many along leading axes, into knots and parameter."""
    return y[..., :-1].reshape(*y.shape[:-1], -1, 3), y[..., -1] * (arc.high - arc.low)


def _equations(arc: Arc, y) -> shooting.LinearisedEquations:
    """Compute the gap and its derivatives in knots and parameter."""
    knots, x = unpack(arc, y)
    pair, moved = jax.jvp(arc.at, (x,), (arc.high - arc.low,))
    return shooting.linearise(pair, arc.sequence, knots, moved)


class _Corrected(NamedTuple):
    """Newton's way back to the branch: the point, the tangent there, the size of the last correction, how many."""

    y: Float[Array, "unknown"]
    tangent: Float[Array, "unknown"]
    size: Float[Array, ""]
    corrections: Int[Array, ""]


def _correct(arc: Arc, guess, former) -> _Corrected:
    """Correct by Newton in the plane across the former tangent, and find the tangent there."""
    ahead = jnp.zeros_like(guess).at[-1].set(1.0)

    def once(at: _Corrected) -> _Corrected:
        gap, slope = _equations(arc, at.y)
        slope = jnp.concatenate([slope, former[None]])
        miss = jnp.append(gap, former @ (at.y - guess))
        step, tangent = jax.vmap(linear_solve.solve, in_axes=(None, 0))(slope, jnp.stack([miss, ahead]))
        return _Corrected(at.y - step, tangent / jnp.linalg.norm(tangent), jnp.abs(step).max(), at.corrections + 1)

    def going(at: _Corrected):
        return (at.size > arc.newton_tolerance) & (at.size < 1.0) & (at.corrections < arc.max_corrections)

    return lax.while_loop(going, once, _Corrected(guess, former, jnp.asarray(0.5, guess.dtype), jnp.int32(0)))


def _tests(arc: Arc, y, tangent) -> Tests:
    knots, x = unpack(arc, y)
    pair = arc.at(x)
    around = shooting.monodromy(pair, arc.sequence, knots)
    trace = around[0, 0] + around[1, 1]
    determinant = around[0, 0] * around[1, 1] - around[0, 1] * around[1, 0]
    room = grazing.between(pair, arc.sequence, knots).clearance
    return Tests(
        fold=tangent[-1],
        plus=1 - trace + determinant,
        minus=1 + trace + determinant,
        speed=room.speed,
        flight=room.flight,
        contact=room.contact,
        exit=room.exit,
        low=x - arc.low,
        high=arc.high - x,
    )


class BranchPlace(NamedTuple):
    """Points of branches, a row a lane: unknowns (knots, then the parameter over its range), tangents, test functions.

    And how Newton came there: the size of its last correction, and how many it took.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    size: np.ndarray
    corrections: np.ndarray


@partial(jitted, often=True)
def _compiled(arcs: Arc, y, tangent, length):
    def one(arc, y, tangent, length):
        at = _correct(arc, y + length * tangent, tangent)
        return BranchPlace(at.y, at.tangent, jnp.stack(_tests(arc, at.y, at.tangent)), at.size, at.corrections)

    return jax.vmap(one)(arcs, y, tangent, length)


def advance(arcs: Arc, y: np.ndarray, tangent: np.ndarray, length: np.ndarray) -> BranchPlace:
    """Go on from points of branches by an arclength each: the compiled program behind every step and every search."""
    return tiles.map_tiles(lambda rows: _compiled(*rows), (arcs, y, tangent, length), _BATCHES)
