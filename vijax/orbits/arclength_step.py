"""A branch of periodic orbits as a path in the space of knots and one parameter, and one step along it or another path.

The orbit's equations go on through grazing into orbits that are none (`shooting`). What makes an orbit real, and what
marks a bifurcation, are smooth functions along the curve: its test functions.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

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
from vijax.runtime import ring_solve, tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.programs import begin, jitted
from vijax.runtime.ring_solve import Ring

BATCHES = (8, 64, 512)  # lanes of one compiled call


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


class PathEquations(NamedTuple):
    """The equations of a path: what is missing to an orbit and to what holds besides, with all derivatives."""

    gap: Float[Array, "equation"]
    condition: Float[Array, "condition"]
    ring: Ring


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
        gap, ring = shooting.linearise(pair, self.sequence, knots, moved)
        return PathEquations(gap, jnp.zeros(0, y.dtype), ring)

    def tests(self, y, tangent, former) -> Tests:
        """Compute the test functions; which way the step was that led here does not matter to them."""
        knots, x = self.unpack(y)
        pair = self.at(x)
        around = shooting.monodromy(pair, self.sequence, knots)
        trace = around[0, 0] + around[1, 1]
        determinant = around[0, 0] * around[1, 1] - around[0, 1] * around[1, 0]
        room = grazing.between(pair, self.sequence, knots).clearance
        # At a soft wall the parameter goes as the square of the speed of an impact that fades: at that graze its share
        # of the tangent vanishes without a fold. Over the speed it does not, and has the same sign on real orbits.
        return Tests(
            fold=tangent[-1] if pair.rigid else tangent[-1] / room.speed,
            plus=1 - trace + determinant,
            minus=1 + trace + determinant,
            speed=room.speed,
            flight=room.flight,
            contact=room.contact,
            exit=room.exit,
            low=x - self.low,
            high=self.high - x,
        )


@runtime_checkable
class Path(Protocol):
    """What a lane follows: a branch (`Arc`), or a curve of bifurcations in two parameters (`curve_equations`).

    Its points y are rows of unknowns, one more than there are equations.
    """

    @property
    def newton_tolerance(self) -> float:
        """Size of Newton's last correction."""

    @property
    def max_corrections(self) -> int:
        """Corrections of a step at most."""

    @property
    def sequence(self) -> Sequence:
        """Walls of the orbits."""

    def pair_and_knots(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Give the orbits of points, many along a leading axis."""

    def equations(self, y) -> PathEquations:
        """Compute what is missing to a point, and the derivatives in all unknowns."""

    def tests(self, y, tangent, former) -> Iterable[Array]:
        """Compute the test functions at a point with its tangent, reached along a former tangent."""


class _Corrected(NamedTuple):
    """Newton's way back to the path: the point, the tangent there, the size of the last correction, how many."""

    y: Float[Array, "unknown"]
    tangent: Float[Array, "unknown"]
    size: Float[Array, ""]
    corrections: Int[Array, ""]


def _correct(path: Path, guess, former) -> _Corrected:
    """Correct by Newton in the plane across the former tangent, and find the tangent there."""

    def once(at: _Corrected) -> _Corrected:
        gap, condition, ring = path.equations(at.y)
        miss = jnp.append(condition, former @ (at.y - guess))
        # Two right sides: what is missing, and a unit of the way ahead with nothing missing.
        right = jnp.stack([gap, jnp.zeros_like(gap)], axis=1).reshape(-1, 3, 2)
        ahead = jnp.zeros_like(miss).at[-1].set(1.0)
        inner, outer = ring_solve.solve(ring.bordered(former[None]), right, jnp.stack([miss, ahead], axis=1))
        step, tangent = jnp.concatenate([inner.reshape(-1, 2), outer]).T
        return _Corrected(at.y - step, tangent / jnp.linalg.norm(tangent), jnp.abs(step).max(), at.corrections + 1)

    def going(at: _Corrected):
        return (at.size > path.newton_tolerance) & (at.size < 1.0) & (at.corrections < path.max_corrections)

    return lax.while_loop(going, once, _Corrected(guess, former, jnp.asarray(0.5, guess.dtype), jnp.int32(0)))


class BranchPlace(NamedTuple):
    """Points of paths, a row a lane: unknowns (knots, then the parameter over its range), tangents, test functions.

    And how Newton came there: the size of its last correction, and how many it took.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    size: np.ndarray
    corrections: np.ndarray


@partial(jitted, often=True)
def _corrected(paths: Path, y, tangent, length) -> _Corrected:
    """Go on from points of paths by an arclength each."""
    guess = y + length[:, None] * tangent
    return jax.vmap(_correct)(paths, guess, tangent)


@partial(jitted, often=True)
def _tested(paths: Path, y, tangent, former) -> Array:
    """Compute the test functions at points of paths, in columns."""
    return jnp.stack([*jax.vmap(lambda path, *at: path.tests(*at))(paths, y, tangent, former)], axis=1)


def _advanced(rows: tuple[Path, Any, Any, Any]) -> BranchPlace:
    paths, y, tangent, length = rows
    # Two programs, compiled at the same time. Both are given NumPy's arrays: of JAX's the second would be another one.
    begin(_tested, paths, y, tangent, tangent)
    at = jax.tree.map(np.asarray, _corrected(paths, y, tangent, length))
    tests = np.asarray(_tested(paths, at.y, at.tangent, tangent))
    return BranchPlace(at.y, at.tangent, tests, at.size, at.corrections)


def advance(paths: Path, y: np.ndarray, tangent: np.ndarray, length: np.ndarray) -> BranchPlace:
    """Go on from points of paths by an arclength each: the compiled programs behind every step and every search."""
    return tiles.map_tiles(_advanced, (paths, y, tangent, length), BATCHES)
