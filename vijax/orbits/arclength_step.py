"""A step along a path of periodic orbits: a branch (`branch_path`), or a curve of bifurcations (`curve_equations`)."""

from collections.abc import Iterable
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings
from vijax.orbits.shooting import Sequence
from vijax.runtime import ring_solve, tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.programs import jitted
from vijax.runtime.ring_solve import Ring
from vijax.runtime.xla import once

BATCHES = (8, 64, 512)  # lanes of one compiled call
# Where an orbit has dozens of impacts rounding alone may move a point by more than Newton's last correction is to be.
# What comes so near, in parts of that, and comes no nearer is as exact as it can be.
_ROUNDING = 100.0
# Test functions of an orbit that grazes, or is at a bound, are smaller; those of one at a bifurcation.
_AT_AN_END, _VANISHES = 1e-12, 1e-9
_ASTRAY = 1.0  # A correction of half a period, or of a whole side of the plane, leads nowhere near.


class PathEquations(NamedTuple):
    """The equations of a path: what is missing to an orbit and to what holds besides, with all derivatives."""

    gap: Float[Array, " equation"]
    condition: Float[Array, " condition"]
    ring: Ring


@runtime_checkable
class Path(Protocol):
    """What a lane follows: a branch (`branch_path`), or a curve of bifurcations in two parameters (`curve_equations`).

    Its points y are rows of unknowns, one more than there are equations.

    Attributes:
        test_names: Of the test functions, in columns.
        first_end: The column from which on they are positive on real orbits.
    """

    test_names: ClassVar[tuple[str, ...]]
    first_end: ClassVar[int]

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

    def happenings(self, before, after) -> Int[Array, ""]:
        """Count what happens between two points, by their test functions."""


class _Corrected(NamedTuple):
    """Newton's way back to the path: the point, the tangent there, the size of the last correction, how many.

    And whether the point is on the path.
    """

    y: Float[Array, " unknown"]
    tangent: Float[Array, " unknown"]
    size: Float[Array, ""]
    corrections: Int[Array, ""]
    arrived: Bool[Array, ""]


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
        size, tolerance = jnp.abs(step).max(), path.newton_tolerance
        arrived = (size <= tolerance) | ((size <= _ROUNDING * tolerance) & (size > 0.5 * at.size))
        return _Corrected(at.y - step, tangent / jnp.linalg.norm(tangent), size, at.corrections + 1, arrived)

    def going(at: _Corrected):
        return ~at.arrived & (at.size < _ASTRAY) & (at.corrections < path.max_corrections)

    start = _Corrected(guess, former, jnp.asarray(0.5, guess.dtype), jnp.int32(0), jnp.asarray(False))
    return lax.while_loop(going, once, start)


class BranchPlace(NamedTuple):
    """Points of paths, a row a lane: unknowns (knots, then the parameter over its range), tangents, test functions.

    And how Newton came there: whether it did, and how many corrections it took. Where it went astray test functions
    are NaN.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    arrived: np.ndarray
    corrections: np.ndarray


class Walker(NamedTuple):
    """A lane on its way, or a row a lane.

    Attributes:
        y, tangent, tests: Its last point.
        length: Of the next step.
        passed: Points until then.
        going: Whether there is to be a next step.
        closed: Whether it has come by its start again.
        start, began: Unknowns and tangent of its first point.
        points: How many there may be.
    """

    y: Float[AnyArray, "*lane unknown"]
    tangent: Float[AnyArray, "*lane unknown"]
    tests: Float[AnyArray, "*lane test"]
    length: Float[AnyArray, "*lane"]
    passed: Int[AnyArray, "*lane"]
    going: Bool[AnyArray, "*lane"]
    closed: Bool[AnyArray, "*lane"]
    start: Float[AnyArray, "*lane unknown"]
    began: Float[AnyArray, "*lane unknown"]
    points: Int[AnyArray, "*lane"]


class Pace(NamedTuple):
    """How long steps are, and which are refused; see `ContinuationSettings`."""

    max_step: Any
    min_step: Any
    min_cosine: Any
    crowded_step: Any
    growth: Any
    easy_corrections: Any
    easy_bend: Any
    closing_steps: Any


def pace(settings: ContinuationSettings) -> Pace:
    """Read the pace of a walk."""
    given = {name: getattr(settings, name) for name in Pace._fields}
    return Pace(**{name: np.int32(x) if isinstance(x, int) else np.float64(x) for name, x in given.items()})


_ANY = pace(DEFAULT)  # That of a step that is not judged does not matter.


class Strides(NamedTuple):
    """Steps that lanes tried, in order: where they led, how long they were, whether they were taken."""

    place: BranchPlace
    length: np.ndarray
    taken: np.ndarray


def _try(path: Path, rules: Pace, at: Walker) -> tuple[Walker, Strides]:
    """Try a step; one that does not do is halved."""
    corrected: Any = _correct(path, at.y + at.length * at.tangent, at.tangent)
    y, tangent, size, corrections, arrived = corrected
    # Where Newton has gone astray flights may last for thousands of periods, and a search in one for as many seconds.
    astray = ~(size < _ASTRAY)
    tests: Any = jnp.stack([*path.tests(jnp.where(astray, at.y, y), tangent, at.tangent)])
    tests = jnp.where(astray, jnp.nan, tests)
    straight = tangent @ at.tangent
    # Newton may end on another path, or far along this one: neither its direction nor its distance fits then.
    near = jnp.linalg.norm(y - at.y) < 2 * at.length
    # Of two things within a step one may hide the other's change of sign, so that each gets a step of its own.
    single = (path.happenings(at.tests, tests) <= 1) | (at.length < rules.crowded_step)
    # A path that sets out from a graze does not know yet what is clear: all must be after the first step.
    clear = ~(jnp.isnan(at.tests) & (tests <= 0))[path.first_end :].any()
    taken = at.going & arrived & (straight > rules.min_cosine) & near & single & clear
    # Past a grazing or a bound there is no orbit. The first such point is kept: between it and the last is the end.
    real = (tests[path.first_end :] > 0).all() | ~taken
    easy = (corrections <= rules.easy_corrections) & (straight > 1 - rules.easy_bend * (1 - rules.min_cosine))
    longer = jnp.where(easy, jnp.minimum(rules.growth * at.length, rules.max_step), at.length)
    length, passed = jnp.where(taken, longer, 0.5 * at.length), at.passed + taken.astype(jnp.int32)
    old, new = (at.y, at.tangent, at.tests), (y, tangent, tests)
    on = [jnp.where(taken, *both) for both in zip(new, old, strict=True)]
    # A closed path comes by its start again, in the same direction.
    home = (jnp.linalg.norm(on[0] - at.start) < rules.max_step) & (on[1] @ at.began > rules.min_cosine)
    home = at.going & home & (passed > rules.closing_steps)
    going = at.going & (length > rules.min_step) & real & (passed < at.points) & ~home
    walker = at._replace(
        y=on[0], tangent=on[1], tests=on[2], length=length, passed=passed, going=going, closed=at.closed | home
    )
    tried: Any = BranchPlace(y, tangent, tests, arrived, corrections), at.length, taken
    return walker, Strides(*tried)


# Between two calls of a program a millisecond passes, as long as a step takes: one call tries so many steps.
_TRIALS = 16


@partial(jitted, often=True)
def _stride(paths: Path, at: Walker, rules: Pace, trials: Int[AnyArray, ""]) -> tuple[Walker, Strides]:
    """Try so many steps with all lanes, or until none goes on; after that the rows [lane, trial] hold zeros."""
    each = once(jax.vmap(_try, in_axes=(0, None, 0)))
    _, tried = jax.eval_shape(each, paths, rules, at)
    none = jax.tree.map(lambda x: jnp.zeros((x.shape[0], _TRIALS, *x.shape[1:]), x.dtype), tried)

    def onward(carry):
        trial, at, tried = carry
        at, new = each(paths, rules, at)
        return trial + 1, at, jax.tree.map(lambda rows, one: rows.at[:, trial].set(one), tried, new)

    def going(carry):
        trial, at, _ = carry
        return (trial < trials) & at.going.any()

    _, at, tried = lax.while_loop(going, onward, (jnp.int32(0), at, none))
    return at, tried


def stride(paths: Path, at: Walker, rules: Pace, trials: int = _TRIALS) -> tuple[Walker, Strides]:
    """Try a few steps with every lane: the compiled program behind every step and every search."""
    number: Any = np.int32(trials)
    return tiles.map_tiles(lambda rows: _stride(rows[0], rows[1], rules, number), (paths, at), BATCHES)


def across(y: np.ndarray) -> np.ndarray:
    """Give a direction for points of paths that is not orthogonal to any path, as none is likely to be."""
    some = np.cos(np.arange(y.shape[1])) * (np.abs(y) > 0).any(axis=0)
    return np.broadcast_to(some / np.linalg.norm(some), y.shape)


def settled(place: BranchPlace, first_end: int) -> BranchPlace:
    """Count starts that rounding alone puts beyond an end of real orbits, at a graze or a bound, as just before it.

    So a path ends where it begins one way, and leads on the other. What else vanishes there is not known: where an
    orbit fades, its multipliers are 1 but for what Newton leaves.
    """
    tests = place.tests.copy()
    others, ends = tests[:, :first_end], tests[:, first_end:]
    at_end = np.abs(ends) < _AT_AN_END
    ends[at_end] = np.finfo(float).tiny
    others[at_end.any(axis=1)[:, None] & (np.abs(others) < _VANISHES)] = np.nan
    return place._replace(tests=tests)


def advance(paths: Path, y: np.ndarray, tangent: np.ndarray, length: np.ndarray) -> BranchPlace:
    """Go on from points of paths by an arclength each, whatever comes of it."""
    lanes = len(y)
    zero, yes, unknown = (
        np.zeros(lanes, np.int32),
        np.full(lanes, True),
        np.full((lanes, len(paths.test_names)), np.nan),
    )
    at: Any = y, tangent, unknown, length, zero, yes, ~yes, y, tangent, zero
    _, tried = stride(paths, Walker(*at), _ANY, 1)
    return jax.tree.map(lambda leaf: leaf[:, 0], tried.place)
