"""Sweeps: axes -> cells -> calls on every device and core -> a labelled map, in memory or on disk.

`plan` checks everything that can be wrong and starts nothing, `run` does the work, `sweep` is both.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vijax.model.choices import MethodName, Periods, Precision, SolverName, Until, Walls
from vijax.model.device import Harvester, one_device
from vijax.model.excitation import Excitation
from vijax.model.membrane import Laws, Linear, has_units, one_of
from vijax.planes import cluster, dispatch, estimate, store_filling, tile_size, tiled_store
from vijax.planes import refine as refinement
from vijax.planes.axes import Axes, counted_periods, units_of_record
from vijax.planes.cells import Cells, cells
from vijax.planes.dataset import DEFAULT, SweepPlan, label, warn_if_held
from vijax.planes.dispatch import Fields
from vijax.planes.outputs import default_outputs, table
from vijax.planes.store import load, save, view
from vijax.planes.store_folder import check_store
from vijax.planes.sweep_settings import MOST_STARTS, SweepSettings
from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["load", "plan", "run", "save", "sweep"]

_LOG = logging.getLogger(__name__)


@door
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
    """Map the energy harvested over a plane, or any product, of parameters, with all that tells whether to believe it.

    Each axis is a number or a 1-D array, or such a quantity of pint; arrays become dimensions in the order given::

        sweep(d=np.linspace(0.05, 0.3, 128), kappa=np.geomspace(3, 400, 128), r=0.5)  # the (d, kappa) plane
        sweep(omega=np.pi * np.linspace(1, 12, 64), omega0=np.linspace(20, 400, 64))  # one device, other frequencies
        sweep(d=0.2, kappa=np.geomspace(3, 400, 64), A=[1, 2, 5])                     # here A enters energies alone
        sweep(s=DataArray([0.01, 0.02], dims="device"), omega0=DataArray([90, 120], dims="device"))  # a list of devices

    Axes of the class `xarray.DataArray` that have the same single dimension share it: their values belong together, one
    by one. The dimension keeps its labels.

    Dimensionless axes are d, kappa, r, gamma and the start u0, v0; physical ones omega [rad/s], s [m], omega0 [rad/s]
    or k [N/m], A [m/s^2], beta [rad]. d and s are one quantity, so are kappa, omega0 and k, gamma and beta: give one
    of each. Walls that differ have axes of their own: kappa_left, kappa_right, r_left, r_right, and so of omega0 and k.
    Whatever no axis gives is the device's (s, omega0, r, A, omega, beta): d follows omega unless d is given.
    The start is u0 = min(0.05853, 0.49 d), v0 = -0.47898 unless given.
    Cells that share (d, kappa, r, gamma, u0, v0) are simulated once however many omega or A there are, and with rigid
    walls however many kappa: it then enters energies alone.

    Args:
        periods: Forcing periods to run: at most (until="attractor"), or after the transient (until="window"); "all" of
            a record that ends.
        until: "attractor" stops when the attractor is certain and measures over whole periods of it; "window" drops
            `transient` periods and measures over the next `periods`.
        transient: Forcing periods to drop before a window. The search for an attractor begins at once and takes none;
            where it finds nothing, averages leave out the first quarter of `periods`.
        wall: "soft" or "rigid"; "rigid_left" or "rigid_right" where one wall is rigid, which harvests nothing.
        method: "exact", the event-driven engine; "ode", an adaptive solver of diffrax with located events; "rk4", the
            paper's fixed steps without event location.
        solver: Of "ode": Tsit5 unless given; Bosh3, Dopri5, Dopri8, Kvaerno3, Kvaerno4 or Kvaerno5.
        rtol, atol: Of "ode": tolerances of position and velocity step by step, 1e-8 and 1e-10 unless given.
        membrane: Of "ode" and "rk4": `HuntCrossley(chi)`, `Hyperelastic(prestretch)`, or a `MembraneLaw` of your own,
            for the linear membrane; of walls with a law each `Sides` of two of one kind. Numbers with a dimension are
            in SI. `HuntCrossley` takes no r: the map's `restitution` is what came out.
        friction: Of "ode": dry friction of ball and capsule, over the amplitude of the forcing as gamma is;
            `Harvester.friction` has that of a coefficient. The ball may stick. None unless given.
        steps: Of "rk4": steps per forcing period, 1000 unless given.
        outputs: The variables wanted, of those on the page of outputs; all but those on request
            (`vijax.planes.outputs.ON_REQUEST`) unless given. Others are not computed. `status` always comes.
        device: Constants of the device; Tables I and II unless given.
        dtype: "float64", or "float32" with tolerances to match.
        excitation: What shakes the capsule: `Harmonics`, a `Record`, a `Waveform`, `Noise`, or a sum of them; the sine
            unless given. All but harmonics repeat no motion: they take until="window", and the exact method. Under a
            record A and omega are units alone, one number each.
        refine: Levels of refinement: every 2^refine-th cell along each axis is computed, then only those at borders
            between kinds of motion or where P is not interpolated to 1 %, and the others are filled.
            `computed` says which are which.
        starts: How many starts every cell has, spread over the gap and over velocities between -0.6 and 0.6 as those of
            `basin_fractions`. With more than one the map does not hang on u0 and v0, which are left out: P is the mean
            over the starts, and variables of its own, on the page of outputs, tell the attractors that share them. Of
            the settings it takes periods and wall.
        progress: Called with (cells done, cells in all) from the calling thread, first before anything is run. While a
            plane is refined, all are those known to be needed, and grow.
        out: Zarr store, named `*.zarr`, to write tile by tile, so that memory is set by a tile. It opens at any time,
            cells that were not run yet by their `status`; stopped in whatever way, the same call goes on with what is
            left of it, and mends what was damaged. A refined plane is written when it is whole. Without, everything is
            in memory.
        overwrite: Begin anew whatever the store holds; what vijax did not write is never replaced.
        workers: With `out`: who runs and writes the tiles, under Dask (extra `cluster`): so many new processes, which
            share the cores, or the address of a scheduler whose workers see `out` under the same path. A worker runs a
            tile a thread, on its first device. New processes import the calling script: what it does must stand under
            `if __name__ == "__main__":`.

    Returns:
        A dataset with one dimension per array, every parameter as a coordinate with units, and the variables wanted,
        each without the dimensions that it cannot depend on. P is in joules per HALF forcing period. Believe it only
        where `admissible` is true, and read `status` (CF flags) where `period` is -1. Attributes record versions,
        commit, machine, tolerances and every setting. With `out` nothing of it is read before it is looked at.
        What a cell's numbers are does not depend on the other cells, to the last bit on one kind of device. Where other
        `outputs`, or another number of variants, make another program, it rounds otherwise: periodic cells agree to
        1e-12, aperiodic ones, where chaos makes much of a rounding, within the errors of their averages.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
        OSError: If `out` holds anything else, is being written by another run, or can be written no more; if no
            scheduler answers, or its workers are lost.
        ModuleNotFoundError: With `workers` but without Dask.

    Warns:
        UserWarning: If beta exceeds pi/2, or gravity holds the ball in every cell.

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
    starts = checks.whole("starts", starts, 1, MOST_STARTS)
    if outputs is None:
        outputs = default_outputs(starts, tiled_store.begun(out, checks.flag("overwrite", overwrite)))
    return run(plan(axes, outputs, device, settings, refine, starts), progress, out, overwrite, workers)


@door
def plan(
    axes: Mapping[str, Any],
    outputs: Iterable[str] | None = None,
    device: Harvester | None = None,
    settings: SweepSettings = DEFAULT,
    refine: int | None = None,
    starts: int = 1,
) -> SweepPlan:
    """Check what a sweep is asked for and lay out its cells; runs nothing.

    Args:
        axes: Value or values of each axis; None counts as not given.
        outputs, device, refine, starts: As in `sweep`.
        settings: How the cells are run.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    tile_size.largest()  # what is wrong with the environment is said before anything runs
    starts = checks.whole("starts", starts, 1, MOST_STARTS)
    if outputs is None:
        outputs = default_outputs(starts)
    wanted = checks.words("outputs", outputs, table(starts))
    device = one_device(device)
    given = {name: values for name, values in axes.items() if values is not None}
    if starts > 1:
        _check_spread(given, settings, refine)
    method = settings.integrator(units_of_record(device, given, settings.excitation))
    law = Linear() if method is None else method.law
    lossy = one_of(law).restitution
    laid_out = cells(given, device, settings.wall, restitution=lossy, dimensional=has_units(law))
    for dim in laid_out.sizes:
        if dim in {*table(1), *table(2), "computed", "start"}:
            raise ValueError(f"the dimension {dim} must not have the name of a variable of the map; rename it")
    if starts > 1:
        named = {name: values for name, values in laid_out.quantities.items() if name not in ("u0", "v0")}
        laid_out = replace(laid_out, quantities=named)
    return SweepPlan(
        cells=laid_out,
        settings=settings,
        method=method,
        # No map can be read without knowing how its cells ended.
        outputs=tuple(name for name in table(starts) if name in wanted or name == "status"),
        device=device,
        refine=0 if refine is None else _levels(refine, laid_out, settings.until),
        starts=starts,
    )


def _check_spread(given: Mapping[str, Any], settings: SweepSettings, refine: int | None) -> None:
    """Raise unless cells can be run from many starts each."""
    for name in ("u0", "v0"):
        if name in given:
            raise ValueError(
                f"{name} must be left out where cells have several starts; got {checks.shown(given[name])}"
            )
    if refine is not None:
        raise ValueError(f"refine must be left out where cells have several starts; got {checks.shown(refine)}")
    if settings.excitation is not None:
        raise ValueError(
            f"excitation must be left out of a map of several starts; got {settings.excitation}; vijax.response runs "
            "many starts of one device"
        )
    settings.only("a map of several starts", "periods", "wall")


def _levels(refine: Any, of: Cells, until: str) -> int:
    levels = checks.whole("refine", refine, 1)
    if shared := [dim for dim in of.sizes if dim not in of.given]:
        raise ValueError(f"refine must be left out where axes share a dimension, here {shared[0]}; got {levels}")
    if until != "attractor":
        raise ValueError(
            see("maps", f"refine must be left out with until={until!r}, whose cells have no label; got {levels}")
        )
    longest = max((of.sizes[dim] for dim in of.dynamic), default=1)
    most = refinement.most_levels(longest)
    if levels > most:
        raise ValueError(
            see(
                "maps",
                f"refine must leave 4 steps of 2^refine cells along the longest axis that the motion depends on, "
                f"at most {most} levels for {longest} values; got {levels}",
            )
        )
    return levels


@door
def run(
    planned: SweepPlan,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: cluster.Workers | None = None,
) -> "xr.Dataset":
    """Simulate the cells of a plan tile by tile on every device, and make its map; see `sweep`."""
    watch = estimate.Watch(checks.function("progress", progress) or (lambda done, total: None))
    checks.flag("overwrite", overwrite)
    if workers is not None:
        check_workers(planned, workers, out)
    if out is None:
        check_room(planned)
    else:
        check(planned, out, overwrite)
    if (expected := estimate.of(planned)).long:
        _LOG.warning("a long run begins: %s", expected)
    found = _run(planned, watch, None if out is None else Path(out), overwrite, workers)
    if not planned.refine:
        watch.keep(planned)
    warn_if_held(found)
    return found


def _run(
    planned: SweepPlan,
    tell: Callable[[int, int], None],
    out: Path | None,
    overwrite: bool,
    workers: cluster.Workers | None,
) -> "xr.Dataset":
    if out is None:
        return _refined(planned, tell) if planned.refine else label(planned, _in_memory(planned, tell))
    if planned.refine:
        # Which cells are computed depends on all that were: no part of it could be gone on with.
        save(_refined(planned, tell), out, overwrite=overwrite)
        return view(out)
    if workers is None and not out.exists():
        store_filling.compile_ahead(planned)
    with tiled_store.opened(planned, out, overwrite) as plane:
        store_filling.fill(plane, tell, workers)
    return view(out)


def check(planned: SweepPlan, out: str | Path, overwrite: bool = False) -> None:
    """Raise unless the map of a plan can be written there, or goes on there; makes nothing.

    Raises:
        ValueError, OSError: As `tiled_store.check`; of a refined map as `store_folder.check_store`, or it does not fit
            in memory.
    """
    for name, labels in planned.cells.labels.items():
        if labels.dtype.kind == "U":
            raise ValueError(f"out must be left out where {name} has texts along it; got {out}; give it numbers")
    if planned.refine:
        check_store("out", out, overwrite)
        check_room(planned)
    else:
        tiled_store.check(planned, checks.path("out", out), overwrite)


def check_room(planned: SweepPlan) -> None:
    """Raise ValueError unless the map of a plan fits in memory, where it is not written tile by tile."""
    names = [name for name, size in planned.cells.sizes.items() if size > 1]
    hint = "" if planned.refine else "; give out, a store that is written tile by tile"
    checks.fits(names, planned.size, f"{planned.count:,} cells", hint)


def check_workers(planned: SweepPlan, workers: cluster.Workers, out: str | Path | None) -> None:
    """Raise unless such workers can run the plan; starts none.

    Raises:
        ValueError, OSError, ModuleNotFoundError: As `cluster.check`; ValueError without a store, and with refinement.
    """
    if out is None:
        raise ValueError(
            see("studies", f"workers must come with out, the store that they write; got {checks.shown(workers)} alone")
        )
    if planned.refine:
        raise ValueError(
            see(
                "studies",
                "workers must be left out with refine, which goes on from all that was found; got "
                f"{checks.shown(workers)}",
            )
        )
    cluster.check(workers)


def _in_memory(planned: SweepPlan, tell: Callable[[int, int], None]) -> Fields:
    count = planned.count
    tell(0, count)
    found: Fields = {}
    for done in dispatch.compute(planned, np.arange(count), found):
        tell(done, count)
    return found


def _refined(planned: SweepPlan, tell: Callable[[int, int], None]) -> "xr.Dataset":
    """Make the map of a plan of which a part is computed, in rounds, and the rest filled."""
    of = planned.cells
    varied = [dim for dim in of.dynamic if of.sizes[dim] > 1]
    mesh = refinement.Mesh(tuple(of.given[dim].values for dim in varied), planned.refine)
    level_ground = of.pair(np.arange(of.count), planned.settings.wall).symmetric & planned.mirrored
    asked = replace(planned, outputs=tuple(dict.fromkeys((*planned.outputs, *refinement.NEEDS))))
    found: Fields = {}
    computed = np.zeros(of.count, bool)
    past = 0
    for cells_wanted in refinement.rounds(mesh, found, level_ground):
        tell(past, past + cells_wanted.size)
        # The tile of the whole plane for all rounds: one program to compile, and the one of the plane in full.
        for done in dispatch.compute(asked, cells_wanted, found, dispatch.rows_each(of.count)):
            tell(past + done, past + cells_wanted.size)
        computed[cells_wanted] = True
        past += cells_wanted.size
    refinement.fill(mesh, found, computed, level_ground)
    told = {"units": "1", "long_name": "whether the cell was computed; the others are filled between those that were"}
    dataset = label(planned, found)
    dataset["computed"] = of.dynamic, computed.reshape([of.sizes[dim] for dim in of.dynamic]), told
    dataset.attrs |= {
        "refine": planned.refine,
        "refine_tolerance": refinement.TOLERANCE,
        "refine_computed": past,
        "refine_shown": of.count,
    }
    return dataset
