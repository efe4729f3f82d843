"""What least squares tell of a device: standard errors, what cannot be told, and whether restitution is constant."""

import jax
import numpy as np

from vijax.fitting.adjustment import Settled
from vijax.fitting.errors import errors, widened
from vijax.fitting.fit_model import FitModel
from vijax.fitting.fitted import ConstancyTest, Fit, Misfit
from vijax.fitting.reliability import decisive_impacts
from vijax.fitting.search import SearchEnd
from vijax.fitting.series import Series
from vijax.fitting.unknowns import made, natural, per_variable

# The true device is among those that fit as well as the best one in so many cases.
_CONFIDENCE = 0.99
# Devices this many standard errors apart are two.
_APART = 3.0
# If more than this part of the equations does not hold, the device is another.
_MOST_LEFT_OUT = 1 / 3
# A misfit that chance makes this rarely is none of chance; one of so many standard errors tells of another device.
_IMPROBABLE, _WORST = 1e-3, 5.0
# A derivative of which others leave less than this part is one of theirs.
_REST = 1e-6


def told(model: FitModel, whole: Series, ends: list[SearchEnd], begin: np.ndarray) -> Fit:
    """Make the record of a fit.

    Args:
        model: What was fitted.
        whole: What it was fitted to.
        ends: Where searches ended, the least cost first.
        begin: Variables of the unknowns where they began: of devices that fit as well the nearest one is taken.
    """
    as_good = [found for found in ends if found.cost <= ends[0].cost + _same_fit(len(model.names))]
    best = min(as_good, key=lambda found: np.abs(found.end.z - begin).max())
    series, end = best.series, best.end
    decisive = decisive_impacts(series, end)
    near = errors(model, series, end, decisive)
    freedom = int(end.used.sum()) - len(model.names)
    misfit = Misfit(float((end.residuals**2).sum()), freedom)
    if misfit.p_value < _IMPROBABLE:
        # Errors are larger than was said, or the model is too poor; then so are those of the unknowns.
        near = near._replace(covariance=near.covariance * misfit.size**2)
    others = [found for found in as_good if found is not best and _apart(found.end.z - end.z, near.covariance)]
    covariance, untold = widened(model, near, *_between(best, others))
    spread = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        correlation = covariance / np.outer(spread, spread)
    known = model.device, model.names
    device = jax.tree.map(float, made(*known, end.z))
    return Fit(
        device=device,
        values=natural(*known, end.z),
        stderr=dict(zip(model.names, map(float, spread * per_variable(*known, end.z)), strict=True)),
        correlation=correlation,
        untold=untold,
        alternatives=tuple(natural(*known, other.end.z) for other in others),
        misfit=misfit,
        constancy=_constancy(model, end, float(device.speed_unit)),
        converged=bool(
            end.held and best.faulty <= 2 and (~end.counts).mean() <= _MOST_LEFT_OUT and misfit.size < _WORST
        ),
        **_of_impacts(whole, best, decisive, float(device.speed_unit)),
    )


def _of_impacts(whole: Series, found: SearchEnd, decisive: np.ndarray, speed_unit: float) -> dict[str, np.ndarray]:
    """Compute the attributes of a fit that have an entry for each measured impact."""
    end, real = found.end, np.flatnonzero(found.assignment.real)
    astray, rests_on = np.zeros((2, whole.times.size), bool)
    astray[real[end.linear.impact[~end.counts]]] = rests_on[real[decisive]] = True
    residuals, speeds = np.full((2, whole.times.size), np.nan)
    residuals[real] = (found.series.times - end.times) / whole.timing_error
    speeds[real] = end.linear.speeds * speed_unit
    false = ~found.assignment.real
    return {
        "residuals": residuals,
        "speeds": speeds,
        "astray": astray | false,
        "false": false,
        "decisive": rests_on,
    }


def _same_fit(unknowns: int) -> float:
    """Compute by how much costs may differ of devices between which the data do not choose."""
    from scipy.special import gammaincinv  # here, as importing vijax must not load it

    # Half of the quantile of chi2: the true device costs more than the best one by that.
    return float(gammaincinv(unknowns / 2, _CONFIDENCE))


def _between(best: SearchEnd, others: list[SearchEnd]) -> tuple[np.ndarray, np.ndarray]:
    """Return how other devices differ from the best one [device, unknown], and how probable they are [device]."""
    ways = np.array([found.end.z - best.end.z for found in others]).reshape(-1, best.end.z.size)
    costs = np.array([best.cost, *(found.cost for found in others)])
    weights = np.exp(costs.min() - costs)
    return ways, (weights / weights.sum())[1:]


def _apart(difference: np.ndarray, covariance: np.ndarray) -> bool:
    """Say whether two devices differ by more than their errors."""
    spread = np.sqrt(np.diag(covariance))
    known = np.isfinite(spread)
    return bool((np.abs(difference[known]) > _APART * spread[known]).any())


def _constancy(model: FitModel, end: Settled, speed_unit: float) -> ConstancyTest:
    """Test by one step of least squares whether a slope of r over the speed explains what is left."""
    offset, slope = end.white(end.linear.by_restitution).T
    others = end.slopes if "r" in model.names else np.column_stack([end.slopes, offset])
    rest = slope - others @ np.linalg.lstsq(others, slope)[0]
    size = np.linalg.norm(rest)
    if not size > _REST * np.linalg.norm(slope):
        return ConstancyTest(np.nan, np.inf)
    # Residuals of equations fall by their derivatives times what is added.
    return ConstancyTest(float(-(rest @ end.residuals) / size**2 / speed_unit), float(1 / size / speed_unit))
