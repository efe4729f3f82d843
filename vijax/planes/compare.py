"""Soft walls against rigid ones on the same axes: where is the rigid model enough?

`plan` checks and starts nothing, `run` does the work, `compare` is both; `cheapest_model` and `rigid_from` ask the
finished comparison.
"""

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.model.choices import Precision, Until, Walls
from vijax.model.device import Harvester
from vijax.model.label import ordered
from vijax.model.pair import symmetric
from vijax.model.quantities import of_both_walls, synonyms
from vijax.model.records import SETTLED, Status
from vijax.planes import sweep
from vijax.planes.axes import Axes
from vijax.planes.dataset import DEFAULT, SweepPlan
from vijax.planes.outputs import flagged
from vijax.planes.sweep_settings import SweepSettings
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

_WALLS: tuple[Walls, ...] = ("soft", "rigid")
COMPARED = ("P", "P_stderr", "period", "impacts_left", "impacts_right", "status")
# Standard errors at which a verdict has to hold still: of a plane of thousands of cells two would often fail by chance.
SURE = 3.0
# Ends of cells that have a P to judge by: otherwise there is none, or it still drifts.
_ENDED = (*SETTLED, Status.NO_IMPACT, Status.PERMANENT_CONTACT)


class Label(enum.IntEnum):
    """Whether soft and rigid walls give the same attractor label n:m/pT; the values of the variable `label`."""

    DIFFERS = 0
    AGREES = 1
    UNDECIDED = 2


class Model(enum.IntEnum):
    """What a cell needs; the values of the variable `cheapest_model`."""

    RIGID = 0
    SOFT = 1
    UNDECIDED = 2


@dataclass(frozen=True)
class Comparison:
    """A comparison that has passed the door: both sweeps, and the tolerance if one was given."""

    soft: SweepPlan
    rigid: SweepPlan
    tolerance: float | None

    @property
    def count(self) -> int:
        """Count the simulations, of both kinds of wall."""
        return self.soft.cells.count + self.rigid.cells.count


@door
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
    """Map how much a rigid wall changes the power and the label of every cell, `|P_rigid - P_soft|/P_soft`.

    ::

        found = compare(d=np.linspace(0.05, 0.3, 96), kappa=np.geomspace(3, 4000, 96), tolerance=0.05)
        found.rigid_from  # kappa from which on the rigid wall keeps P within 5 %, over d

    Both walls start alike. Where attractors coexist they may settle on different ones, and the difference says so
    rather than how stiff the wall is. Rigid cells that differ in kappa alone are one simulation.

    Args:
        tolerance: Largest relative difference in P to put up with, 0.05 for 5 %; gives `cheapest_model`, `rigid_from`.
        periods, until, transient, device, dtype, progress, axes: As in `sweep`; every start within the gap. Labels want
            until="attractor".

    Returns:
        `relative_difference`, its standard error (0 where both motions are periodic), `label` (differs, agrees,
        undecided), and P, P_stderr, period, impacts and status of both as `P_soft`, `P_rigid`, ... A difference below
        three standard errors may be noise alone. 0 where neither model yields any energy, inf where the rigid one
        alone does, NaN where a cell failed. With a tolerance also what `cheapest_model` and, of an axis of stiffness,
        `rigid_from` return.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.

    Source: Eqs. (36)-(38), corrected; a rigid wall's penetration by Eq. (35).
    """
    settings = SweepSettings(periods=periods, until=until, transient=transient, dtype=dtype)
    return run(plan(axes, tolerance, device, settings), progress)


@door
def plan(
    axes: Mapping[str, Any],
    tolerance: float | None = None,
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
) -> Comparison:
    """Check what a comparison is asked for and lay out its cells; runs nothing.

    Args:
        axes, tolerance, device: As in `compare`.
        settings: Of these periods, until, transient and dtype are read.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    if tolerance is not None:
        tolerance = _checked(tolerance)
    for name in axes:
        if axes[name] is not None and of_both_walls(name) in synonyms("kappa"):
            raise ValueError(f"{name} must be left out of a comparison, whose rigid walls are lent one membrane")
    settings.only("a comparison", "periods", "until", "transient", "dtype")
    soft, rigid = (sweep.plan(axes, COMPARED, device, replace(settings, wall=wall)) for wall in _WALLS)
    return Comparison(soft, rigid, tolerance)


def _checked(tolerance: Any) -> float:
    must = "a positive number, a part of P (0.05 for 5 %)"
    return checks.real("tolerance", tolerance, must, lambda x: 0 < x < np.inf)


@door
def run(planned: Comparison, progress: Callable[[int, int], None] | None = None) -> "xr.Dataset":
    """Run the comparison of a plan, soft cells first; see `compare`."""
    before = planned.soft.cells.count

    checks.function("progress", progress)

    def tell(offset: int) -> Callable[[int, int], None] | None:
        return progress and (lambda done, _: progress(offset + done, planned.count))

    soft, rigid = sweep.run(planned.soft, tell(0)), sweep.run(planned.rigid, tell(before))
    both = {f"{name}_{wall}": of[name] for name in COMPARED for wall, of in (("soft", soft), ("rigid", rigid))}
    for name, variable in both.items():
        variable.attrs["long_name"] += f", {name.rpartition('_')[2]} walls"
    found = soft.drop_vars(COMPARED).assign(both)
    found = found.assign(_difference(found) | {"label": _label(found)})
    found.attrs |= {"title": "Power and label by rigid walls against soft ones", "wall": "soft against rigid"}
    del found.attrs["outputs"]
    return found if planned.tolerance is None else _judged(found, planned.tolerance)


def _difference(found: "xr.Dataset") -> "dict[str, xr.DataArray]":
    """Compute the relative difference in P and its standard error, to first order that of the ratio of both P."""
    soft, rigid = found["P_soft"], found["P_rigid"]
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = (abs(rigid - soft) / soft).where((soft != 0) | (rigid != 0), 0.0)
        parts = found["P_stderr_rigid"] / soft, rigid / soft * found["P_stderr_soft"] / soft
        error = (parts[0] ** 2 + parts[1] ** 2) ** 0.5
    # A cell without energy has no doubt about it, and against none any other is infinitely more.
    error = error.where(soft != 0, 0.0)
    difference.attrs = {"units": "1", "long_name": "relative difference in P, |P_rigid - P_soft| / P_soft"}
    error.attrs = {"units": "1", "long_name": "standard error of the relative difference in P, 0 when periodic"}
    return {"relative_difference": difference, "relative_difference_stderr": error}


def _label(found: "xr.Dataset") -> "xr.DataArray":
    """Compare periods and impact counts; without gravity mirror images, their sides exchanged, count as one."""
    soft, rigid = (
        [found[f"{name}_{wall}"] for name in ("period", "impacts_left", "impacts_right")] for wall in ("soft", "rigid")
    )
    (soft_few, soft_many), (rigid_few, rigid_many) = (
        ordered(left, right, symmetric(found)) for _, left, right in (soft, rigid)
    )
    agrees = (soft[0] == rigid[0]) & (soft_few == rigid_few) & (soft_many == rigid_many)
    known = (soft[0] >= 0) & (rigid[0] >= 0)
    return _flags(
        agrees.where(known, Label.UNDECIDED), Label, "whether period and impacts agree, mirror images as one", found
    )


def cheapest_model(found: "xr.Dataset", tolerance: float) -> "xr.DataArray":
    """Find the cheaper of the rigid and the soft model whose P is within a relative tolerance, in every cell.

    Rigid or soft only if three standard errors do not change the verdict and both cells came to an end; undecided
    otherwise.

    Args:
        found: What `compare` returned.
        tolerance: Largest relative difference in P to put up with, > 0.

    Returns:
        CF flags, the values of `Model`.

    Raises:
        ValueError: If the tolerance is not a positive number.
    """
    tolerance = _checked(tolerance)
    checks.variables("found", found, ("relative_difference", "relative_difference_stderr", "status_soft"), "compare")
    difference, doubt = found["relative_difference"], SURE * found["relative_difference_stderr"]
    ended = found["status_soft"].isin(_ENDED) & found["status_rigid"].isin(_ENDED)
    # Where neither holds, noise could turn the verdict.
    enough, short = difference + doubt <= tolerance, difference - doubt > tolerance
    verdict = short.astype(np.int8).where(ended & (enough | short), Model.UNDECIDED)
    verdict = _flags(verdict, Model, f"cheapest model whose P is within {100 * tolerance:.6g} %", found)
    verdict.attrs["tolerance"] = tolerance
    return verdict


def rigid_from(cheapest: "xr.DataArray") -> "xr.DataArray | None":
    """Find the least stiffness from which on, up to the stiffest cell, the rigid model is enough; NaN if none.

    Softer cells may pass too, where the difference in P changes its sign, but by chance.

    Args:
        cheapest: What `cheapest_model` returned.

    Returns:
        Values of the axis kappa, omega0 or k over the other axes; None if there is no such axis.
    """
    if not checks.is_data_array(cheapest) or cheapest.attrs.get("flag_meanings") != _meanings(Model):
        raise ValueError(f"cheapest must be what vijax.cheapest_model returned; got {checks.shown(cheapest)}")
    axis = next((dim for dim in cheapest.dims if dim in synonyms("kappa")), None)
    if axis is None:
        return None
    # From the stiffest cell down, a product is 1 as long as no cell has failed.
    enough = (cheapest == Model.RIGID).sortby(axis, ascending=False)
    onset = enough[axis].where(enough.astype(int).cumprod(axis) == 1).min(axis)
    onset.attrs = {
        "axis": axis,
        "units": enough[axis].attrs["units"],
        "long_name": f"least {axis} from which on the rigid model is enough",
    }
    return onset


def _judged(found: "xr.Dataset", tolerance: float) -> "xr.Dataset":
    verdict = cheapest_model(found, tolerance)
    onset = rigid_from(verdict)
    found = found.assign(cheapest_model=verdict)
    return found if onset is None else found.assign(rigid_from=onset)


def _flags(values: "xr.DataArray", kinds: type[enum.IntEnum], long_name: str, found: "xr.Dataset") -> "xr.DataArray":
    values = values.transpose(*(dim for dim in found["P_soft"].dims if dim in values.dims))
    values.attrs = {"units": "1", "long_name": long_name}
    return flagged(values, kinds)


def _meanings(kinds: type[enum.IntEnum]) -> str:
    return " ".join(kind.name.lower() for kind in kinds)
