"""The equations between impact times, linearised.

Every interval yields the speed of the ball at its first wall and its velocity at the next one (`interval`). Two
consecutive intervals must agree on the impact between them: one equation for three times. A measured speed is one
equation for two times.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from vijax.fitting.fit_excitation import FitExcitation
from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Ends, Interval, Motion, Restitution, guess_motions, interval
from vijax.fitting.series import Series
from vijax.fitting.unknowns import DELAY, device_with
from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted

_TILES = (64, 1024)  # numbers of intervals in one compiled call
# Cost of an interval without a motion, and largest cost of a disagreement between the speeds of neighbouring intervals,
# in units of A pi/omega. The limit of the disagreement keeps a false impact from changing the motions next to it.
_NO_MOTION, _DISAGREEMENT = 10.0, 1.0


@dataclass(frozen=True)
class Equations:
    """The equations, linearised at unknowns and times: one per inner impact, one per measured speed.

    Attributes:
        equation_residuals: Residuals [equation].
        impact: Index of the impact in the equation [equation].
        by_unknown: Derivatives by the search variables, mostly the logarithms of the unknowns [equation, unknown].
        by_restitution: Derivatives by offset and slope of the term added to r [equation, 2].
        by_time: Derivatives by the times, sparse [equation, impact].
        extra_variance: Variance of each equation, without the part from the errors of the times [equation].
        has_motion: Whether a motion was found for each interval in the equation [equation].
        outside: Largest distance of the flight after an impact beyond a wall [interval].
        speeds: Impact speeds in units of A pi/omega [impact].
        speed_unit: A pi/omega of the specified device [m/s].
        motions: The motions from impact to impact [interval].
    """

    equation_residuals: np.ndarray
    impact: np.ndarray
    by_unknown: np.ndarray
    by_restitution: np.ndarray
    by_time: Any
    extra_variance: np.ndarray
    has_motion: np.ndarray
    outside: np.ndarray
    speeds: np.ndarray
    speed_unit: float
    motions: Motion

    def errors(self, series: Series, soft: float) -> np.ndarray:
        """Compute the standard error of each equation, from its times, its measured speed and a tolerance [equation].

        Args:
            series: Impacts with their errors.
            soft: The tolerance, in units of A pi/omega.
        """
        shared = finite(self.by_time).power(2).sum(axis=1)
        tolerance = soft * np.where(self.extra_variance > 0, self.speed_unit, 1.0)
        variance = self.extra_variance + tolerance**2 + series.timing_error**2 * shared
        # An equation without a motion has no derivatives yet; it gets the median variance.
        return np.sqrt(np.where(self.has_motion, variance, np.median(variance)))


class Intervals(NamedTuple):
    """Times [s] and sides of the impacts at both ends, of one interval or of many."""

    time: Any
    next_time: Any
    side: Any
    next_side: Any


class SolvedMotions(NamedTuple):
    """Motions of intervals.

    Attributes:
        interval: Index of the interval of each motion [motion].
        values: Speed at the start, velocity at the end, and speed at the start in m/s [motion, 3].
        slopes: Derivatives of `values` by the unknowns, by offset and slope of r, and by the times of start and end
            [motion, 3, variable].
        motion: The solution [motion].
    """

    interval: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    motion: Interval

    def chosen(self, rows: np.ndarray) -> "SolvedMotions":
        """Return selected motions; the index after the last motion selects an entry of NaN, which means no motion."""

        def of(leaf: np.ndarray) -> np.ndarray:
            if rows.dtype == bool:
                return leaf[rows]
            none = np.full((1, *leaf.shape[1:]), -1 if leaf.dtype.kind == "i" else np.nan, leaf.dtype)
            return np.concatenate([leaf, none])[rows]

        return jax.tree.map(of, self)


class _InUnits(NamedTuple):
    """An interval in the nondimensional units of the device with these unknowns."""

    device: Harvester
    pair: ImpactPair
    ends: Ends


def _in_units(device: Harvester, names: tuple[str, ...], wall: Walls, z: Array, row: Intervals) -> _InUnits:
    device_of_row = device_with(device, names, z)
    # The delay is in half periods of the specified device, so that it does not change with omega.
    delay = z[-1] * jnp.pi / device.omega if DELAY in names else 0.0
    t, next_t = ((when - delay) * device_of_row.omega / jnp.pi for when in (row.time, row.next_time))
    return _InUnits(device_of_row, device_of_row.pair(wall), Ends(row.side, row.next_side, t, next_t))


@partial(jitted, static=("names", "wall"))
def _guess_motions(
    device: Harvester,
    excitation: FitExcitation,
    z: Float[Array, " unknown"],
    rows: Intervals,
    *,
    names: tuple[str, ...],
    wall: Walls,
) -> tuple[Motion, Array]:
    """Guess the motions of every interval [interval, motion]; return whether all durations were tried [interval]."""

    def guess(row: Intervals) -> tuple[Motion, Array]:
        scene = _in_units(device, names, wall, z, row)
        return guess_motions(scene.pair, excitation, scene.ends)

    return jax.vmap(guess)(rows)


@partial(jitted, static=("names", "wall"))
def _solve_motions(
    device: Harvester,
    excitation: FitExcitation,
    z: Float[Array, " unknown"],
    rows: tuple[Intervals, Motion],
    *,
    names: tuple[str, ...],
    wall: Walls,
) -> tuple[Array, Array, Interval]:
    """Solve every interval near a guess; return `SolvedMotions.values`, their derivatives, and the solution."""

    def numbers(x: Array, row: Intervals, near: Motion) -> tuple[Array, tuple[Array, Interval]]:
        variables, (offset, slope, time, next_time) = x[: len(names)], x[len(names) :]
        scene = _in_units(device, names, wall, variables, row._replace(time=time, next_time=next_time))
        solution = interval(scene.pair, excitation, Restitution(offset, slope), scene.ends, near)
        values = jnp.stack([solution.speed, solution.arrival, solution.speed * scene.device.speed_unit])
        return values, (values, solution)

    def solve_row(row: Intervals, near: Motion):
        zero = jnp.zeros_like(row.time)
        # All variables in one vector: unknowns, offset and slope of r, times of start and end.
        x = jnp.concatenate([z, jnp.stack([zero, zero, row.time, row.next_time])])
        slopes, (values, solution) = jax.jacfwd(numbers, has_aux=True)(x, row, near)
        return values, slopes, solution

    return jax.vmap(solve_row)(*rows)


def consecutive(series: Series, times: np.ndarray) -> Intervals:
    """Return the intervals between consecutive impacts."""
    return Intervals(times[:-1], times[1:], series.sides[:-1], series.sides[1:])


def solve_near(model: FitModel, z: np.ndarray, intervals: Intervals, near: Motion) -> SolvedMotions:
    """Compute the motions of intervals near guesses."""
    fixed: Any = (model.device, model.excitation, z)
    named = partial(_solve_motions, *fixed, names=model.names, wall=model.wall)
    values, slopes, solution = jax.tree.map(np.asarray, tiles.map_tiles(named, (intervals, near), _TILES))
    return SolvedMotions(np.arange(len(values)), values, slopes, solution)


def solve_all(model: FitModel, z: np.ndarray, intervals: Intervals) -> tuple[SolvedMotions, np.ndarray]:
    """Compute all motions of intervals, and whether contacts of all durations were tried [interval]."""
    fixed: Any = (model.device, model.excitation, z)
    named = partial(_guess_motions, *fixed, names=model.names, wall=model.wall)
    guess, tried = jax.tree.map(np.asarray, tiles.map_tiles(named, intervals, _TILES))
    valid = np.isfinite(guess.speed)
    valid[0, 0] = True  # at least one row in a call, even if NaN
    interval, _ = np.nonzero(valid)
    near = Motion(guess.speed[valid], guess.contact_duration[valid])
    solution = solve_near(model, z, Intervals(*(row[interval] for row in intervals)), near)
    return solution._replace(interval=interval).chosen(np.isfinite(solution.motion.speed)), tried


def _most_consistent(model: FitModel, series: Series, motions: SolvedMotions) -> SolvedMotions:
    """Select a motion for each interval, so that the speeds at shared impacts differ least."""
    count, (place, most_motions) = series.times.size - 1, _places(motions.interval)
    # The last column of every interval stands for no motion.
    speeds, arrivals = np.full((2, count, most_motions + 1), np.nan)
    speeds[motions.interval, place], arrivals[motions.interval, place] = motions.values[:, 0], motions.values[:, 1]
    costs = np.where(np.isnan(speeds), _NO_MOTION, 0.0)
    if series.speeds is not None:
        costs += np.nan_to_num(np.abs(speeds - series.speeds[:-1, None] / float(model.device.speed_unit)))
    # Arrival speeds towards the wall are comparable to entry speeds of the next interval.
    selected = least_chain(speeds, series.sides[1:, None] * arrivals, costs)
    # The index after the last motion stands for no motion, see `SolvedMotions.chosen`.
    rows = np.full((count, most_motions + 1), len(place))
    rows[motions.interval, place] = np.arange(len(place))
    return motions.chosen(rows[np.arange(count), selected])


def _places(interval: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the index of each motion within its interval, and the largest number of motions of an interval."""
    # `interval` is sorted, so that the place within an interval is the index minus the first index of the interval.
    first = np.searchsorted(interval, interval)
    place = np.arange(interval.size) - first
    return place, int(place.max(initial=-1)) + 1


def least_chain(speeds: np.ndarray, arrivals: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Select a motion of every interval with the least sum of their costs and of the disagreements of neighbours.

    Dynamic programming (Viterbi): the best chain that ends with a motion follows from the best chains of the interval
    before.

    Args:
        speeds: Speeds at the first impact of an interval [interval, motion]; NaN for no motion.
        arrivals: Speeds at the next impact, towards its wall [interval, motion].
        costs: Cost of a motion by itself [interval, motion].
    """
    cost, previous = costs[0], []
    for k in range(1, len(speeds)):
        disagreement = np.nan_to_num(np.abs(arrivals[k - 1][:, None] - speeds[k]))
        total = cost[:, None] + np.minimum(disagreement, _DISAGREEMENT)
        previous.append(total.argmin(axis=0))
        cost = total.min(axis=0) + costs[k]
    chosen = [int(cost.argmin())]
    for before in reversed(previous):
        chosen.append(int(before[chosen[-1]]))
    return np.array(chosen[::-1])


def linearise(
    model: FitModel, series: Series, z: np.ndarray, times: np.ndarray, near: Motion | None = None
) -> Equations:
    """Linearise the equations of a series at given unknowns and times.

    Args:
        model: The model of the device.
        series: The measured impacts.
        z: Search variable of each unknown (mostly the logarithm of the unknown).
        times: Onsets of the impacts [s].
        near: Guesses of the motions from impact to impact; by default the motions that agree best on the speeds at
            shared impacts.
    """
    rows = consecutive(series, times)
    chain = (
        _most_consistent(model, series, solve_all(model, z, rows)[0])
        if near is None
        else solve_near(model, z, rows, near)
    )
    slopes, solution = chain.slopes, chain.motion
    speed, arrival, metres = chain.values.T
    # The arrival velocity points towards the wall: side * arrival is a speed, which must be equal to the entry speed.
    equation_residuals = series.sides[1:-1] * arrival[:-1] - speed[1:]
    # Derivatives of arrival minus entry speed at each inner impact.
    by = series.sides[1:-1, None] * slopes[:-1, 1]
    after = slopes[1:, 0]
    time_column = len(z) + 2
    first, second = by[:, time_column], by[:, time_column + 1]
    # Columns `time_column` and `time_column + 1` of the slopes are the derivatives by the times of start and end.
    by_time = _banded(len(times), first, second - after[:, time_column], -after[:, time_column + 1])
    by_x = by[:, :time_column] - after[:, :time_column]
    extra_variance = np.zeros_like(equation_residuals)
    if series.speeds is not None:
        # The last impact has no interval after it, so that its measured speed has no equation.
        equation_residuals = np.append(equation_residuals, metres - series.speeds[:-1])
        by_x = np.vstack([by_x, slopes[:, 2, :time_column]])
        by_time = scipy.sparse.vstack(
            [by_time, _banded(len(times), slopes[:, 2, time_column], slopes[:, 2, time_column + 1])]
        )
        extra_variance = np.append(extra_variance, np.full(len(metres), series.speed_error**2))
    has_motion = (
        np.isfinite(equation_residuals) & np.isfinite(by_x).all(axis=1) & np.isfinite(by_time @ np.ones(len(times)))
    )
    order, impact, _ = _in_order(series)
    return Equations(
        equation_residuals=equation_residuals[order],
        impact=impact,
        by_unknown=by_x[order, : len(z)],
        by_restitution=by_x[order, len(z) :],
        by_time=by_time.tocsr()[order],
        extra_variance=extra_variance[order],
        has_motion=has_motion[order],
        outside=np.asarray(solution.outside),
        speeds=np.append(speed, series.sides[-1] * arrival[-1]),
        speed_unit=float(model.device.speed_unit),
        motions=Motion(solution.speed, solution.contact_duration),
    )


def finite(matrix: Any) -> Any:
    """Copy a sparse matrix with 0 in place of values that are not finite."""
    matrix = matrix.copy()
    matrix.data = np.nan_to_num(matrix.data, nan=0.0, posinf=0.0, neginf=0.0)
    return matrix


def _banded(impacts: int, *bands: np.ndarray) -> Any:
    """Make the sparse derivatives of equations by consecutive times: bands on the diagonal and right of it."""
    rows = len(bands[0])
    return scipy.sparse.diags_array(bands, offsets=range(len(bands)), shape=(rows, impacts), format="csr")


def speed_equations(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """Return the impact of each equation, and the mask of the equations of measured speeds [equation]."""
    _, impact, about_speed = _in_order(series)
    return impact, about_speed


def _in_order(series: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort equations by their times, so that the nonzero elements of their covariance lie near the diagonal.

    Returns:
        The order, and in that order the impact of each equation and the mask of the equations of measured speeds.
    """
    inner, speeds = np.arange(1, series.times.size - 1), np.arange(series.equations - series.times.size + 2)
    impact = np.append(inner, speeds)
    about_speed = np.arange(impact.size) >= inner.size
    # The subtracted half sorts the agreement of the motions at an impact before the measured speed of that impact.
    order = np.argsort(impact - np.where(about_speed, 0.0, 0.5), kind="stable")
    return order, impact[order], about_speed[order]
