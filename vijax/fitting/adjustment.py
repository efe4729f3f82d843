"""Times adjusted to some unknowns: moved as little, within their errors, as makes all equations hold.

Gauss and Helmert's adjustment. What it takes, in standard errors, says how badly the unknowns fit; an error of a time
that two equations share is counted once, so that the standard errors of the unknowns are right.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Motion
from vijax.fitting.mismatch import Equations, finite, linearised
from vijax.fitting.series import Series

# The adjustment ends when no time moves by this part of its error any more, after so many steps, and when so many steps
# in a row are larger than one before.
_SETTLED, _MOST_STEPS, _PATIENCE = 1e-4, 40, 6
# Steps that shrink by less are swinging.
_SHRINKS, _HALF = 0.5, 0.5
# No time moves by more than this part of the way to the next one, and no variable by more in one step.
_FARTHEST, _LONGEST = 0.3, 0.2
# By what part the variance of an equation is its own at least.
_INDEPENDENT = 1e-9
# An equation without a motion counts as one that is missed by so many standard errors.
_UNANSWERED = 10.0


class Prior(NamedTuple):
    """What is known of the unknowns before the impacts: combinations that these do not tell stay near it.

    Attributes:
        z: Their variables.
        error: The standard error of each.
    """

    z: np.ndarray
    error: float


@dataclass
class _Steps:
    """Steps of an adjustment: which part of each is taken, and when they end."""

    ends: bool = False
    taken: int = 0
    part: float = 1.0
    last: float = np.inf
    least: float = np.inf
    larger: int = 0

    def part_of(self, size: float, enough: float) -> float:
        """Return the part of a step that is taken."""
        # Steps that swing to and fro are halved: their mean lies nearer.
        self.part, self.last = (self.part if size < _SHRINKS * self.last else _HALF), size
        self.larger = 0 if size < self.least else self.larger + 1
        self.least, self.taken = min(size, self.least), self.taken + 1
        self.ends = size < enough or self.taken == _MOST_STEPS or self.larger == _PATIENCE
        return self.part


@dataclass(frozen=True)
class Settled:
    """Times adjusted to some unknowns.

    Attributes:
        z: Variables of the unknowns.
        times: As adjusted [s] [impact].
        linear: The equations there.
        factor: Cholesky factor of their covariance, banded.
        off: What the measured times miss them by, to first order [equation].
        kept: Derivatives of those that are used by the times, sparse [equation, impact].
        counts: Which of them were not put aside before.
        used: Which of those have a motion.
        restless: Which of them read times that the adjustment did not bring to rest.
    """

    z: np.ndarray
    times: np.ndarray
    linear: Equations
    factor: np.ndarray
    off: np.ndarray
    kept: Any
    counts: np.ndarray
    used: np.ndarray
    restless: np.ndarray

    @property
    def held(self) -> bool:
        """Say whether all equations hold that count."""
        return not self.restless.any()

    def white(self, values: np.ndarray) -> np.ndarray:
        """Bring values of the equations [equation, ...] to independent errors of 1."""
        used = self.used if values.ndim == 1 else self.used[:, None]
        return scipy.linalg.solve_banded((len(self.factor) - 1, 0), self.factor, np.where(used, values, 0.0))

    @property
    def residuals(self) -> np.ndarray:
        """Compute what the equations are missed by, with independent errors of 1 [equation]."""
        return self.white(self.off)

    @property
    def slopes(self) -> np.ndarray:
        """Compute the derivatives of the residuals by the variables [equation, unknown]."""
        return self.white(self.linear.by_unknown)

    def step(self, prior: Prior, among: np.ndarray | None = None) -> np.ndarray:
        """Compute the step of the variables to the least sum of squares, to first order.

        Args:
            prior: What is known of them beforehand.
            among: Orthonormal directions among which the step lies [direction, unknown]; all unless given.
        """
        basis = np.eye(self.z.size) if among is None else among
        slopes = np.vstack([self.slopes @ basis.T, np.eye(len(basis)) / prior.error])
        return np.linalg.lstsq(slopes, -np.append(self.residuals, basis @ (self.z - prior.z) / prior.error))[0] @ basis

    @property
    def penalised(self) -> np.ndarray:
        """Give the residuals, and one more of the equations that no motion answers."""
        return np.append(self.residuals, _UNANSWERED * np.sqrt((self.counts & ~self.used).sum()))

    @property
    def variances(self) -> np.ndarray:
        """Compute the variance of what the measured times miss each equation by [equation]."""
        count = self.factor.shape[1]
        squares = [np.append(np.zeros(k), row[: count - k] ** 2) for k, row in enumerate(self.factor)]
        return np.sum(squares, axis=0)

    @property
    def chi2(self) -> float:
        """Sum the squares of the residuals; infinite where the equations do not hold."""
        return float(np.sum(self.residuals**2)) if self.held else np.inf


@dataclass(frozen=True)
class Adjustment:
    """What is fitted to what.

    Attributes:
        model: What is fitted.
        series: What it is fitted to.
        soft: To within what equations are kept, in units of A pi/omega; of speeds, in m/s.
        aside: Which of them do not count [equation]; None for none.
    """

    model: FitModel
    series: Series
    soft: float = 0.0
    aside: np.ndarray | None = None


def settle(task: Adjustment, z: np.ndarray, times: np.ndarray, prior: Prior | None = None) -> Settled:
    """Adjust times to unknowns, from times to begin with.

    Args:
        task: What is fitted to what.
        z: Variables of the unknowns.
        times: Onsets to begin with [s].
        prior: What is known of the unknowns, to adjust them as well, in the same steps, which is quick near the right
            ones.
    """
    series, motion = task.series, _Steps()
    gaps = np.diff(series.times)
    most = _FARTHEST * np.minimum(np.append(gaps, np.inf), np.insert(gaps, 0, np.inf))
    enough = _SETTLED * series.timing_error
    lost, near = False, None
    while not motion.ends:
        # An equation that once had no motion stays away: it would come and go, and no time would come to rest.
        now = adjusted(task, z, times, lost, near)
        near = now.linear.motions
        lost = now.counts & ~now.used
        off, farther = now.off, np.zeros_like(z)
        if prior is not None:
            farther = np.clip(z + np.clip(now.step(prior), -_LONGEST, _LONGEST), *task.model.limits) - z
            off = off + np.where(now.used, now.linear.by_unknown @ farther, 0.0)
        moved = series.timing_error**2 * (now.kept.T @ scipy.linalg.cho_solve_banded((now.factor, True), off))
        step = series.times - np.clip(moved, -most, most) - times
        part = motion.part_of(float(np.abs(step).max()), enough)
        times, z = times + part * step, z + part * farther
    resting = now.kept.astype(bool) @ (np.abs(step) >= enough)
    return replace(now, restless=lost | (now.counts & resting))


def adjusted(
    task: Adjustment, z: np.ndarray, times: np.ndarray, lost: Any = False, near: Motion | None = None
) -> Settled:
    """Linearise about unknowns and times, which are not yet at rest, without what was lost."""
    series = task.series
    linear = linearised(task.model, series, z, times, near)
    counts = np.ones(linear.off.size, bool) if task.aside is None else ~task.aside
    used = linear.answered & counts & ~np.bool_(lost)
    kept = scipy.sparse.diags_array(used.astype(float)) @ finite(linear.by_time)
    off = np.where(used, linear.off + kept @ (series.times - times), 0.0)
    factor = _factor(series.timing_error**2 * (kept @ kept.T), linear.own_variance + task.soft**2, used)
    return Settled(z, times, linear, factor, off, kept, counts, used, counts)


def without(series: Series, found: Settled, equations: np.ndarray) -> Settled:
    """Return adjusted times without some equations; times and unknowns stay.

    Args:
        series: What was fitted.
        found: Where the equations hold.
        equations: Which are left out [equation].
    """
    used = found.used & ~equations
    kept = scipy.sparse.diags_array(used.astype(float)) @ found.kept
    factor = _factor(series.timing_error**2 * (kept @ kept.T), found.linear.own_variance, used)
    return replace(found, factor=factor, kept=kept, used=used, counts=found.counts & ~equations)


def _factor(shared: Any, own: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Factorise a covariance, of which a few diagonals are not 0; equations that do not count are on their own."""
    count = shared.shape[0]
    width = min(5, count)
    bands = np.zeros((width, count))
    for k in range(width):
        bands[k, : count - k] = shared.diagonal(-k)
    bands[0] = np.where(used, bands[0] + own, 1.0)
    # Equations that read nearly the same are told apart by rounding alone.
    bands[0] *= 1 + _INDEPENDENT
    return scipy.linalg.cholesky_banded(bands, lower=True)
