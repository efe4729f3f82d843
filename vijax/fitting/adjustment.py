"""Adjustment of measured times to given unknowns: the least change, in standard errors, that fulfils all equations.

This is the Gauss-Helmert adjustment. With equations f(times, unknowns) = 0 linearised as f + B dt = 0 and the
covariance s^2 B B^T of B dt, the adjusted times are t - s^2 B^T (s^2 B B^T)^-1 f. The sum of squares of the change, in
standard errors, is the chi2 of the unknowns. An error of a time that two equations share counts once, so that the
standard errors of the unknowns are correct.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Motion
from vijax.fitting.series import Series
from vijax.fitting.time_equations import Equations, finite, linearise

# The adjustment ends if no time moves by more than `_STEP_TOLERANCE` of its error, after `_MOST_STEPS` steps, or if
# `_MOST_LARGER_STEPS` consecutive steps are larger than the smallest so far.
_STEP_TOLERANCE, _MOST_STEPS, _MOST_LARGER_STEPS = 1e-4, 40, 6
# Steps oscillate if one is not below `_SHRINKS` times the previous one; then `_HALF` of this and of every later step is
# taken.
_SHRINKS, _HALF = 0.5, 0.5
# No time moves by more than `_FARTHEST` of the interval to the next one; no variable by more than `_LONGEST` per step.
_FARTHEST, _LONGEST = 0.3, 0.2
# Relative increase of the diagonal of the covariance, so that it stays positive definite.
_DIAGONAL_INCREASE = 1e-9
# Residual, in standard errors, of an equation for which no motion between the impacts was found.
_NO_MOTION_RESIDUAL = 10.0


class Prior(NamedTuple):
    """Prior knowledge of the unknowns; it limits combinations of unknowns that the impacts do not determine.

    Attributes:
        z: Expected value of the search variable of each unknown (mostly the logarithm of the unknown).
        error: Standard error of each variable.
    """

    z: np.ndarray
    error: float


@dataclass
class _Steps:
    """Step control of an adjustment.

    Attributes:
        ends: Whether the adjustment ends.
        count: Number of steps.
        part: Fraction of the current step that is taken.
        last, least: Largest change of a time [s] in the last step, and in the smallest step.
        larger: Number of consecutive steps that are not smaller than the smallest.
    """

    ends: bool = False
    count: int = 0
    part: float = 1.0
    last: float = np.inf
    least: float = np.inf
    larger: int = 0

    def part_of(self, size: float, tolerance: float) -> float:
        """Return the fraction to take of a step with largest change `size` [s], and update the stopping conditions."""
        # A step hardly smaller than the previous one suggests that the steps oscillate about the solution. Half of it
        # is taken, because the middle of such a step is nearer to the solution than its end.
        self.part, self.last = (self.part if size < _SHRINKS * self.last else _HALF), size
        self.larger = 0 if size < self.least else self.larger + 1
        self.least, self.count = min(size, self.least), self.count + 1
        self.ends = size < tolerance or self.count == _MOST_STEPS or self.larger == _MOST_LARGER_STEPS
        return self.part


@dataclass(frozen=True)
class AdjustedTimes:
    """Times adjusted to given unknowns.

    Attributes:
        z: Search variable of each unknown (mostly the logarithm of the unknown).
        times: The adjusted times [s] [impact].
        linear: The equations, linearised at these unknowns and times.
        factor: Cholesky factor of the covariance of the equations, banded.
        equation_residuals: Residuals of the equations at the measured times, to first order [equation].
        by_time: Derivatives of the used equations by the times, sparse [equation, impact].
        counts: Mask of the equations that were not excluded beforehand.
        used: Mask of the counted equations for which a motion was found.
        unsettled: Mask of the counted equations that contain times that have not converged, or for which the motion was
            lost during the adjustment.
    """

    z: np.ndarray
    times: np.ndarray
    linear: Equations
    factor: np.ndarray
    equation_residuals: np.ndarray
    by_time: Any
    counts: np.ndarray
    used: np.ndarray
    unsettled: np.ndarray

    @property
    def is_consistent(self) -> bool:
        """Return True if all counted equations hold."""
        return not self.unsettled.any()

    def white(self, values: np.ndarray) -> np.ndarray:
        """Transform values of the equations [equation, ...] to independent errors of 1 (inverse Cholesky factor)."""
        used = self.used if values.ndim == 1 else self.used[:, None]
        return scipy.linalg.solve_banded((len(self.factor) - 1, 0), self.factor, np.where(used, values, 0.0))

    @property
    def residuals(self) -> np.ndarray:
        """Return the residuals of the equations, with independent errors of 1 [equation]."""
        return self.white(self.equation_residuals)

    @property
    def slopes(self) -> np.ndarray:
        """Return the derivatives of the residuals by the variables [equation, unknown]."""
        return self.white(self.linear.by_unknown)

    def step(self, prior: Prior, among: np.ndarray | None = None) -> np.ndarray:
        """Compute the step of the variables to the least sum of squares, to first order.

        Args:
            prior: Prior knowledge of the variables.
            among: Orthonormal directions that span the step [direction, unknown]; all by default.
        """
        basis = np.eye(self.z.size) if among is None else among
        slopes = np.vstack([self.slopes @ basis.T, np.eye(len(basis)) / prior.error])
        return np.linalg.lstsq(slopes, -np.append(self.residuals, basis @ (self.z - prior.z) / prior.error))[0] @ basis

    @property
    def penalised(self) -> np.ndarray:
        """Return the residuals, and one more residual that penalises the equations without a motion."""
        return np.append(self.residuals, _NO_MOTION_RESIDUAL * np.sqrt((self.counts & ~self.used).sum()))

    @property
    def variances(self) -> np.ndarray:
        """Return the variance of the residual of each equation at the measured times [equation]."""
        count = self.factor.shape[1]
        # The diagonal of L L^T: row sums of squares of L, stored by diagonals.
        squares = [np.append(np.zeros(k), row[: count - k] ** 2) for k, row in enumerate(self.factor)]
        return np.sum(squares, axis=0)

    @property
    def chi2(self) -> float:
        """Return the sum of the squared residuals; infinite if the equations do not hold."""
        return float(np.sum(self.residuals**2)) if self.is_consistent else np.inf


@dataclass(frozen=True)
class Adjustment:
    """Input of an adjustment: a model, the series for the fit, and the equations in use.

    Attributes:
        model: The model of the device.
        series: The measured impacts.
        soft: Tolerance of the equations, in units of A pi/omega; for equations of measured speeds, in m/s.
        excluded: Mask of the equations to leave out [equation]; None to use all equations.
    """

    model: FitModel
    series: Series
    soft: float = 0.0
    excluded: np.ndarray | None = None


def adjust_times(task: Adjustment, z: np.ndarray, times: np.ndarray, prior: Prior | None = None) -> AdjustedTimes:
    """Adjust times to given unknowns by Gauss-Newton steps.

    Args:
        task: Model and series.
        z: Variables of the unknowns.
        times: Initial onsets [s].
        prior: If specified, the unknowns are adjusted too, in the same steps; this is fast near the solution.
    """
    series, control = task.series, _Steps()
    intervals = np.diff(series.times)
    largest_change = _FARTHEST * np.minimum(np.append(intervals, np.inf), np.insert(intervals, 0, np.inf))
    tolerance = _STEP_TOLERANCE * series.timing_error
    is_lost, near_motions = False, None
    while not control.ends:
        # If the motion of an equation was lost once, the equation remains excluded. Otherwise it would be included and
        # excluded in turn, and the times would not converge.
        current = linearise_at(task, z, times, is_lost, near_motions)
        near_motions = current.linear.motions
        is_lost = current.counts & ~current.used
        equation_residuals, variable_step = current.equation_residuals, np.zeros_like(z)
        if prior is not None:
            variable_step = np.clip(z + np.clip(current.step(prior), -_LONGEST, _LONGEST), *task.model.limits) - z
            equation_residuals = equation_residuals + np.where(
                current.used, current.linear.by_unknown @ variable_step, 0.0
            )
        change = series.timing_error**2 * (
            current.by_time.T @ scipy.linalg.cho_solve_banded((current.factor, True), equation_residuals)
        )
        step = series.times - np.clip(change, -largest_change, largest_change) - times
        # `change` is the difference from the measured times, limited so that impacts keep their order; `step` is
        # relative to the current times.
        part = control.part_of(float(np.abs(step).max()), tolerance)
        times, z = times + part * step, z + part * variable_step
    # Equations that contain times with a last step above the tolerance.
    moving = current.by_time.astype(bool) @ (np.abs(step) >= tolerance)
    return replace(current, unsettled=is_lost | (current.counts & moving))


def linearise_at(
    task: Adjustment, z: np.ndarray, times: np.ndarray, is_lost: Any = False, near_motions: Motion | None = None
) -> AdjustedTimes:
    """Linearise the equations at given unknowns and times, without the equations in the mask `is_lost`."""
    series = task.series
    linear = linearise(task.model, series, z, times, near_motions)
    counts = np.ones(linear.equation_residuals.size, bool) if task.excluded is None else ~task.excluded
    used = linear.has_motion & counts & ~np.bool_(is_lost)
    by_time = scipy.sparse.diags_array(used.astype(float)) @ finite(linear.by_time)
    # Residual at the measured times, extrapolated from the current times.
    equation_residuals = np.where(used, linear.equation_residuals + by_time @ (series.times - times), 0.0)
    factor = _factor(series.timing_error**2 * (by_time @ by_time.T), linear.extra_variance + task.soft**2, used)
    return AdjustedTimes(z, times, linear, factor, equation_residuals, by_time, counts, used, counts)


def without_equations(series: Series, settled: AdjustedTimes, equations: np.ndarray) -> AdjustedTimes:
    """Return adjusted times without some equations; times and unknowns do not change.

    Args:
        series: The measured impacts.
        settled: Adjusted times that fulfil the equations.
        equations: Mask of the equations to exclude [equation].
    """
    used = settled.used & ~equations
    by_time = scipy.sparse.diags_array(used.astype(float)) @ settled.by_time
    factor = _factor(series.timing_error**2 * (by_time @ by_time.T), settled.linear.extra_variance, used)
    return replace(settled, factor=factor, by_time=by_time, used=used, counts=settled.counts & ~equations)


def _factor(shared: Any, extra_variance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Factorise the covariance, which has few nonzero diagonals; excluded equations get a variance of 1."""
    count = shared.shape[0]
    # Equations in order of their times share times with at most four neighbours on either side.
    width = min(5, count)
    bands = np.zeros((width, count))
    for k in range(width):
        bands[k, : count - k] = shared.diagonal(-k)
    bands[0] = np.where(used, bands[0] + extra_variance, 1.0)
    # Two equations with nearly the same times differ by rounding only. The larger diagonal keeps the factorisation
    # stable.
    bands[0] *= 1 + _DIAGONAL_INCREASE
    return scipy.linalg.cholesky_banded(bands, lower=True)
