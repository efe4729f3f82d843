"""Sweeps: axes -> cells -> compiled calls on every device and core -> a labelled map, in memory or on disk.

`plan` only validates the arguments, `run` simulates a plan, `sweep` does both.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.maps import refinement
from vijax.maps.axes import Axes, counted_periods, units_of_record
from vijax.maps.cells import Cells, cells
from vijax.maps.execution import cluster, dispatch, estimate, tile_execution, tile_size
from vijax.maps.execution.dispatch import Fields
from vijax.maps.map_dataset import DEFAULT, SweepPlan, make_map, warn_if_permanent_contact
from vijax.maps.outputs import available_outputs, default_outputs
from vijax.maps.storage import tiled_store
from vijax.maps.storage.store import load, open_store, save
from vijax.maps.storage.store_folder import validate_new_store_path
from vijax.maps.sweep_settings import MOST_STARTS, SweepSettings
from vijax.model.choices import MethodName, Periods, Precision, SolverName, Until, Walls
from vijax.model.device import Harvester, scalar_device
from vijax.model.forcing.excitation import Excitation
from vijax.model.walls.membrane import Laws, Linear, has_units, representative_law
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["load", "plan", "run", "save", "sweep"]

_LOG = logging.getLogger(__name__)


@public_api
def sweep(
    *,
    periods: Periods = SweepSettings.periods,
    until: Until = SweepSettings.until,
    transient: int = SweepSettings.transient,
    wall: Walls = SweepSettings.wall,
    method: MethodName = SweepSettings.method,
    solver: SolverName | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    membrane: Laws | None = None,
    friction: float | None = None,
    steps: int | None = None,
    outputs: Iterable[str] | None = None,
    device: Harvester | None = None,
    dtype: Precision = SweepSettings.dtype,
    excitation: Excitation | None = None,
    refine: int | None = None,
    starts: int = 1,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: cluster.Workers | None = None,
    **axes: Unpack[Axes],
) -> "xr.Dataset":
    """Map the harvested energy over a plane, or any product, of parameters, with variables that show where it is valid.

    Each axis is a number or a 1-D array, or such a quantity of pint; arrays become dimensions in the order specified::

        sweep(d=np.linspace(0.05, 0.3, 128), kappa=np.geomspace(3, 400, 128), r=0.5)  # the (d, kappa) plane
        sweep(omega=np.pi * np.linspace(1, 12, 64), omega0=np.linspace(20, 400, 64))  # one device, other frequencies
        sweep(d=0.2, kappa=np.geomspace(3, 400, 64), A=[1, 2, 5])                     # here A enters energies alone
        sweep(s=DataArray([0.01, 0.02], dims="device"), omega0=DataArray([90, 120], dims="device"))  # a list of devices

    Axes of the class `xarray.DataArray` that have the same single dimension share it: their values belong together, one
    by one. The dimension keeps its labels.

    Dimensionless axes are d, kappa, r, gamma and the start u0, v0; physical ones omega [rad/s], s [m], omega0 [rad/s]
    or k [N/m], A [m/s^2], beta [rad]. d and s are one quantity, so are kappa, omega0 and k, gamma and beta: specify one
    of each. Walls that differ have axes of their own: kappa_left, kappa_right, r_left, r_right, and so of omega0 and k.
    A quantity without an axis is taken from the device (s, omega0, r, A, omega, beta): d follows omega unless d is an
    axis. The start is u0 = min(0.05853, 0.49 d), v0 = -0.47898 by default. Cells that share (d, kappa, r, gamma, u0,
    v0) are simulated once for any number of omega or A, and with rigid walls for any number of kappa, which then enters
    energies alone.

    Args:
        periods: Forcing periods to run: at most (until="attractor"), or after the transient (until="window"); "all" for
            the whole length of a record that ends.
        until: "attractor" stops when the attractor is certified and measures over whole periods of it; "window" drops
            `transient` periods and measures over the next `periods`.
        transient: Forcing periods to drop before a window. It must be 0 with until="attractor", because the search for
            an attractor starts at once; if it finds none, averages omit the first quarter of `periods`.
        wall: "soft" or "rigid"; "rigid_left" or "rigid_right" where one wall is rigid, which harvests nothing.
        method: "exact", the event-driven engine; "ode", an adaptive solver of diffrax with located events; "rk4", the
            paper's fixed steps without event location.
        solver: For "ode": Bosh3, Dopri5, Dopri8, Kvaerno3, Kvaerno4 or Kvaerno5; Tsit5 by default.
        rtol, atol: For "ode": tolerances of position and velocity per step, 1e-8 and 1e-10 by default.
        membrane: For "ode" and "rk4": `HuntCrossley(chi)`, `Hyperelastic(prestretch)`, or a custom `MembraneLaw`, in
            place of the linear membrane; for a law per wall, `Sides` of two laws of one class. Constants with a
            dimension are in SI. `HuntCrossley` takes no r: the variable `restitution` of the map is its result.
        friction: For "ode": dry friction of ball and capsule, over the amplitude of the forcing as gamma is;
            `Harvester.friction` converts a coefficient. The ball may stick. None by default.
        steps: For "rk4": steps per forcing period, 1000 by default.
        outputs: Names of the variables, from the page of outputs; by default all but the ones on request
            (`vijax.maps.outputs.ON_REQUEST`). Others are not computed. `status` is always included.
        device: Constants of the device; Tables I and II by default.
        dtype: "float64", or "float32" with wider tolerances.
        excitation: Excitation of the capsule: `Harmonics`, a `Record`, a `Waveform`, `Noise`, or a sum of them; the
            sine by default. All but `Harmonics` are aperiodic: they require until="window", and the exact method. With
            a record, A and omega only set its units and must be one number each.
        refine: Levels of refinement: every 2^refine-th cell along each axis is computed, then only cells at borders
            between kinds of motion, or where the interpolated P errs by more than 1 %. The others are interpolated.
            `computed` is true for computed cells.
        starts: Number of starts of every cell, spread over the gap and over velocities between -0.6 and 0.6 as in
            `basin_fractions`. With more than one, u0 and v0 must be left out: P is the mean over the starts, and
            further variables (page of outputs) describe the attractors that the starts reach. Only the settings periods
            and wall are accepted.
        progress: Called with (cells done, cells in all) from the calling thread, first before anything is simulated.
            During refinement, the total counts the cells known to be needed, and grows.
        out: Zarr store, named `*.zarr`, to write tile by tile, so that a run needs the memory of a tile only. It opens
            at any time, with unfinished cells marked by their `status`. After an interruption of any kind, the same
            call continues with the unfinished tiles, and repairs damaged ones. A refined plane is written when it is
            complete. By default the map is in memory.
        overwrite: Start anew even if the store exists; files that vijax did not write are never replaced.
        workers: With `out`: processes that run and write the tiles, under Dask (extra `cluster`): a number of new
            processes, which share the cores, or the address of a scheduler with workers that see `out` under the same
            path. A worker runs one tile per thread, on its first device. New processes import the calling script: its
            actions must be under `if __name__ == "__main__":`.

    Returns:
        A dataset with one dimension per array, every parameter as a coordinate with units, and the requested variables,
        each without the dimensions that it cannot depend on. P is in joules per HALF forcing period. P is valid only
        where `admissible` is true; read `status` (CF flags) where `period` is -1. Attributes record versions, commit,
        machine, tolerances and every setting. With `out` data are read on access.
        The numbers of a cell do not depend on the other cells, to the last bit on one kind of device. If other
        `outputs`, or another number of variants, require another program, rounding differs: periodic cells agree to
        1e-12, aperiodic ones, where chaos amplifies rounding, within the errors of their averages.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.
        OSError: If `out` is another store, is in use, or cannot be written; if the scheduler or its workers fail.
        ModuleNotFoundError: With `workers` but without Dask.

    Warns:
        UserWarning: If beta exceeds pi/2, or gravity keeps the ball on a wall in every cell.

    Source: Eqs. (36)-(38), corrected.
    """
    settings = SweepSettings(
        periods=counted_periods(periods, excitation, transient, axes, device),
        until=until,
        transient=transient,
        wall=wall,
        method=method,
        solver=solver,
        rtol=rtol,
        atol=atol,
        membrane=membrane,
        friction=friction,
        steps=steps,
        dtype=dtype,
        excitation=excitation,
    )
    starts = validation.validate_integer("starts", starts, 1, MOST_STARTS)
    if outputs is None:
        outputs = default_outputs(
            starts, tiled_store.existing_variables(out, validation.validate_flag("overwrite", overwrite))
        )
    return run(plan(axes, outputs, device, settings, refine, starts), progress, out, overwrite, workers)


@public_api
def plan(
    axes: Mapping[str, Any],
    outputs: Iterable[str] | None = None,
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
    refine: int | None = None,
    starts: int = 1,
) -> SweepPlan:
    """Validate the arguments of a sweep and lay out its cells; simulates nothing.

    Args:
        axes: Value or values of each axis; None means that the axis is absent.
        outputs, device, refine, starts: As in `sweep`.
        settings: How the cells are simulated.

    Raises:
        ValueError, TypeError: If an argument is invalid; the message states the requirement and the value.
    """
    tile_size.max_cells()  # raises if VIJAX_TILE is invalid, before anything runs
    starts = validation.validate_integer("starts", starts, 1, MOST_STARTS)
    if outputs is None:
        outputs = default_outputs(starts)
    requested = validation.validate_choices("outputs", outputs, available_outputs(starts))
    device = scalar_device(device)
    present = {name: values for name, values in axes.items() if values is not None}
    if starts > 1:
        _check_several_starts(present, settings, refine)
    method = settings.integrator(units_of_record(device, present, settings.excitation))
    law = Linear() if method is None else method.law
    has_restitution = representative_law(law).restitution
    laid_out = cells(present, device, settings.wall, restitution=has_restitution, dimensional=has_units(law))
    for dim in laid_out.sizes:
        if dim in {*available_outputs(1), *available_outputs(2), "computed", "start"}:
            raise ValueError(f"the dimension {dim} must not have the name of a variable of the map; rename it")
    if starts > 1:
        quantities = {name: values for name, values in laid_out.quantities.items() if name not in ("u0", "v0")}
        laid_out = replace(laid_out, quantities=quantities)
    return SweepPlan(
        cells=laid_out,
        settings=settings,
        method=method,
        # `status` is always included: a map is meaningless without it.
        outputs=tuple(name for name in available_outputs(starts) if name in requested or name == "status"),
        device=device,
        refine=0 if refine is None else _levels(refine, laid_out, settings.until),
        starts=starts,
    )


def _check_several_starts(axes: Mapping[str, Any], settings: SweepSettings, refine: int | None) -> None:
    """Raise ValueError if an axis or setting is incompatible with several starts per cell."""
    for name in ("u0", "v0"):
        if name in axes:
            raise ValueError(
                f"{name} must be left out where cells have several starts; got {validation.value_text(axes[name])}"
            )
    if refine is not None:
        raise ValueError(
            f"refine must be left out where cells have several starts; got {validation.value_text(refine)}"
        )
    if settings.excitation is not None:
        raise ValueError(
            f"excitation must be left out of a map of several starts; got {settings.excitation}; vijax.response runs "
            "many starts of one device"
        )
    settings.require_defaults_except("a map of several starts", "periods", "wall")


def _levels(refine: Any, cells: Cells, until: str) -> int:
    """Return the number of refinement levels; raise ValueError if the plane cannot be refined so often."""
    levels = validation.validate_integer("refine", refine, 1)
    if shared := [dim for dim in cells.sizes if dim not in cells.axes]:
        raise ValueError(f"refine must be left out where axes share a dimension, here {shared[0]}; got {levels}")
    if until != "attractor":
        raise ValueError(
            see("maps", f"refine must be left out with until={until!r}, whose cells have no label; got {levels}")
        )
    longest = max((cells.sizes[dim] for dim in cells.dynamic), default=1)
    most = refinement.max_levels(longest)
    if levels > most:
        raise ValueError(
            see(
                "maps",
                f"refine must leave 4 steps of 2^refine cells along the longest axis that the motion depends on, "
                f"at most {most} levels for {longest} values; got {levels}",
            )
        )
    return levels


@public_api
def run(
    plan: SweepPlan,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: cluster.Workers | None = None,
) -> "xr.Dataset":
    """Simulate the cells of a plan tile by tile on every device, and return its map; see `sweep`."""
    meter = estimate.CostMeter(validation.validate_callable("progress", progress) or (lambda done, total: None))
    validation.validate_flag("overwrite", overwrite)
    if workers is not None:
        check_workers(plan, workers, out)
    if out is None:
        check_fits_memory(plan)
    else:
        check_out(plan, out, overwrite)
    if (expected := estimate.estimate_runs(plan)).needs_confirmation:
        _LOG.warning("a long run starts: %s", expected)
    dataset = _run(plan, meter, None if out is None else Path(out), overwrite, workers)
    if not plan.refine:
        meter.store_cost(plan)
    warn_if_permanent_contact(dataset)
    return dataset


def _run(
    plan: SweepPlan,
    notify: Callable[[int, int], None],
    out: Path | None,
    overwrite: bool,
    workers: cluster.Workers | None,
) -> "xr.Dataset":
    """Simulate a validated plan in memory, as a refined plane, or tile by tile into a store."""
    if out is None:
        return _compute_refined(plan, notify) if plan.refine else make_map(plan, _compute_fields(plan, notify))
    if plan.refine:
        # The choice of cells depends on all computed cells, so a partial store could not be continued: write it when
        # complete.
        save(_compute_refined(plan, notify), out, overwrite=overwrite)
        return open_store(out)
    if workers is None and not out.exists():
        tile_execution.compile_ahead(plan)
    with tiled_store.open_study(plan, out, overwrite) as plane:
        tile_execution.fill(plane, notify, workers)
    return open_store(out)


def check_out(plan: SweepPlan, out: str | Path, overwrite: bool = False) -> None:
    """Raise an error unless the map of a plan can be written to `out`, or continued there; creates no store.

    Raises:
        ValueError, OSError: As `tiled_store.check_writable`; for a refined map also if it does not fit in memory.
    """
    for name, labels in plan.cells.labels.items():
        if labels.dtype.kind == "U":
            raise ValueError(f"out must be left out where {name} has texts along it; got {out}; give it numbers")
    if plan.refine:
        validate_new_store_path("out", out, overwrite)
        check_fits_memory(plan)
    else:
        tiled_store.check_writable(plan, validation.validate_path("out", out), overwrite)


def check_fits_memory(plan: SweepPlan) -> None:
    """Raise ValueError unless the map of a plan fits in memory, if it is not written tile by tile."""
    names = [name for name, size in plan.cells.sizes.items() if size > 1]
    hint = "" if plan.refine else "; give out, a store that is written tile by tile"
    validation.check_memory(names, plan.size, f"{plan.count:,} cells", hint)


def check_workers(plan: SweepPlan, workers: cluster.Workers, out: str | Path | None) -> None:
    """Raise an error unless these workers can run the plan; starts no worker.

    Raises:
        ValueError, OSError, ModuleNotFoundError: As `cluster.check_available`; also without `out`, or with refinement.
    """
    if out is None:
        text = validation.value_text(workers)
        raise ValueError(see("studies", f"workers requires out, the store that they write; got {text} alone"))
    if plan.refine:
        raise ValueError(
            see(
                "studies",
                "workers must be left out with refine, which depends on all computed cells; got "
                f"{validation.value_text(workers)}",
            )
        )
    cluster.check_available(workers)


def _compute_fields(plan: SweepPlan, notify: Callable[[int, int], None]) -> Fields:
    """Return the fields of all cells of a plan."""
    count = plan.count
    notify(0, count)
    fields: Fields = {}
    for done in dispatch.compute(plan, np.arange(count), fields):
        notify(done, count)
    return fields


def _compute_refined(plan: SweepPlan, notify: Callable[[int, int], None]) -> "xr.Dataset":
    """Return the map of a refined plan: cells computed in rounds, the others interpolated."""
    all_cells = plan.cells
    varied = [dim for dim in all_cells.dynamic if all_cells.sizes[dim] > 1]
    mesh = refinement.Mesh(tuple(all_cells.axes[dim].values for dim in varied), plan.refine)
    level_ground = all_cells.pair(np.arange(all_cells.count), plan.settings.wall).symmetric & plan.mirrored
    extended_plan = replace(plan, outputs=tuple(dict.fromkeys((*plan.outputs, *refinement.FIELDS))))
    fields: Fields = {}
    computed = np.zeros(all_cells.count, bool)
    count_computed = 0
    for new_cells in refinement.cells_by_round(mesh, fields, level_ground):
        notify(count_computed, count_computed + new_cells.size)
        # Calls of all rounds have the same number of rows, so that one program serves them and the full plane.
        for done in dispatch.compute(extended_plan, new_cells, fields, dispatch.min_rows_per_device(all_cells.count)):
            notify(count_computed + done, count_computed + new_cells.size)
        computed[new_cells] = True
        count_computed += new_cells.size
    refinement.interpolate_missing(mesh, fields, computed, level_ground)
    attributes = {
        "units": "1",
        "long_name": "whether the cell was computed; other cells are interpolated",
    }
    dataset = make_map(plan, fields)
    dataset["computed"] = (
        all_cells.dynamic,
        computed.reshape([all_cells.sizes[dim] for dim in all_cells.dynamic]),
        attributes,
    )
    dataset.attrs |= {
        "refine": plan.refine,
        "refine_tolerance": refinement.P_RTOL,
        "refine_computed": count_computed,
        "refine_shown": all_cells.count,
    }
    return dataset
