"""Coexisting attractors: their basins, and what share of all starts each one takes.

All of it is the one line of a sweep over many starts; here the cells that ended on the same attractor are found, by
what was measured on it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import Harvester, one_device
from vijax.model.excitation import Excitation
from vijax.model.label import label, ordered
from vijax.model.pair import symmetric
from vijax.model.units import Given
from vijax.planes import sweep
from vijax.planes.attractor_marks import ENDED, INVARIANTS, SAME, invariants, kinds
from vijax.planes.axes import Parameters, check_axis
from vijax.planes.cells import cells
from vijax.planes.dataset import DEFAULT, SweepPlan
from vijax.planes.start_places import start_places
from vijax.planes.sweep_settings import MOST_STARTS, SPEED, START_POINTS, STARTS, SweepSettings
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["basin_fractions", "basins", "label"]

_MEASURES = ("P", "max_impact_speed", "impacts_per_period", "contact_fraction", "lyapunov")
_OUTPUTS = tuple(dict.fromkeys((*ENDED, *INVARIANTS, *_MEASURES, "admissible", "periods_run")))
_TEXTS = {
    "label": "impacts left:right/forcing periods",
    "periodic": "whether a period was found",
    "starts": "starts that end on the attractor",
    "fraction": "part of all starts",
    "fraction_stderr": "standard error of the fraction if the starts are drawn at random",
}
# A table is as long as that of the cell with the most attractors. Past the last one of another cell stands this, by
# kind of value, and below what stands there of starts.
_BLANK: dict[str, Any] = {"i": -1, "f": np.nan, "b": False, "O": ""}
_NONE = {"starts": 0, "fraction": 0.0, "fraction_stderr": 0.0}


@door
def basins(
    *,
    u0: Given | None = None,
    v0: Given | None = None,
    merge_mirrors: bool = False,
    periods: int = SweepSettings.periods,
    wall: Walls = SweepSettings.wall,
    excitation: Excitation | None = None,
    device: Harvester | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Parameters],
) -> "xr.Dataset":
    """Find which attractor each start of a (u0, v0) plane ends on, and make a table of the attractors.

    ::

        found = basins(d=0.2, kappa=3.0, r=0.5, v0=np.linspace(-0.6, 0.6, 400))
        found.label.values, found.fraction.values  # the commonest first

    Starts are matched by invariants of the polished orbit: period, impacts on either side, the greatest impact speed,
    the part of the time in contact, restitution left and right, and the mean impact velocity, which tells mirror
    images apart. Level ground and d > 2/pi^2: all motions that touch no wall again are one entry, "no impact".
    Aperiodic motions of one parameter cell are one entry as well, and so are undecided ones: "aperiodic" says that no
    period was found in `periods_run` periods, not that none will be.

    Args:
        u0: Displacements at the start; the whole of the widest gap unless given, in as many points as `v0` has.
        v0: Velocities at the start; 256 between -0.6 and 0.6 unless given.
        merge_mirrors: Count mirror images as one attractor; gamma must be 0 everywhere.
        periods, wall, device, progress: As in `sweep`.
        excitation: `Harmonics`, as attractors want a forcing that repeats every period; the sine unless given.
        axes: Any other axes of `sweep`; every point of arrays among them has a table of its own.

    Returns:
        `basin` over all axes, the place of the start's attractor in its parameter cell's table, whose variables have
        the dimension `attractor`: `label`, `period`, `impacts_left`, `impacts_right`, `P` [J per half period],
        `max_impact_speed` [m/s], `impacts_per_period`, `contact_fraction`, `lyapunov`, `admissible`, `periodic`,
        `starts` (how many end there), `fraction` (of all) and, for starts drawn at random, `fraction_stderr`,
        `periods_run` (the most any start took), `status`. Entries are in the order of `starts`; rows past a cell's last
        hold "" and NaN. `attractors` counts those of a cell.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
    """
    settings = SweepSettings(periods=periods, wall=wall, excitation=excitation)
    planned = plan_basins({**axes, "u0": u0, "v0": v0}, device, settings, merge_mirrors=merge_mirrors)
    return matched(sweep.run(planned, progress), merge_mirrors)


@door
def plan_basins(
    axes: Mapping[str, Any],
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
    *,
    merge_mirrors: bool = False,
) -> SweepPlan:
    """Check what `basins` is asked for and lay out its cells; runs nothing.

    Args:
        axes: Value or values of each axis; None counts as not given.
        device, merge_mirrors: As in `basins`.
        settings: Of these periods, wall and excitation are read.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    others = {name: values for name, values in axes.items() if values is not None and name not in ("u0", "v0")}
    u0, v0 = axes.get("u0"), axes.get("v0")
    v0 = np.linspace(-SPEED, SPEED, START_POINTS) if v0 is None else check_axis("v0", v0)
    if u0 is None:
        gap = cells(others, one_device(device), "soft").quantities["d"].values.max()
        u0 = gap * _middles(max(np.size(v0), 2))
    return plan_starts({"u0": u0, "v0": v0} | others, device, settings, merge_mirrors)


@door
def basin_fractions(
    *,
    starts: int = STARTS,
    speed: float = SPEED,
    seed: int | None = None,
    merge_mirrors: bool = False,
    periods: int = SweepSettings.periods,
    wall: Walls = SweepSettings.wall,
    excitation: Excitation | None = None,
    device: Harvester | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Parameters],
) -> "xr.Dataset":
    """Find the share of starts that each coexisting attractor takes, in every cell: multistability maps.

    Starts are spread uniformly over the gap and over velocities between -`speed` and `speed`, alike in every cell.

    Args:
        starts: How many, in every cell.
        speed: Largest velocity at the start, dimensionless.
        seed: Of starts drawn at random; unless given they lie on a lattice, which is more even.
        merge_mirrors, periods, wall, excitation, device, progress: As in `basins`.
        axes: Any axes of `sweep` but u0 and v0.

    Returns:
        As `basins`, with the dimension `start` in place of u0 and v0, which are its coordinates.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
    """
    settings = SweepSettings(periods=periods, wall=wall, excitation=excitation)
    planned = plan_fractions(axes, device, settings, starts=starts, speed=speed, seed=seed, merge_mirrors=merge_mirrors)
    return matched(sweep.run(planned, progress), merge_mirrors)


@door
def plan_fractions(
    axes: Mapping[str, Any],
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
    *,
    starts: int = STARTS,
    speed: float = SPEED,
    seed: int | None = None,
    merge_mirrors: bool = False,
) -> SweepPlan:
    """Check what `basin_fractions` is asked for and lay out its cells; runs nothing.

    Args:
        axes, device, starts, speed, seed, merge_mirrors: As in `basin_fractions`.
        settings: As in `plan_basins`.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    for name in ("u0", "v0"):
        if axes.get(name) is not None:
            raise TypeError(f"{name} must be left out where starts are drawn; got {checks.shown(axes[name])}")
    speed, seed = checks.positive("speed", speed), checks.seed(seed)
    starts = checks.whole("starts", starts, 1, MOST_STARTS)
    planned = plan_starts(axes, device, settings, merge_mirrors)
    check_starts(planned, starts)
    place = spread(starts, seed)
    return started(planned, place[0] * planned.cells.quantities["d"], 2 * speed * place[1])


def plan_starts(
    axes: Mapping[str, Any], device: Harvester | None, settings: SweepSettings, merge_mirrors: bool = False
) -> SweepPlan:
    """Plan a sweep with all outputs that `matched` wants.

    Args:
        axes, device, merge_mirrors: As in `plan_basins`.
        settings: Of these periods, wall and excitation are read.
    """
    checks.flag("merge_mirrors", merge_mirrors)
    settings.only("basins", "periods", "wall", "excitation")
    planned = sweep.plan(axes, _OUTPUTS, device, settings)
    gamma = planned.cells.quantities["gamma"].values
    if merge_mirrors and gamma.any():
        got = gamma[gamma != 0].flat[0]
        raise ValueError(f"merge_mirrors must be left out unless gamma is 0 everywhere; got gamma = {got:g}")
    if merge_mirrors and settings.excitation is not None and not settings.excitation.mirrored:
        raise ValueError(
            f"merge_mirrors must be left out unless the excitation has odd harmonics alone; got {settings.excitation}"
        )
    alike = planned.device.alike and symmetric(planned.cells.quantities).values.all()
    if merge_mirrors and not alike:
        raise ValueError("merge_mirrors must be left out unless both walls are alike everywhere; got walls that differ")
    return planned


def _middles(count: int) -> np.ndarray:
    """Give the middles of `count` equal parts of [-1/2, 1/2]."""
    return (np.arange(count) + 0.5) / count - 0.5


def spread(count: int, seed: int | None) -> "tuple[xr.Variable, xr.Variable]":
    """Give `start_places` along the dimension `start`."""
    import xarray as xr  # here, as importing vijax must not load it

    first, second = start_places(count, seed)
    return xr.Variable("start", first), xr.Variable("start", second)


def check_starts(planned: SweepPlan, starts: int) -> None:
    """Raise ValueError unless a plan's cells fit in memory with so many starts each."""
    names = ["starts", *(dim for dim, size in planned.cells.sizes.items() if size > 1)]
    checks.fits(names, starts * planned.size, f"{planned.count:,} cells of {starts:,} starts")


def started(planned: SweepPlan, u0: "xr.Variable", v0: "xr.Variable") -> SweepPlan:
    """Give the cells of a plan one more dimension, `start`, on which their starts depend."""
    of = planned.cells
    laid = replace(
        of,
        sizes=of.sizes | {"start": u0.sizes["start"]},
        dynamic=(*of.dynamic, "start"),
        quantities=of.quantities | {"u0": u0, "v0": v0},
    )
    return replace(planned, cells=laid)


# --- which starts end on the same attractor ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Groups:
    """Starts sorted by the attractor on which they end; the groups of a cell lie together.

    Attributes:
        order: Starts, group by group.
        first: Where each group begins in that order.
        counts: Starts of each group.
        cell: The parameter cell of each group.
        rank: Its place among the groups of its cell, the largest first.
    """

    order: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    cell: np.ndarray
    rank: np.ndarray


def _groups(cell: np.ndarray, group: np.ndarray) -> _Groups:
    order = np.argsort(group, kind="stable")
    _, first, counts = np.unique(group[order], return_index=True, return_counts=True)
    of = cell[order[first]]
    places = np.lexsort((-counts, of))
    rank = np.empty_like(places)
    rank[places] = np.arange(of.size) - np.searchsorted(of, of)[places]
    return _Groups(order, first, counts, of, rank)


def _group(cell: np.ndarray, measured: dict[str, np.ndarray], merge_mirrors: bool, apart: float) -> np.ndarray:
    """Give every start a number, alike where it is the same attractor of the same cell; in the order of the cells."""
    speed = measured["max_impact_speed"]
    while speed.ndim > 1:  # the unit of speed may vary where the motion does not
        speed = speed[0]
    kind, period = kinds(measured, merge_mirrors)
    group = _parted(cell, kind, 0)
    for values in invariants(measured | {"max_impact_speed": speed}, period, merge_mirrors):
        group = _parted(group, values, apart)
    return group


def _parted(group: np.ndarray, values: np.ndarray, apart: float) -> np.ndarray:
    """Part groups further wherever, in ascending order, values of one are further apart than a tolerance."""
    order = np.lexsort((values, group))
    parts = (np.diff(group[order]) != 0) | (np.diff(values[order]) > apart)
    parted = np.empty_like(group)
    parted[order] = np.concatenate([[0], np.cumsum(parts)])
    return parted


def matched(found: "xr.Dataset", merge_mirrors: bool = False) -> "xr.Dataset":
    """Find the attractor of every start, and make a table of them for every cell of the other dimensions.

    Args:
        found: A sweep over starts (u0, v0, or `start`) with the outputs that `basins` asks for.
        merge_mirrors: As in `basins`.

    Returns:
        As `basins`.
    """
    import xarray as xr  # here, as importing vijax must not load it

    over = tuple(dim for dim in ("u0", "v0", "start") if dim in found["period"].dims)
    dims = tuple(str(dim) for dim in found["period"].dims if dim not in over)
    shape = tuple(found.sizes[dim] for dim in dims)
    starts = math.prod(found.sizes[dim] for dim in over)
    measured = {name: _flat(found[name].variable, dims, over) for name in _OUTPUTS}
    cell = np.repeat(np.arange(math.prod(shape)), starts)
    group = _group(cell, measured, merge_mirrors, SAME)
    groups = _groups(cell, group)
    basin = groups.rank[group].reshape(*shape, *(found.sizes[dim] for dim in over)).astype(np.int32)
    variables = {"basin": xr.Variable((*dims, *over), basin, described("place of the start's attractor in the table"))}
    variables["basin"] = variables["basin"].transpose(*found["period"].dims)
    for name, values in _entries(measured, groups, merge_mirrors, starts).items():
        further = [dim for dim in found[name].dims if dim not in (*dims, *over)] if name in found else []
        attributes = found[name].attrs if name in found else described(_TEXTS[name])
        table = _laid_out(values, groups, shape, _NONE.get(name, _BLANK[values.dtype.kind]))
        variables[name] = xr.Variable((*further, *dims, "attractor"), table, attributes)
    variables["attractors"] = (variables["period"] >= 0).sum("attractor")
    variables["attractors"].attrs = described("attractors found; aperiodic motions are one, undecided starts none")
    attributes = found.attrs | {"title": "Basins of attraction", "merge_mirrors": int(merge_mirrors)}
    return xr.Dataset(variables, coords=found.coords, attrs=attributes)


def _flat(variable: "xr.Variable", dims: tuple[str, ...], over: tuple[str, ...]) -> np.ndarray:
    """Take values start by start, cell by cell, on the last axis; before it dimensions that leave the motion alone."""
    further = [dim for dim in variable.dims if dim not in (*dims, *over)]
    values = variable.transpose(*further, *dims, *over).values
    return values.reshape(*values.shape[: len(further)], -1)


def _entries(
    measured: dict[str, np.ndarray], groups: _Groups, merge_mirrors: bool, starts: int
) -> dict[str, np.ndarray]:
    """Compute the table's columns, each [..., group]."""
    first = {name: measured[name][..., groups.order[groups.first]] for name in (*ENDED, "admissible")}
    share = groups.counts / starts
    left, right = ordered(first["impacts_left"], first["impacts_right"], merge_mirrors)
    means = {
        name: np.add.reduceat(measured[name][..., groups.order], groups.first, axis=-1) / groups.counts
        for name in _MEASURES
    }
    return {
        # These are objects, as zarr has no lasting format for strings of fixed length.
        "label": label(first["period"], left, right, first["status"]).astype(object),
        **first,
        "impacts_left": left,
        "impacts_right": right,
        **means,
        "periods_run": np.maximum.reduceat(measured["periods_run"][groups.order], groups.first),
        "periodic": first["period"] > 0,
        "starts": groups.counts,
        "fraction": share,
        "fraction_stderr": np.sqrt(share * (1 - share) / starts),
    }


def _laid_out(values: np.ndarray, groups: _Groups, shape: tuple[int, ...], blank: Any) -> np.ndarray:
    """Lay values of every group [..., group] out over the cells and, by rank, their groups; blank past the last."""
    table = np.full((*values.shape[:-1], math.prod(shape), groups.rank.max() + 1), blank, values.dtype)
    table[..., groups.cell, groups.rank] = values
    return table.reshape(*values.shape[:-1], *shape, -1)


def described(text: str) -> dict[str, Any]:
    """Make the attributes of a variable without units."""
    return {"units": "1", "long_name": text}
