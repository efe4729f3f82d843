"""What least squares tell of a device: standard errors, what cannot be told, and whether restitution is constant."""

from typing import NamedTuple

import jax
import numpy as np

from vijax.fitting.adjustment import Settled
from vijax.fitting.fit_model import FitModel
from vijax.fitting.fitted import ConstancyTest, Fit, Misfit
from vijax.fitting.search import rises
from vijax.fitting.series import Series
from vijax.fitting.unknowns import made, natural, per_variable

# A combination of unknowns whose variable (a logarithm, mostly) is not known to this much is not told by the data: its
# standard error says nothing, as nothing is linear that far.
_UNTOLD = 0.25
# If it is not known to this much either, the data do not depend on it at all, and what is told of others stands.
_NOT_THERE = 1e3
# Unknowns with at least this part in such a combination are named with it.
_PART = 0.1
# Sums of squares that differ by less do not choose between two devices.
_SAME_FIT = 4.0
# Devices this many standard errors apart are two.
_APART = 3.0
# If more than this part of the equations does not hold, the device is another.
_MOST_LEFT_OUT = 1 / 3
# A misfit that chance makes this rarely is none of chance; one of so many standard errors tells of another device.
_IMPROBABLE, _WORST = 1e-3, 5.0
# A sum of squares that rises by less than this where it should by 4 is flatter than its derivatives say; and no flatter
# than can be told from rounding.
_FLATTER, _FLAT = 2.0, 1e-4
# A variable that is so near its limit has reached it.
_AT_LIMIT = 1e-3
# A derivative of which others leave less than this part is one of theirs.
_REST = 1e-6


class _Errors(NamedTuple):
    """How well variables are known: their covariance, infinite where they are not, and the combinations untold."""

    covariance: np.ndarray
    untold: tuple[tuple[str, ...], ...]


def told(model: FitModel, series: Series, ends: list[Settled], begin: np.ndarray) -> Fit:
    """Make the record of a fit.

    Args:
        model: What was fitted.
        series: What it was fitted to.
        ends: Where searches ended, the least sum of squares first.
        begin: Variables of the unknowns where they began: of devices that fit as well the nearest one is taken.
    """
    as_good = [end for end in ends if end.chi2 <= ends[0].chi2 + _SAME_FIT]
    end = min(as_good, key=lambda one: np.abs(one.z - begin).max()) if as_good else ends[0]
    covariance, untold = _errors(model, series, end)
    freedom = int(end.used.sum()) - len(model.names)
    misfit = Misfit(float((end.residuals**2).sum()), freedom)
    if misfit.p_value < _IMPROBABLE:
        # Errors are larger than was said, or the model is too poor; then so are those of the unknowns.
        covariance = covariance * misfit.size**2
    others = [one for one in as_good if one is not end and _apart(one.z - end.z, covariance)]
    spread = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        correlation = covariance / np.outer(spread, spread)
    known = model.device, model.names
    device = jax.tree.map(float, made(*known, end.z))
    astray = np.zeros(series.times.size, bool)
    astray[end.linear.impact[~end.counts]] = True
    return Fit(
        device=device,
        values=natural(*known, end.z),
        stderr=dict(zip(model.names, map(float, spread * per_variable(*known, end.z)), strict=True)),
        correlation=correlation,
        untold=untold,
        alternatives=tuple(natural(*known, other.z) for other in others),
        misfit=misfit,
        constancy=_constancy(model, end, float(device.speed_unit)),
        residuals=(series.times - end.times) / series.timing_error,
        speeds=end.linear.speeds * float(device.speed_unit),
        astray=astray,
        converged=end.held and bool((~end.counts).mean() <= _MOST_LEFT_OUT) and misfit.size < _WORST,
    )


def _errors(model: FitModel, series: Series, end: Settled) -> _Errors:
    """Find the covariance of variables from the derivatives of residuals by them, and from how the sum rises.

    The errors of the times make equations differ that would be one, as those of a motion that repeats: derivatives
    then seem to tell of what the sum of squares does not hang on. Two standard errors off it must rise by four.
    """
    names = model.names
    _, sizes, directions = np.linalg.svd(end.slopes, full_matrices=False)
    spreads = 1 / np.maximum(sizes, np.finfo(float).tiny)
    for k, (spread, way) in enumerate(zip(spreads, directions, strict=True)):
        if end.held and spread <= _UNTOLD:
            rise = rises(model, series, end, 2 * spread * way)
            spreads[k] = spread * np.sqrt(4 / max(rise, _FLAT)) if rise < _FLATTER else spread
    vague, absent = spreads > _UNTOLD, spreads > _NOT_THERE
    parts = [tuple(name for name, part in zip(names, way, strict=True) if abs(part) > _PART) for way in directions]
    # A value that ran to its limit is none.
    stuck = np.abs(model.limits - end.z).min(axis=0) < _AT_LIMIT
    untold = tuple(dict.fromkeys(part for part, one in zip(parts, vague, strict=True) if one))
    untold += tuple((name,) for name, one in zip(names, stuck, strict=True) if one)
    known = directions[~vague]
    covariance = (known.T * spreads[~vague] ** 2) @ known
    # What bends along with something vague is vague, too; of what is absent the others do not know.
    lost = set(names) if (vague & ~absent).any() or stuck.any() else {name for part in untold for name in part}
    for k, name in enumerate(names):
        if name in lost:
            covariance[k, :] = covariance[:, k] = np.nan
            covariance[k, k] = np.inf
    return _Errors(covariance, untold)


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
