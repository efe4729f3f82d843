"""Evaluation of a fit: standard errors, undetermined combinations, other devices, and the test of restitution."""

import jax
import numpy as np

from vijax.fitting.adjustment import AdjustedTimes
from vijax.fitting.fit_model import FitModel
from vijax.fitting.fit_result import ConstancyTest, Fit, Misfit
from vijax.fitting.least_squares import SearchEnd
from vijax.fitting.reliability import decisive_impacts
from vijax.fitting.series import Series
from vijax.fitting.standard_errors import errors, widen
from vijax.fitting.unknowns import device_with, per_variable, si_values

# Confidence level of the test whether another device fits as well as the device of least cost.
_CONFIDENCE = 0.99
# Devices that differ by more than this many standard errors are distinct.
_DISTINCT = 3.0
# Largest fraction of excluded equations of a converged fit.
_MOST_EXCLUDED = 1 / 3
# A misfit with a smaller p value is not by chance; residuals of `_WORST` stated errors indicate another device.
_IMPROBABLE, _WORST = 1e-3, 5.0
# A derivative is independent of other derivatives only if a larger fraction of its norm remains after their projection
# is removed.
_REST = 1e-6


def make_fit(model: FitModel, measured: Series, ends: list[SearchEnd], initial: np.ndarray) -> Fit:
    """Make the record of a fit.

    Args:
        model: The model of the device.
        measured: The measured impacts.
        ends: Results of the searches, the least cost first.
        initial: Variables of the device that the user specified. If several devices fit equally well, the device
            nearest to it is returned.
    """
    equally_good = [result for result in ends if result.cost <= ends[0].cost + _same_fit(len(model.names))]
    best = min(equally_good, key=lambda result: np.abs(result.end.z - initial).max())
    series, end = best.series, best.end
    decisive = decisive_impacts(series, end)
    near = errors(model, series, end, decisive)
    degrees_of_freedom = int(end.used.sum()) - len(model.names)
    misfit = Misfit(float((end.residuals**2).sum()), degrees_of_freedom)
    if misfit.p_value < _IMPROBABLE:
        # The errors of the times are larger than stated, or the model is incomplete. The errors of the unknowns are
        # scaled accordingly.
        near = near._replace(covariance=near.covariance * misfit.size**2)
    others = [
        result for result in equally_good if result is not best and _differ(result.end.z - end.z, near.covariance)
    ]
    covariance, undetermined = widen(model, near, *_between(best, others))
    spread = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        correlation = covariance / np.outer(spread, spread)
    device_and_names = model.device, model.names
    device = jax.tree.map(float, device_with(*device_and_names, end.z))
    return Fit(
        device=device,
        values=si_values(*device_and_names, end.z),
        stderr=dict(zip(model.names, map(float, spread * per_variable(*device_and_names, end.z)), strict=True)),
        correlation=correlation,
        undetermined=undetermined,
        alternatives=tuple(si_values(*device_and_names, other.end.z) for other in others),
        misfit=misfit,
        constancy=_constancy(model, end, float(device.speed_unit)),
        converged=bool(
            end.is_consistent and best.faulty <= 2 and (~end.counts).mean() <= _MOST_EXCLUDED and misfit.size < _WORST
        ),
        **_of_impacts(measured, best, decisive, float(device.speed_unit)),
    )


def _of_impacts(measured: Series, result: SearchEnd, decisive: np.ndarray, speed_unit: float) -> dict[str, np.ndarray]:
    """Compute the attributes of a fit that have an entry for each measured impact."""
    end, real = result.end, np.flatnonzero(result.assignment.real)
    is_excluded, is_decisive = np.zeros((2, measured.times.size), bool)
    is_excluded[real[end.linear.impact[~end.counts]]] = is_decisive[real[decisive]] = True
    residuals, speeds = np.full((2, measured.times.size), np.nan)
    residuals[real] = (result.series.times - end.times) / measured.timing_error
    speeds[real] = end.linear.speeds * speed_unit
    false = ~result.assignment.real
    return {
        "residuals": residuals,
        "speeds": speeds,
        "excluded": is_excluded | false,
        "false": false,
        "decisive": is_decisive,
    }


def _same_fit(unknowns: int) -> float:
    """Return the largest difference of costs between devices that the data do not distinguish."""
    from scipy.special import gammaincinv  # imported here, because `import vijax` must not load SciPy

    # Half of the quantile of chi2: with probability `_CONFIDENCE`, the cost of the true device exceeds the least cost
    # by at most this.
    return float(gammaincinv(unknowns / 2, _CONFIDENCE))


def _between(best: SearchEnd, others: list[SearchEnd]) -> tuple[np.ndarray, np.ndarray]:
    """Return the differences of other devices from the best one [device, unknown], and their probabilities [device]."""
    differences = np.array([result.end.z - best.end.z for result in others]).reshape(-1, best.end.z.size)
    costs = np.array([best.cost, *(result.cost for result in others)])
    weights = np.exp(costs.min() - costs)
    return differences, (weights / weights.sum())[1:]


def _differ(difference: np.ndarray, covariance: np.ndarray) -> bool:
    """Return True if two devices differ by more than their errors."""
    spread = np.sqrt(np.diag(covariance))
    is_determined = np.isfinite(spread)
    return bool((np.abs(difference[is_determined]) > _DISTINCT * spread[is_determined]).any())


def _constancy(model: FitModel, end: AdjustedTimes, speed_unit: float) -> ConstancyTest:
    """Test by one step of least squares whether a slope of r over the speed explains the residuals."""
    offset, slope = end.white(end.linear.by_restitution).T
    others = end.slopes if "r" in model.names else np.column_stack([end.slopes, offset])
    rest = slope - others @ np.linalg.lstsq(others, slope)[0]
    size = np.linalg.norm(rest)
    if not size > _REST * np.linalg.norm(slope):
        return ConstancyTest(np.nan, np.inf)
    # The estimate is minus the residuals projected on the independent part of the derivative, over its squared norm.
    return ConstancyTest(float(-(rest @ end.residuals) / size**2 / speed_unit), float(1 / size / speed_unit))
