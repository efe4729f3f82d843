"""One pseudo-arclength step along a path of periodic orbits, for many paths at once.

A path is a branch of orbits in one parameter (`branch_equations`) or a curve of bifurcations in two
(`curve_equations`). Its points y solve equations F(y) = 0, one fewer than there are unknowns. From a point y with the
unit tangent z, a step of length s

    predicts  y0 = y + s z,
    corrects  y0 by Newton's method to the next point p, with F(p) = 0 and z . (p - y0) = 0.

The step is accepted, or halved and tried again, by the rules of `ContinuationSettings`. Smooth test functions are
evaluated at each point. A change of sign between two points marks a bifurcation, or the place beyond which the
solutions of the equations are no motions of the ball, for example because they pass through a wall.

Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10 (pseudo-arclength continuation).
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.continuation.continuation_settings import DEFAULT, ContinuationSettings
from vijax.model.pair import ImpactPair
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.compilation.xla import reuse_trace
from vijax.runtime.numerics import ring_solve
from vijax.runtime.numerics.ring_solve import BlockRing

BATCHES = (8, 64, 512)  # numbers of lanes for which the step is compiled; other numbers are padded to the next of these
# Newton's method also counts as converged if the last correction is at most this factor times the tolerance and more
# than half of the correction before, because rounding alone may exceed the tolerance in an orbit of dozens of impacts.
_STAGNATION_FACTOR = 100.0
# At a start on a graze or at a bound: absolute value below which an end test, or any other test function, is zero.
_END_TOLERANCE, _ZERO_TOLERANCE = 1e-12, 1e-9
# Newton's method diverges if a correction is this large: half a forcing period, or the whole range of a parameter.
_DIVERGED = 1.0


class PathEquations(NamedTuple):
    """Residuals of the equations of a path at a point, with their derivatives in all unknowns.

    Attributes:
        residual: Residual of the multiple-shooting equations of the orbit.
        condition: Residual of the equations that define a curve of bifurcations, such as a multiplier of 1; empty on a
            branch.
        ring: Derivatives of both residuals, as the matrix of a cyclic block system with a border.
    """

    residual: Float[Array, " equation"]
    condition: Float[Array, " condition"]
    ring: BlockRing


@runtime_checkable
class Path(Protocol):
    """A continuation problem: a branch (`branch_equations`), or a curve of bifurcations (`curve_equations`).

    A point y of the path is a row of unknowns, one more than there are equations.

    Attributes:
        test_names: Names of the test functions, in the order of their columns.
        first_end: Column of the first end test; all later columns are end tests, too. End tests are positive on real
            orbits, and the path ends where one of them changes sign.
    """

    test_names: ClassVar[tuple[str, ...]]
    first_end: ClassVar[int]

    @property
    def newton_tolerance(self) -> float:
        """Bound of the last Newton correction, in each unknown, at a converged point."""

    @property
    def max_corrections(self) -> int:
        """Largest number of Newton corrections in a step."""

    @property
    def sequence(self) -> Sequence:
        """Walls of the orbit's impacts."""

    def pair_and_unknowns(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Return the pair and the impact unknowns at one point y, or at many points along a leading axis."""

    def equations(self, y) -> PathEquations:
        """Compute the residual of the equations at a point, and its derivatives in all unknowns."""

    def tests(self, y, tangent, previous_tangent) -> Iterable[Array]:
        """Compute the test functions at a point with its tangent, after a step along `previous_tangent`."""

    def count_events(self, before, after) -> Int[Array, ""]:
        """Count the events between two successive points, given the test functions at each of them."""


class _NewtonState(NamedTuple):
    """State of Newton's method on its way from a predicted point back to the path.

    Attributes:
        y: The point.
        tangent: Unit tangent of the path there.
        size: Largest absolute component of the last correction.
        corrections: Number of corrections.
        converged: Whether the point is on the path to within the tolerance.
    """

    y: Float[Array, " unknown"]
    tangent: Float[Array, " unknown"]
    size: Float[Array, ""]
    corrections: Int[Array, ""]
    converged: Bool[Array, ""]


def _correct(path: Path, predicted, previous_tangent) -> _NewtonState:
    """Correct a predicted point by Newton's method in the hyperplane normal to the previous tangent.

    The tangent at the corrected point solves the same linear system with the right side (0, ..., 0, 1), so that it
    costs only one column more in each elimination.
    """

    def newton_step(state: _NewtonState) -> _NewtonState:
        residual, condition, ring = path.equations(state.y)
        border_residual = jnp.append(condition, previous_tangent @ (state.y - predicted))
        # Two right sides: the residual gives the correction, a unit step along the path gives the tangent.
        right_sides = jnp.stack([residual, jnp.zeros_like(residual)], axis=1).reshape(-1, 3, 2)
        unit_step = jnp.zeros_like(border_residual).at[-1].set(1.0)
        block_solution, border_solution = ring_solve.solve(
            ring.bordered(previous_tangent[None]), right_sides, jnp.stack([border_residual, unit_step], axis=1)
        )
        step, tangent = jnp.concatenate([block_solution.reshape(-1, 2), border_solution]).T
        # The second condition detects stagnation: the correction is close to the tolerance, but not half the last one.
        step_size, tolerance = jnp.abs(step).max(), path.newton_tolerance
        converged = (step_size <= tolerance) | (
            (step_size <= _STAGNATION_FACTOR * tolerance) & (step_size > 0.5 * state.size)
        )
        return _NewtonState(
            state.y - step, tangent / jnp.linalg.norm(tangent), step_size, state.corrections + 1, converged
        )

    def is_iterating(state: _NewtonState):
        return ~state.converged & (state.size < _DIVERGED) & (state.corrections < path.max_corrections)

    # 0.5 is a nominal previous correction, below the divergence bound, so that the loop begins.
    start = _NewtonState(
        predicted, previous_tangent, jnp.asarray(0.5, predicted.dtype), jnp.int32(0), jnp.asarray(False)
    )
    return lax.while_loop(is_iterating, newton_step, start)


class PathPoints(NamedTuple):
    """Points of paths, one row per lane.

    Attributes:
        y: Unknowns: the impact unknowns, then each parameter divided by its range.
        tangent: Unit tangents of the paths.
        tests: Test functions; NaN where Newton's method diverged.
        converged: Whether Newton's method converged.
        corrections: Number of Newton corrections.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    converged: np.ndarray
    corrections: np.ndarray


class ContinuationState(NamedTuple):
    """State of the continuation in one lane, or in many along a leading axis.

    Attributes:
        y, tangent, tests: Last accepted point.
        length: Arclength of the next step.
        point_count: Number of accepted points, the first one included.
        active: Whether another step is to be tried.
        closed: Whether the path has returned to its first point.
        start, start_tangent: Unknowns and tangent of the first point.
        max_points: Largest number of points.
    """

    y: Float[AnyArray, "*lane unknown"]
    tangent: Float[AnyArray, "*lane unknown"]
    tests: Float[AnyArray, "*lane test"]
    length: Float[AnyArray, "*lane"]
    point_count: Int[AnyArray, "*lane"]
    active: Bool[AnyArray, "*lane"]
    closed: Bool[AnyArray, "*lane"]
    start: Float[AnyArray, "*lane unknown"]
    start_tangent: Float[AnyArray, "*lane unknown"]
    max_points: Int[AnyArray, "*lane"]


class StepController(NamedTuple):
    """Rules that set the length of steps and decide whether a step is accepted; see `ContinuationSettings`."""

    max_step: Any
    min_step: Any
    min_cosine: Any
    event_separation_step: Any
    growth: Any
    max_corrections_for_growth: Any
    max_bend_for_growth: Any
    closing_steps: Any


def step_controller(settings: ContinuationSettings) -> StepController:
    """Return the step rules of some settings."""
    values = {name: getattr(settings, name) for name in StepController._fields}
    return StepController(
        **{name: np.int32(value) if isinstance(value, int) else np.float64(value) for name, value in values.items()}
    )


_DEFAULT_CONTROLLER = step_controller(
    DEFAULT
)  # for `predict_and_correct`; has no effect there, because rejected steps are returned too


class AttemptedSteps(NamedTuple):
    """Steps that lanes tried, in order: the points reached, the lengths of the steps, whether each was accepted."""

    points: PathPoints
    length: np.ndarray
    accepted: np.ndarray


def _try_step(path: Path, rules: StepController, state: ContinuationState) -> tuple[ContinuationState, AttemptedSteps]:
    """Try one step of one lane; a step that is not accepted halves the length of the next one."""
    corrected: Any = _correct(path, state.y + state.length * state.tangent, state.tangent)
    y, tangent, correction_size, corrections, converged = corrected
    # A diverged point may have flights of thousands of periods, and the search for turning points in one of them would
    # take seconds. Evaluate the test functions at the last accepted point, and discard the values.
    diverged = ~(correction_size < _DIVERGED)
    tests: Any = jnp.stack([*path.tests(jnp.where(diverged, state.y, y), tangent, state.tangent)])
    tests = jnp.where(diverged, jnp.nan, tests)
    # Cosine of the angle between the tangents at both ends of the step.
    cosine = tangent @ state.tangent
    # Newton's method may end on another path or far along this one; the distance of the point is too large then.
    near = jnp.linalg.norm(y - state.y) < 2 * state.length
    # Two events within one step may hide each other's change of sign. Shorten the step until it contains at most one
    # event.
    separated = (path.count_events(state.tests, tests) <= 1) | (state.length < rules.event_separation_step)
    # If a path begins at a graze, some end tests are unknown (NaN) at its first point. The step from there is accepted
    # only if these end tests become positive.
    clear_of_ends = ~(jnp.isnan(state.tests) & (tests <= 0))[path.first_end :].any()
    accepted = state.active & converged & (cosine > rules.min_cosine) & near & separated & clear_of_ends
    # Beyond a graze or a bound no real orbit exists. The first point beyond is accepted as the last one, so that the
    # end can be located between it and the point before.
    before_end = (tests[path.first_end :] > 0).all() | ~accepted
    lengthens = (corrections <= rules.max_corrections_for_growth) & (
        cosine > 1 - rules.max_bend_for_growth * (1 - rules.min_cosine)
    )
    # An easy step (few corrections, little bend) lengthens the next one; a rejected step halves it.
    longer = jnp.where(lengthens, jnp.minimum(rules.growth * state.length, rules.max_step), state.length)
    length, count = jnp.where(accepted, longer, 0.5 * state.length), state.point_count + accepted.astype(jnp.int32)
    previous, new = (state.y, state.tangent, state.tests), (y, tangent, tests)
    last = [jnp.where(accepted, *both) for both in zip(new, previous, strict=True)]
    # A closed path returns to its first point in the same direction.
    returned = (jnp.linalg.norm(last[0] - state.start) < rules.max_step) & (
        last[1] @ state.start_tangent > rules.min_cosine
    )
    returned = state.active & returned & (count > rules.closing_steps)
    active = state.active & (length > rules.min_step) & before_end & (count < state.max_points) & ~returned
    next_state = state._replace(
        y=last[0],
        tangent=last[1],
        tests=last[2],
        length=length,
        point_count=count,
        active=active,
        closed=state.closed | returned,
    )
    step: Any = PathPoints(y, tangent, tests, converged, corrections), state.length, accepted
    return next_state, AttemptedSteps(*step)


# Steps tried per call of the compiled program; several, because a call takes as long to start (1 ms) as one step takes.
_STEPS_PER_CALL = 16


@partial(jitted, often=True)
def _try_steps(
    paths: Path, state: ContinuationState, rules: StepController, trials: Int[AnyArray, ""]
) -> tuple[ContinuationState, AttemptedSteps]:
    """Try at most `trials` steps with all lanes, and stop early when no lane is active.

    Unused rows [lane, trial] of the result hold zeros.
    """
    try_all_lanes = reuse_trace(jax.vmap(_try_step, in_axes=(0, None, 0)))
    _, steps = jax.eval_shape(try_all_lanes, paths, rules, state)
    # Buffer for the results of all trials: a loop in JAX needs arrays of fixed shape.
    empty = jax.tree.map(lambda x: jnp.zeros((x.shape[0], _STEPS_PER_CALL, *x.shape[1:]), x.dtype), steps)

    def try_next(carry):
        trial, state, steps = carry
        state, step = try_all_lanes(paths, rules, state)
        return trial + 1, state, jax.tree.map(lambda rows, row: rows.at[:, trial].set(row), steps, step)

    def has_active_lane(carry):
        trial, state, _ = carry
        return (trial < trials) & state.active.any()

    _, state, steps = lax.while_loop(has_active_lane, try_next, (jnp.int32(0), state, empty))
    return state, steps


def try_steps(
    paths: Path, state: ContinuationState, rules: StepController, trials: int = _STEPS_PER_CALL
) -> tuple[ContinuationState, AttemptedSteps]:
    """Try a few steps with every lane.

    The continuation and the location of events both call this function, so that they share its compiled programs.
    """
    trial_count: Any = np.int32(trials)
    return tiles.map_tiles(lambda rows: _try_steps(rows[0], rows[1], rules, trial_count), (paths, state), BATCHES)


def generic_direction(y: np.ndarray) -> np.ndarray:
    """Return a fixed unit direction that is unlikely to be orthogonal to any path, one row per point.

    Where the tangent is not known yet, Newton's method corrects in the hyperplane normal to this direction. Its
    components are zero for padded unknowns, which are zero at all points.
    """
    direction = np.cos(np.arange(y.shape[1])) * (np.abs(y) > 0).any(axis=0)
    return np.broadcast_to(direction / np.linalg.norm(direction), y.shape)


def place_before_end(points: PathPoints, first_end: int) -> PathPoints:
    """Change the test functions of starts on a graze or at a bound, so that they lie just before this end of the path.

    At such a start an end test is zero to within rounding. It is set to the smallest positive number, so that the path
    ends at once in one direction and continues in the other. Other test functions that vanish at such a point become
    NaN (sign unknown): for example, where the impacts of an orbit fade, its multipliers are 1 to within the error of
    Newton's method.
    """
    # Both arrays are views of the copy, so that the assignments below change `tests`.
    tests = points.tests.copy()
    bifurcation_tests, end_tests = tests[:, :first_end], tests[:, first_end:]
    at_end = np.abs(end_tests) < _END_TOLERANCE
    end_tests[at_end] = np.finfo(float).tiny
    bifurcation_tests[at_end.any(axis=1)[:, None] & (np.abs(bifurcation_tests) < _ZERO_TOLERANCE)] = np.nan
    return points._replace(tests=tests)


def predict_and_correct(paths: Path, y: np.ndarray, tangent: np.ndarray, length: np.ndarray) -> PathPoints:
    """Make one predictor-corrector step of a specified arclength from each point, without any check of the result."""
    lanes = len(y)
    zero, true, unknown = (
        np.zeros(lanes, np.int32),
        np.full(lanes, True),
        np.full((lanes, len(paths.test_names)), np.nan),
    )
    state: Any = y, tangent, unknown, length, zero, true, ~true, y, tangent, zero
    _, steps = try_steps(paths, ContinuationState(*state), _DEFAULT_CONTROLLER, 1)
    return jax.tree.map(lambda leaf: leaf[:, 0], steps.points)
