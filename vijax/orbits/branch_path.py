"""A branch of periodic orbits as a path in the space of knots and one parameter.

The orbit's equations go on through grazing into orbits that are none (`shooting`). What makes an orbit real, and what
marks a bifurcation, are smooth functions along the curve: its test functions.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import grazing, multipliers, shooting
from vijax.orbits.arclength_step import BranchPlace, PathEquations, across, advance
from vijax.orbits.parameter import Values, moved
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray


class Tests(NamedTuple):
    """Functions whose sign changes mark what happens on a branch; those from `speed` on are positive on real orbits."""

    fold: Float[Array, ""]  # the parameter's share of the tangent; at soft walls over the least speed
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

    test_names: ClassVar[tuple[str, ...]] = Tests._fields
    first_end: ClassVar[int] = FIRST_END

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

    def unpack(self, y):
        """Split a point of the branch, or many along leading axes, into knots and parameter."""
        return y[..., :-1].reshape(*y.shape[:-1], -1, 3), y[..., -1] * (self.high - self.low)

    def pair_and_knots(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Give the orbits of points, many along a leading axis."""
        knots, x = self.unpack(y)
        return self.at(x), knots

    def equations(self, y) -> PathEquations:
        """Compute the gap and its derivatives in knots and parameter."""
        knots, x = self.unpack(y)
        pair, moved = jax.jvp(self.at, (x,), (self.high - self.low,))
        gap, ring, *_ = shooting.linearise(pair, self.sequence, knots, moved)
        return PathEquations(gap, jnp.zeros(0, y.dtype), ring)

    def tests(self, y, tangent, former) -> Tests:
        """Compute the test functions; which way the step was that led here does not matter to them."""
        knots, x = self.unpack(y)
        pair = self.at(x)
        around = multipliers.monodromy(pair, self.sequence, knots)
        trace = around[0, 0] + around[1, 1]
        determinant = around[0, 0] * around[1, 1] - around[0, 1] * around[1, 0]
        room = grazing.between(pair, self.sequence, knots).clearance
        # At a soft wall the parameter goes as the square of the speed of an impact that fades: at that graze its share
        # of the tangent vanishes without a fold. Over the speed it does not, and has the same sign on real orbits.
        soft = self.sequence.real & ~pair.hard(self.sequence.side)
        return Tests(
            fold=tangent[-1] / jnp.where(soft, knots[:, 1], 1.0).min(),
            plus=1 - trace + determinant,
            minus=1 + trace + determinant,
            speed=room.speed,
            flight=room.flight,
            contact=room.contact,
            exit=room.exit,
            low=x - self.low,
            high=self.high - x,
        )

    def happenings(self, before, after) -> Int[Array, ""]:
        """Count what happens between two points; a multiplier that passes +1 at a fold is one such thing."""
        passed = Tests(*(jnp.sign(before) * jnp.sign(after) < 0))
        things = [passed.fold | passed.plus, passed.minus, jnp.stack(passed[FIRST_END:]).any()]
        return jnp.stack(things).sum(dtype=jnp.int32)


def upwards(arcs: Arc, y: np.ndarray) -> BranchPlace:
    """Find the tangents at starts of branches, a row each, such that the parameter rises."""
    none, ahead = np.zeros(len(y)), np.zeros_like(y)
    ahead[:, -1] = 1.0
    first = advance(arcs, y, ahead, none)
    lost = np.flatnonzero(~first.arrived)
    if not lost.size:
        return first
    # At a fold no orbit next to it has the parameter of the start, and Newton is to go another way.
    other = advance(arcs, y, across(y), none)
    other = heading(other, np.where(other.tangent[:, -1] < 0, -1.0, 1.0))
    return jax.tree.map(lambda one, more: tiles.replaced(lost, one, more[lost]), first, other)


def heading(place: BranchPlace, sign: float | np.ndarray) -> BranchPlace:
    """Turn the place the other way where the sign is negative; the fold's test function turns with it."""
    tests = place.tests.copy()
    tests[:, FOLD] *= sign
    return place._replace(tangent=np.atleast_1d(sign)[:, None] * place.tangent, tests=tests)
