"""Comparison of soft and rigid walls on the same axes: cells where the cheaper rigid model is accurate enough.

Each cell is classified as rigid, soft or undecided by the relative difference |P_rigid - P_soft|/P_soft and its
standard error. `plan` only validates the arguments, `run` simulates a plan, `compare` does both; `cheapest_model` and
`rigid_from` evaluate a completed comparison.
"""

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.maps import sweep
from vijax.maps.axes import Axes
from vijax.maps.map_dataset import DEFAULT, SweepPlan
from vijax.maps.outputs import flagged
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.choices import Precision, Until, Walls
from vijax.model.device import Harvester
from vijax.model.label import order_counts
from vijax.model.pair import has_mirror_symmetry
from vijax.model.quantities import both_walls_name, synonyms
from vijax.model.records import USABLE_STATUSES, Status
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

_WALLS: tuple[Walls, ...] = ("soft", "rigid")
COMPARED = ("P", "P_stderr", "period", "impacts_left", "impacts_right", "status")
# A cell is classified only if it lies above or below the tolerance by this number of standard errors. With two, chance
# would misclassify some of the thousands of cells of a plane.
N_STDERR = 3.0
# Statuses of cells with a P that can be compared. Cells with another status have no P, or a P that still drifts.
_MEASURABLE = (*USABLE_STATUSES, Status.NO_IMPACT, Status.PERMANENT_CONTACT)


class LabelAgreement(enum.IntEnum):
    """Codes of the variable `label`: whether the attractor has the same label n:m/pT with soft and with rigid walls.

    In a label, n and m are the numbers of impacts on the two walls in p forcing periods.
    """

    DIFFERS = 0
    AGREES = 1
    UNDECIDED = 2


class CheapestModel(enum.IntEnum):
    """Codes of the variable `cheapest_model`: the cheapest model of a cell that is accurate enough."""

    RIGID = 0
    SOFT = 1
    UNDECIDED = 2


@dataclass(frozen=True)
class Comparison:
    """A validated comparison: the plans of both sweeps, and the tolerance if one was specified."""

    soft: SweepPlan
    rigid: SweepPlan
    tolerance: float | None

    @property
    def count(self) -> int:
        """Number of simulations with soft walls plus the number with rigid walls."""
        return self.soft.cells.count + self.rigid.cells.count


@public_api
def compare(
    *,
    tolerance: float | None = None,
    periods: int = SweepSettings.periods,
    until: Until = SweepSettings.until,
    transient: int = SweepSettings.transient,
    device: Harvester | None = None,
    dtype: Precision = SweepSettings.dtype,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Axes],
) -> "xr.Dataset":
    """Map how P and the label of every cell differ between rigid and soft walls: `|P_rigid - P_soft|/P_soft`.

    ::

        found = compare(d=np.linspace(0.05, 0.3, 96), kappa=np.geomspace(3, 4000, 96), tolerance=0.05)
        found.rigid_from  # above this kappa, over d, the rigid wall changes P by at most 5 %

    The simulations of a cell with soft and with rigid walls have the same start. If attractors coexist, the two motions
    may end on different ones; the difference in P then compares attractors and not stiffnesses of the wall. Cells that
    differ in kappa alone share one simulation with rigid walls.

    Args:
        tolerance: Largest acceptable relative difference in P, 0.05 for 5 %. If it is given, the result contains
            `cheapest_model` and `rigid_from` too.
        periods, until, transient, device, dtype, progress, axes: As in `sweep`; every start must lie within the gap.
            Labels require until="attractor".

    Returns:
        `relative_difference`, its standard error (0 where both motions are periodic), `label` (differs, agrees,
        undecided), and P, P_stderr, period, impacts and status with each kind of wall as `P_soft`, `P_rigid`, ... A
        difference below three standard errors may be noise alone. The difference is 0 where neither model yields any
        energy, inf where only the rigid model yields energy, NaN where a cell failed. With a tolerance also the results
        of `cheapest_model` and, if there is an axis of stiffness, `rigid_from`.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.

    Source: Eqs. (36)-(38), corrected; a rigid wall's penetration by Eq. (35).
    """
    settings = SweepSettings(periods=periods, until=until, transient=transient, dtype=dtype)
    return run(plan(axes, tolerance, device, settings), progress)


@public_api
def plan(
    axes: Mapping[str, Any],
    tolerance: float | None = None,
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
) -> Comparison:
    """Validate the arguments of a comparison and lay out its cells; simulates nothing.

    Args:
        axes, tolerance, device: As in `compare`.
        settings: Only periods, until, transient and dtype may differ from their defaults.

    Raises:
        ValueError, TypeError: If an argument is invalid; the message states the requirement and the value.
    """
    if tolerance is not None:
        tolerance = _validate_tolerance(tolerance)
    for name in axes:
        if axes[name] is not None and both_walls_name(name) in synonyms("kappa"):
            raise ValueError(f"{name} must be left out of a comparison: its rigid walls share one membrane")
    settings.require_defaults_except("a comparison", "periods", "until", "transient", "dtype")
    # Two plans over the same axes. kappa does not affect the motion between rigid walls, so the plan with rigid walls
    # may have fewer simulations.
    soft, rigid = (sweep.plan(axes, COMPARED, device, replace(settings, wall=wall)) for wall in _WALLS)
    return Comparison(soft, rigid, tolerance)


def _validate_tolerance(tolerance: Any) -> float:
    """Return a tolerance as a float; raise ValueError unless it is positive and finite."""
    must = "a positive number, a part of P (0.05 for 5 %)"
    return validation.validate_real("tolerance", tolerance, must, lambda x: 0 < x < np.inf)


@public_api
def run(plan: Comparison, progress: Callable[[int, int], None] | None = None) -> "xr.Dataset":
    """Simulate the cells of a plan, soft cells first, and return the comparison; see `compare`."""
    before = plan.soft.cells.count

    validation.validate_callable("progress", progress)

    def progress_from(offset: int) -> Callable[[int, int], None] | None:
        return progress and (lambda done, _: progress(offset + done, plan.count))

    soft, rigid = sweep.run(plan.soft, progress_from(0)), sweep.run(plan.rigid, progress_from(before))
    compared = {f"{name}_{wall}": of[name] for name in COMPARED for wall, of in (("soft", soft), ("rigid", rigid))}
    for name, variable in compared.items():
        variable.attrs["long_name"] += f", {name.rpartition('_')[2]} walls"
    comparison = soft.drop_vars(COMPARED).assign(compared)
    comparison = comparison.assign(_difference(comparison) | {"label": _label(comparison)})
    comparison.attrs |= {"title": "Power and label by rigid walls against soft ones", "wall": "soft against rigid"}
    # The outputs of the soft sweep are not the outputs of the comparison.
    del comparison.attrs["outputs"]
    return comparison if plan.tolerance is None else _with_cheapest_model(comparison, plan.tolerance)


def _difference(comparison: "xr.Dataset") -> "dict[str, xr.DataArray]":
    """Compute the relative difference in P and its standard error.

    The error is the first-order standard error of the ratio P_rigid/P_soft.
    """
    soft, rigid = comparison["P_soft"], comparison["P_rigid"]
    with np.errstate(divide="ignore", invalid="ignore"):
        # 0/0, where neither model yields energy, counts as no difference.
        difference = (abs(rigid - soft) / soft).where((soft != 0) | (rigid != 0), 0.0)
        # First-order error of the ratio R = P_rigid/P_soft: dP_rigid/P_soft and R dP_soft/P_soft, added in quadrature.
        parts = comparison["P_stderr_rigid"] / soft, rigid / soft * comparison["P_stderr_soft"] / soft
        error = (parts[0] ** 2 + parts[1] ** 2) ** 0.5
    # Where the soft model yields no energy, the difference is 0 or infinite, both without uncertainty.
    error = error.where(soft != 0, 0.0)
    difference.attrs = {"units": "1", "long_name": "relative difference in P, |P_rigid - P_soft| / P_soft"}
    error.attrs = {"units": "1", "long_name": "standard error of the relative difference in P, 0 when periodic"}
    return {"relative_difference": difference, "relative_difference_stderr": error}


def _label(comparison: "xr.Dataset") -> "xr.DataArray":
    """Return whether soft and rigid walls give the same period and impact counts, as flags of `LabelAgreement`.

    If the impact pair is symmetric (gamma = 0 and equal walls), a motion and its mirror image count as equal.
    """
    soft, rigid = (
        [comparison[f"{name}_{wall}"] for name in ("period", "impacts_left", "impacts_right")]
        for wall in ("soft", "rigid")
    )
    (soft_few, soft_many), (rigid_few, rigid_many) = (
        # Ordered impact counts are equal for mirror images. They are ordered only where the pair is symmetric.
        order_counts(count_left, count_right, has_mirror_symmetry(comparison))
        for _, count_left, count_right in (soft, rigid)
    )
    agrees = (soft[0] == rigid[0]) & (soft_few == rigid_few) & (soft_many == rigid_many)
    # A period of -1 is undecided.
    both_decided = (soft[0] >= 0) & (rigid[0] >= 0)
    return _flags(
        agrees.where(both_decided, LabelAgreement.UNDECIDED),
        LabelAgreement,
        "whether period and impacts agree, mirror images as one",
        comparison,
    )


def cheapest_model(comparison: "xr.Dataset", tolerance: float) -> "xr.DataArray":
    """Return the cheapest model of every cell with a P within a relative tolerance of P_soft: rigid or soft.

    With the relative difference D in P and its standard error e, a cell is rigid if D + 3 e is at most the tolerance,
    and soft if D - 3 e exceeds it. All other cells are undecided, and so are cells with a simulation that did not
    complete.

    Args:
        comparison: The dataset returned by `compare`.
        tolerance: Largest acceptable relative difference in P, > 0.

    Returns:
        CF flags, the values of `CheapestModel`.

    Raises:
        ValueError: If the tolerance is not a positive number.
    """
    tolerance = _validate_tolerance(tolerance)
    validation.validate_dataset(
        "comparison", comparison, ("relative_difference", "relative_difference_stderr", "status_soft"), "compare"
    )
    difference, uncertainty = comparison["relative_difference"], N_STDERR * comparison["relative_difference_stderr"]
    ended = comparison["status_soft"].isin(_MEASURABLE) & comparison["status_rigid"].isin(_MEASURABLE)
    # If neither condition holds, the tolerance lies within the uncertainty of the difference, and the cell is
    # undecided.
    within, exceeds = difference + uncertainty <= tolerance, difference - uncertainty > tolerance
    cheapest = exceeds.astype(np.int8).where(ended & (within | exceeds), CheapestModel.UNDECIDED)
    cheapest = _flags(cheapest, CheapestModel, f"cheapest model whose P is within {100 * tolerance:.6g} %", comparison)
    cheapest.attrs["tolerance"] = tolerance
    return cheapest


def rigid_from(cheapest: "xr.DataArray") -> "xr.DataArray | None":
    """Return the least stiffness such that the rigid model is enough there and in all stiffer cells; NaN if none.

    Some softer cells may be classified as rigid by coincidence, because the difference in P is small where it changes
    its sign. They are ignored.

    Args:
        cheapest: The array returned by `cheapest_model`.

    Returns:
        Values of the axis kappa, omega0 or k over the other axes; None if there is no such axis.
    """
    if not validation.is_data_array(cheapest) or cheapest.attrs.get("flag_meanings") != _meanings(CheapestModel):
        raise ValueError(f"cheapest must be what vijax.cheapest_model returned; got {validation.value_text(cheapest)}")
    # The stiffness axis has the name of the quantity that the user specified: kappa, omega0 or k.
    axis = next((dim for dim in cheapest.dims if dim in synonyms("kappa")), None)
    if axis is None:
        return None
    # From the stiffest cell down, the cumulative product is 1 until the first cell where the rigid model is not enough.
    enough = (cheapest == CheapestModel.RIGID).sortby(axis, ascending=False)
    onset = enough[axis].where(enough.astype(int).cumprod(axis) == 1).min(axis)
    onset.attrs = {
        "axis": axis,
        "units": enough[axis].attrs["units"],
        "long_name": f"least {axis} from which on the rigid model is enough",
    }
    return onset


def _with_cheapest_model(comparison: "xr.Dataset", tolerance: float) -> "xr.Dataset":
    """Add `cheapest_model` and, if there is an axis of stiffness, `rigid_from` to a comparison."""
    cheapest = cheapest_model(comparison, tolerance)
    onset = rigid_from(cheapest)
    comparison = comparison.assign(cheapest_model=cheapest)
    return comparison if onset is None else comparison.assign(rigid_from=onset)


def _flags(
    values: "xr.DataArray", kinds: type[enum.IntEnum], long_name: str, comparison: "xr.Dataset"
) -> "xr.DataArray":
    """Return codes as CF flags, with dimensions in the order of the comparison."""
    values = values.transpose(*(dim for dim in comparison["P_soft"].dims if dim in values.dims))
    values.attrs = {"units": "1", "long_name": long_name}
    return flagged(values, kinds)


def _meanings(kinds: type[enum.IntEnum]) -> str:
    """Return the CF attribute `flag_meanings` of an enumeration."""
    return " ".join(kind.name.lower() for kind in kinds)
