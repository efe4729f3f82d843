"""Coexisting attractors of a cell: their basins, and the fraction of all starts that ends on each of them.

A sweep over many starts per parameter cell is simulated first. The starts of a cell are then grouped by the invariants
of the attractor that they end on (`attractor_invariants`), and each group becomes one row of a table.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.maps import sweep
from vijax.maps.attractor_invariants import (
    DISCRETE,
    INVARIANT_TOLERANCE,
    INVARIANTS,
    continuous_invariants,
    discrete_invariants,
)
from vijax.maps.axes import Parameters, check_axis
from vijax.maps.cells import cells
from vijax.maps.execution.start_lattice import unit_starts
from vijax.maps.map_dataset import DEFAULT, SweepPlan
from vijax.maps.sweep_settings import MOST_STARTS, SPEED, START_POINTS, STARTS, SweepSettings
from vijax.model.choices import Walls
from vijax.model.device import Harvester, scalar_device
from vijax.model.forcing.excitation import Excitation
from vijax.model.label import label, order_counts
from vijax.model.pair import has_mirror_symmetry
from vijax.model.units import QuantityLike
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["basin_fractions", "basins", "label"]

_MEASURES = ("P", "max_impact_speed", "impacts_per_period", "contact_fraction", "lyapunov")
_OUTPUTS = tuple(dict.fromkeys((*DISCRETE, *INVARIANTS, *_MEASURES, "admissible", "periods_run")))
_DESCRIPTIONS = {
    "label": "impacts left:right/forcing periods",
    "periodic": "whether the motion is periodic",
    "starts": "starts that end on the attractor",
    "fraction": "part of all starts",
    "fraction_stderr": "standard error of the fraction if the starts are drawn at random",
}
# The tables of all cells have the length of the longest one. `_BLANK` holds the filler of unused rows by kind of dtype,
# `_BLANK_STARTS` by name for the columns that count starts.
_BLANK: dict[str, Any] = {"i": -1, "f": np.nan, "b": False, "O": ""}
_BLANK_STARTS = {"starts": 0, "fraction": 0.0, "fraction_stderr": 0.0}


@public_api
def basins(
    *,
    u0: QuantityLike | None = None,
    v0: QuantityLike | None = None,
    merge_mirrors: bool = False,
    periods: int = SweepSettings.periods,
    wall: Walls = SweepSettings.wall,
    excitation: Excitation | None = None,
    device: Harvester | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Parameters],
) -> "xr.Dataset":
    """Find the attractor that each start of a (u0, v0) plane ends on, and tabulate the attractors of every cell.

    ::

        found = basins(d=0.2, kappa=3.0, r=0.5, v0=np.linspace(-0.6, 0.6, 400))
        found.label.values, found.fraction.values  # the commonest first

    Two starts end on the same attractor if invariants of their orbits, polished by Newton's method, agree: period,
    impacts on either wall, the greatest impact speed, the fraction of the time in contact, restitution left and right,
    and the mean impact velocity, which separates mirror images. On level ground with d > 2/pi^2, all motions that reach
    a state without further impacts share one entry, "no impact". The aperiodic motions of one parameter cell share one
    entry, and so do undecided ones: "aperiodic" means that no period was detected within `periods_run` periods, not
    that the motion never becomes periodic.

    Args:
        u0: Displacements at the start; by default they span the widest gap, with as many points as `v0` has.
        v0: Velocities at the start; by default 256 between -0.6 and 0.6.
        merge_mirrors: Count mirror images as one attractor; gamma must be 0 everywhere.
        periods, wall, device, progress: As in `sweep`.
        excitation: `Harmonics`, because attractors require a forcing that repeats every period; the sine by default.
        axes: Any other axes of `sweep`; every combination of their values is a cell with its own table.

    Returns:
        `basin` over all axes, the row of the start's attractor in the table of its parameter cell. The variables of the
        table have the dimension `attractor`: `label`, `period`, `impacts_left`, `impacts_right`, `P` [J per half
        period], `max_impact_speed` [m/s], `impacts_per_period`, `contact_fraction`, `lyapunov`, `admissible`,
        `periodic`, `starts` (number of starts that end there), `fraction` (of all) and, for starts drawn at random,
        `fraction_stderr`, `periods_run` (maximum over these starts), `status`. Rows are in the order of `starts`; rows
        past a cell's last hold "" and NaN. `attractors` is the number of attractors of a cell.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.
    """
    settings = SweepSettings(periods=periods, wall=wall, excitation=excitation)
    plan = plan_basins({**axes, "u0": u0, "v0": v0}, device, settings, merge_mirrors=merge_mirrors)
    return match_attractors(sweep.run(plan, progress), merge_mirrors)


@public_api
def plan_basins(
    axes: Mapping[str, Any],
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
    *,
    merge_mirrors: bool = False,
) -> SweepPlan:
    """Validate the arguments of `basins` and lay out its cells; simulates nothing.

    Args:
        axes: Value or values of each axis; None means that the axis is absent.
        device, merge_mirrors: As in `basins`.
        settings: Only periods, wall and excitation may differ from their defaults.

    Raises:
        ValueError, TypeError: If an argument is invalid; the message states the requirement and the value.
    """
    others = {name: values for name, values in axes.items() if values is not None and name not in ("u0", "v0")}
    u0, v0 = axes.get("u0"), axes.get("v0")
    v0 = np.linspace(-SPEED, SPEED, START_POINTS) if v0 is None else check_axis("v0", v0)
    if u0 is None:
        gap = cells(others, scalar_device(device), "soft").quantities["d"].values.max()
        u0 = gap * _midpoints(max(np.size(v0), 2))
    return plan_starts({"u0": u0, "v0": v0} | others, device, settings, merge_mirrors)


@public_api
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
    """Return the fraction of starts that ends on each coexisting attractor, in every cell: multistability maps.

    Starts are spread uniformly over the gap and over velocities between -`speed` and `speed`, with the same positions
    in every cell.

    Args:
        starts: Number of starts in every cell.
        speed: Largest velocity at the start, dimensionless.
        seed: Seed of starts drawn at random; by default they lie on a lattice, which is more even.
        merge_mirrors, periods, wall, excitation, device, progress: As in `basins`.
        axes: Any axes of `sweep` but u0 and v0.

    Returns:
        As `basins`, with the dimension `start` in place of u0 and v0, which are its coordinates.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.
    """
    settings = SweepSettings(periods=periods, wall=wall, excitation=excitation)
    plan = plan_fractions(axes, device, settings, starts=starts, speed=speed, seed=seed, merge_mirrors=merge_mirrors)
    return match_attractors(sweep.run(plan, progress), merge_mirrors)


@public_api
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
    """Validate the arguments of `basin_fractions` and lay out its cells; simulates nothing.

    Args:
        axes, device, starts, speed, seed, merge_mirrors: As in `basin_fractions`.
        settings: As in `plan_basins`.

    Raises:
        ValueError, TypeError: If an argument is invalid; the message states the requirement and the value.
    """
    for name in ("u0", "v0"):
        if axes.get(name) is not None:
            raise TypeError(f"{name} must be left out where starts are drawn; got {validation.value_text(axes[name])}")
    speed, seed = validation.validate_positive("speed", speed), validation.validate_seed(seed)
    starts = validation.validate_integer("starts", starts, 1, MOST_STARTS)
    plan = plan_starts(axes, device, settings, merge_mirrors)
    check_starts_fit(plan, starts)
    unit_start = start_variables(starts, seed)
    return with_starts(plan, unit_start[0] * plan.cells.quantities["d"], 2 * speed * unit_start[1])


def plan_starts(
    axes: Mapping[str, Any], device: Harvester | None, settings: SweepSettings, merge_mirrors: bool = False
) -> SweepPlan:
    """Plan a sweep with all outputs that `match_attractors` needs.

    Args:
        axes, device, merge_mirrors: As in `plan_basins`.
        settings: Only periods, wall and excitation may differ from their defaults.

    Raises:
        ValueError: If mirror images are to be merged where the mirror image of a motion is no motion.
    """
    validation.validate_flag("merge_mirrors", merge_mirrors)
    settings.require_defaults_except("basins", "periods", "wall", "excitation")
    plan = sweep.plan(axes, _OUTPUTS, device, settings)
    gamma = plan.cells.quantities["gamma"].values
    if merge_mirrors and gamma.any():
        got = gamma[gamma != 0].flat[0]
        raise ValueError(f"merge_mirrors must be left out unless gamma is 0 everywhere; got gamma = {got:g}")
    if merge_mirrors and settings.excitation is not None and not settings.excitation.has_half_wave_symmetry:
        raise ValueError(
            f"merge_mirrors must be left out unless the excitation has odd harmonics alone; got {settings.excitation}"
        )
    alike = plan.device.has_equal_membranes and has_mirror_symmetry(plan.cells.quantities).values.all()
    if merge_mirrors and not alike:
        raise ValueError("merge_mirrors must be left out unless both walls are alike everywhere; got walls that differ")
    return plan


def _midpoints(count: int) -> np.ndarray:
    """Return the middles of `count` equal parts of [-1/2, 1/2]."""
    return (np.arange(count) + 0.5) / count - 0.5


def start_variables(count: int, seed: int | None) -> "tuple[xr.Variable, xr.Variable]":
    """Return the two rows of `unit_starts` as variables along the dimension `start`."""
    import xarray as xr  # here, as importing vijax must not load it

    unit_gap, unit_speed = unit_starts(count, seed)
    return xr.Variable("start", unit_gap), xr.Variable("start", unit_speed)


def check_starts_fit(plan: SweepPlan, starts: int) -> None:
    """Raise ValueError unless the cells of a plan, with this number of starts each, fit in memory."""
    names = ["starts", *(dim for dim, size in plan.cells.sizes.items() if size > 1)]
    validation.check_memory(names, starts * plan.size, f"{plan.count:,} cells of {starts:,} starts")


def with_starts(plan: SweepPlan, u0: "xr.Variable", v0: "xr.Variable") -> SweepPlan:
    """Return the plan with one more dynamic dimension, `start`, along which the starts (u0, v0) vary."""
    cells = plan.cells
    extended = replace(
        cells,
        sizes=cells.sizes | {"start": u0.sizes["start"]},
        dynamic=(*cells.dynamic, "start"),
        quantities=cells.quantities | {"u0": u0, "v0": v0},
    )
    return replace(plan, cells=extended)


# --- matching of starts to attractors ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Groups:
    """Starts sorted by the attractor that they end on; the groups of a cell are adjacent.

    Attributes:
        order: Indices of the starts, group by group.
        first: Where each group begins in `order`.
        counts: Number of starts of each group.
        cell: The parameter cell of each group.
        rank: Place of each group among the groups of its cell, 0 for the group with most starts.
    """

    order: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    cell: np.ndarray
    rank: np.ndarray


def _sort_groups(cell: np.ndarray, group: np.ndarray) -> _Groups:
    """Sort the starts, numbered by cell and by group, into `_Groups`."""
    order = np.argsort(group, kind="stable")
    _, first, counts = np.unique(group[order], return_index=True, return_counts=True)
    group_cell = cell[order[first]]
    # Sorted by cell, then by falling number of starts: the position within the cell is the rank.
    order_in_cell = np.lexsort((-counts, group_cell))
    rank = np.empty_like(order_in_cell)
    rank[order_in_cell] = np.arange(group_cell.size) - np.searchsorted(group_cell, group_cell)[order_in_cell]
    return _Groups(order, first, counts, group_cell, rank)


def _group_ids(cell: np.ndarray, measured: dict[str, np.ndarray], merge_mirrors: bool, tolerance: float) -> np.ndarray:
    """Return a group number per start, equal for starts of one cell that end on the same attractor; ordered by cell."""
    speed = measured["max_impact_speed"]
    while speed.ndim > 1:  # dimensions of A or omega scale the speed but not the motion: any entry will do
        speed = speed[0]
    key, period = discrete_invariants(measured, merge_mirrors)
    group = _split_groups(cell, key, 0)
    for values in continuous_invariants(measured | {"max_impact_speed": speed}, period, merge_mirrors):
        group = _split_groups(group, values, tolerance)
    return group


def _split_groups(group: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Split groups wherever two values of a group, adjacent in ascending order, differ by more than a tolerance."""
    order = np.lexsort((values, group))
    # A chain of close neighbours stays one group, however wide it becomes.
    boundaries = (np.diff(group[order]) != 0) | (np.diff(values[order]) > tolerance)
    numbers = np.empty_like(group)
    numbers[order] = np.concatenate([[0], np.cumsum(boundaries)])
    return numbers


def match_attractors(dataset: "xr.Dataset", merge_mirrors: bool = False) -> "xr.Dataset":
    """Match every start to its attractor, and tabulate the attractors of every cell of the other dimensions.

    Args:
        dataset: A sweep over starts (u0, v0, or `start`) with the outputs of `plan_starts`.
        merge_mirrors: As in `basins`.

    Returns:
        As `basins`.
    """
    import xarray as xr  # here, as importing vijax must not load it

    start_dims = tuple(dim for dim in ("u0", "v0", "start") if dim in dataset["period"].dims)
    dims = tuple(str(dim) for dim in dataset["period"].dims if dim not in start_dims)
    shape = tuple(dataset.sizes[dim] for dim in dims)
    starts = math.prod(dataset.sizes[dim] for dim in start_dims)
    measured = {name: _flatten(dataset[name].variable, dims, start_dims) for name in _OUTPUTS}
    cell = np.repeat(np.arange(math.prod(shape)), starts)
    group = _group_ids(cell, measured, merge_mirrors, INVARIANT_TOLERANCE)
    groups = _sort_groups(cell, group)
    basin = groups.rank[group].reshape(*shape, *(dataset.sizes[dim] for dim in start_dims)).astype(np.int32)
    variables = {
        "basin": xr.Variable(
            (*dims, *start_dims), basin, unitless_attributes("row of the start's attractor in the table")
        )
    }
    variables["basin"] = variables["basin"].transpose(*dataset["period"].dims)
    for name, values in _columns(measured, groups, merge_mirrors, starts).items():
        scale_dims = [dim for dim in dataset[name].dims if dim not in (*dims, *start_dims)] if name in dataset else []
        attributes = dataset[name].attrs if name in dataset else unitless_attributes(_DESCRIPTIONS[name])
        table = _tabulate(values, groups, shape, _BLANK_STARTS.get(name, _BLANK[values.dtype.kind]))
        variables[name] = xr.Variable((*scale_dims, *dims, "attractor"), table, attributes)
    variables["attractors"] = (variables["period"] >= 0).sum("attractor")
    variables["attractors"].attrs = unitless_attributes(
        "number of attractors; aperiodic motions count as one, undecided starts as none"
    )
    attributes = dataset.attrs | {"title": "Basins of attraction", "merge_mirrors": int(merge_mirrors)}
    return xr.Dataset(variables, coords=dataset.coords, attrs=attributes)


def _flatten(variable: "xr.Variable", dims: tuple[str, ...], start_dims: tuple[str, ...]) -> np.ndarray:
    """Flatten values to [..., start], cell by cell; dimensions that do not affect the motion come first."""
    scale_dims = [dim for dim in variable.dims if dim not in (*dims, *start_dims)]
    values = variable.transpose(*scale_dims, *dims, *start_dims).values
    return values.reshape(*values.shape[: len(scale_dims)], -1)


def _columns(
    measured: dict[str, np.ndarray], groups: _Groups, merge_mirrors: bool, starts: int
) -> dict[str, np.ndarray]:
    """Compute the columns of the table, each [..., group]."""
    first = {name: measured[name][..., groups.order[groups.first]] for name in (*DISCRETE, "admissible")}
    fraction = groups.counts / starts
    low, high = order_counts(first["impacts_left"], first["impacts_right"], merge_mirrors)
    means = {
        name: np.add.reduceat(measured[name][..., groups.order], groups.first, axis=-1) / groups.counts
        for name in _MEASURES
    }
    return {
        # Object dtype, because zarr has no stable format for strings of fixed length.
        "label": label(first["period"], low, high, first["status"]).astype(object),
        **first,
        "impacts_left": low,
        "impacts_right": high,
        **means,
        "periods_run": np.maximum.reduceat(measured["periods_run"][groups.order], groups.first),
        "periodic": first["period"] > 0,
        "starts": groups.counts,
        "fraction": fraction,
        "fraction_stderr": np.sqrt(fraction * (1 - fraction) / starts),
    }


def _tabulate(values: np.ndarray, groups: _Groups, shape: tuple[int, ...], blank: Any) -> np.ndarray:
    """Arrange values [..., group] as a table [..., cell, rank]; entries past a cell's last group are `blank`."""
    table = np.full((*values.shape[:-1], math.prod(shape), groups.rank.max() + 1), blank, values.dtype)
    table[..., groups.cell, groups.rank] = values
    return table.reshape(*values.shape[:-1], *shape, -1)


def unitless_attributes(text: str) -> dict[str, Any]:
    """Return the attributes of a variable without unit."""
    return {"units": "1", "long_name": text}
