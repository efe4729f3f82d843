"""Sweeps: axes -> cells -> tiles on every device and core -> a labelled map, in memory or on disk.

`plan` checks everything that can be wrong and starts nothing, `run` does the work, `sweep` is both.
"""

import itertools
import logging
import math
import queue
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from vijax import cluster, simulate, study
from vijax import method as methods
from vijax import refine as refinement
from vijax.axes import Cells, cells
from vijax.dataset import ON_REQUEST, OUTPUTS, Plan, label, variables
from vijax.lanes import places
from vijax.membrane import HuntCrossley, Law
from vijax.model import Harvester, ImpactPair
from vijax.store import check_output, load, save, view
from vijax.study import LARGEST_TILE, SMALLEST_TILE

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Axes", "load", "plan", "run", "save", "sweep"]

_CHOICES = {
    "until": ("attractor", "window"),
    "wall": ("soft", "rigid"),
    "dtype": ("float64", "float32"),
}
_LOG = logging.getLogger(__name__)

Fields = dict[str, np.ndarray]  # of `Summary`, by name


class Axes(TypedDict, total=False):
    """The axes of a sweep, each a number or a 1-D array; `vijax.axes.AXES` describes them."""

    d: ArrayLike
    kappa: ArrayLike
    r: ArrayLike
    gamma: ArrayLike
    omega: ArrayLike
    s: ArrayLike
    omega0: ArrayLike
    k: ArrayLike
    A: ArrayLike
    beta: ArrayLike
    u0: ArrayLike
    v0: ArrayLike


def sweep(
    *,
    periods: int = 400,
    until: str = "attractor",
    transient: int = 0,
    wall: str = "soft",
    method: str = "exact",
    solver: str | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    membrane: Law | None = None,
    steps: int | None = None,
    outputs: Iterable[str] | None = None,
    device: Harvester | None = None,
    dtype: str = "float64",
    refine: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: cluster.Workers | None = None,
    **axes: Unpack[Axes],
) -> "xr.Dataset":
    """Energy harvested over a plane, or any product, of parameters, with all that tells whether to believe it.

    Each axis is a number or a 1-D array; arrays become dimensions in the order in which they are given:

        sweep(d=np.linspace(0.05, 0.3, 128), kappa=np.geomspace(3, 400, 128), r=0.5)  # the (d, kappa) plane
        sweep(omega=np.pi * np.linspace(1, 12, 64), omega0=np.linspace(20, 400, 64))  # one device, other frequencies
        sweep(d=0.2, kappa=np.geomspace(3, 400, 64), A=[1, 2, 5])                     # here A enters energies alone

    Dimensionless axes are d, kappa, r, gamma and the start u0, v0; physical ones omega [rad/s], s [m], omega0 [rad/s]
    or k [N/m], A [m/s^2], beta [rad]. d and s are one quantity, so are kappa, omega0 and k, gamma and beta: give one
    of each. Whatever no axis gives is the device's (s, omega0, r, A, omega, beta): d follows omega unless d is given.
    The start is u0 = min(0.05853, 0.49 d), v0 = -0.47898 unless given.
    Cells that share (d, kappa, r, gamma, u0, v0) are simulated once however many omega or A there are, and with rigid
    walls however many kappa: it then enters energies alone.

    Args:
        periods: Forcing periods to run: at most (until="attractor"), or after the transient (until="window").
        until: "attractor" stops when the attractor is certain and measures over whole periods of it; "window" drops
            `transient` periods and measures over the next `periods`.
        transient: Forcing periods to drop first.
        wall: "soft" or "rigid".
        method: "exact", the event-driven engine; "ode", an adaptive solver of diffrax with located events; "rk4", the
            paper's fixed steps without event location (`vijax.rk4` says what it cannot know).
        solver: Of "ode": Tsit5 unless given; Bosh3, Dopri5, Dopri8, Kvaerno3, Kvaerno4 or Kvaerno5.
        rtol, atol: Of "ode": tolerances of position and velocity step by step, 1e-8 and 1e-10 unless given.
        membrane: Of "ode" and "rk4": `HuntCrossley(chi)` for the linear membrane. It takes no r: the map's
            `restitution` is what came out.
        steps: Of "rk4": steps per forcing period, 1000 unless given.
        outputs: The variables wanted, of those in `vijax.dataset.OUTPUTS`; all but `asymmetry` and `lyapunov` unless
            given. What is not wanted is not computed. `status` always comes.
        device: Constants of the device; Tables I and II unless given.
        dtype: "float64", or "float32" with tolerances to match.
        refine: Levels of refinement: every 2^refine-th cell along each axis is computed, then only those at borders
            between kinds of motion or where P is not interpolated to 1 %, and the others are filled (`vijax.refine`).
            `computed` says which are which.
        progress: Called with (cells done, cells in all) from the calling thread, first before anything is run. While a
            plane is refined, all are those known to be needed, and grow.
        out: Zarr store to write tile by tile, so that memory is set by a tile. It opens at any time, cells that were
            not run yet by their `status`; stopped in whatever way, the same call goes on with what is left of it.
            A refined plane is written when it is whole. Without, everything is in memory.
        overwrite: Begin anew whatever the store holds.
        workers: With `out`: who runs and writes the tiles, under Dask (extra `cluster`): so many new processes, which
            share the cores, or the address of a scheduler whose workers see `out` under the same path. A worker runs a
            tile a thread, on its first device. New processes import the calling script: what it does must stand under
            `if __name__ == "__main__":`.

    Returns:
        A dataset with one dimension per array, every parameter as a coordinate with units, and the variables wanted,
        each without the dimensions that it cannot depend on. P is in joules per HALF forcing period. Believe it only
        where `admissible` is true, and read `status` (CF flags) where `period` is -1. Attributes record versions,
        commit, machine, tolerances and every setting. With `out` nothing of it is read before it is looked at.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
        OSError: If `out` holds anything else, is being written by another run, or can be written no more; if no
            scheduler answers, or its workers are lost.
        ModuleNotFoundError: With `workers` but without Dask.

    Source: Eqs. (36)-(38), corrected.
    """
    planned = plan(
        axes,
        outputs,
        device,
        periods=periods,
        until=until,
        transient=transient,
        wall=wall,
        method=method,
        dtype=dtype,
        solver=solver,
        rtol=rtol,
        atol=atol,
        membrane=membrane,
        steps=steps,
        refine=refine,
    )
    return run(planned, progress, out, overwrite, workers)


def plan(
    axes: Mapping[str, Any], outputs: Iterable[str] | None = None, device: Harvester | None = None, **settings: Any
) -> Plan:
    """Check what a sweep is asked for and lay out its cells; runs nothing.

    Args:
        axes: Value or values of each axis; None counts as not given.
        outputs: As in `sweep`.
        device: As in `sweep`.
        settings: periods, until, transient, wall, method, dtype: all of them, as in `sweep`; and of solver, rtol, atol,
            membrane, steps, refine those that are given.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    for name, least in (("periods", 1), ("transient", 0)):
        settings[name] = methods.whole(name, settings[name], least)
    for name, allowed in _CHOICES.items():
        if settings[name] not in allowed:
            choices = " or ".join(f'"{choice}"' for choice in allowed)
            raise ValueError(f"{name} must be {choices}; got {settings[name]!r}")
    refine = settings.pop("refine", None)
    options = {name: settings.pop(name, None) for name in ("solver", "rtol", "atol", "membrane", "steps")}
    method = methods.choose(settings["method"], options, wall=settings["wall"], dtype=settings["dtype"])
    if outputs is None:
        outputs = (name for name in OUTPUTS if name not in ON_REQUEST)
    wanted = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in wanted:
        if name not in OUTPUTS:
            raise ValueError(f"outputs must be among {', '.join(OUTPUTS)}; got {name!r}")
    device = Harvester() if device is None else device
    given = {name: values for name, values in axes.items() if values is not None}
    lossy = method is None or not isinstance(method.law, HuntCrossley)
    laid_out = cells(given, device, settings["wall"], restitution=lossy)
    return Plan(
        cells=laid_out,
        settings=settings,
        method=method,
        # No map can be read without knowing how its cells ended.
        outputs=tuple(name for name in OUTPUTS if name in wanted or name == "status"),
        device=device,
        refine=0 if refine is None else _levels(refine, laid_out, settings["until"]),
    )


def _levels(refine: Any, of: Cells, until: str) -> int:
    levels = methods.whole("refine", refine, 1)
    if until != "attractor":
        raise ValueError(f"refine must be left out with until={until!r}, whose cells have no label; got {levels}")
    longest = max((of.sizes[dim] for dim in of.dynamic), default=1)
    most = refinement.most_levels(longest)
    if levels > most:
        raise ValueError(
            f"refine must leave 4 steps of 2^refine cells along the longest axis that the motion depends on, "
            f"at most {most} levels for {longest} values; got {levels}"
        )
    return levels


def run(
    planned: Plan,
    progress: Callable[[int, int], None] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    workers: cluster.Workers | None = None,
) -> "xr.Dataset":
    """The map of a plan, its cells simulated tile by tile on every device; see `sweep`."""
    tell = progress or (lambda done, total: None)
    if workers is not None:
        check_workers(planned, workers, out)
    if out is None:
        return _refined(planned, tell) if planned.refine else label(planned, _in_memory(planned, tell))
    check(planned, out, overwrite)
    if planned.refine:
        # Which cells are computed depends on all that were: no part of it could be gone on with.
        save(_refined(planned, tell), out, overwrite=overwrite)
        return view(out)
    if workers is None and not Path(out).exists():
        _compile_ahead(planned)
    with study.opened(planned, out, overwrite) as plane:
        _fill(plane, tell, workers)
    return view(out)


def check(planned: Plan, out: str | Path, overwrite: bool = False) -> None:
    """Raise unless the map of a plan can be written there, or goes on there; makes nothing.

    Raises:
        OSError: Of which kind `study.check` and `store.check_output` say.
    """
    if planned.refine:
        check_output("out", out, overwrite)
    else:
        study.check(planned, out, overwrite)


def check_workers(planned: Plan, workers: cluster.Workers, out: str | Path | None) -> None:
    """Raise unless such workers can run the plan; starts none.

    Raises:
        ValueError, OSError, ModuleNotFoundError: As `cluster.check`; ValueError without a store, and with refinement.
    """
    if out is None:
        raise ValueError(f"workers must come with out, the store that they write; got {workers!r} alone")
    if planned.refine:
        raise ValueError(
            f"workers must be left out with refine, which goes on from all that was found; got {workers!r}"
        )
    cluster.check(workers)


def _in_memory(planned: Plan, tell: Callable[[int, int], None]) -> Fields:
    count = planned.count
    tell(0, count)
    found: Fields = {}
    for done in _compute(planned, np.arange(count), found):
        tell(done, count)
    return found


def _refined(planned: Plan, tell: Callable[[int, int], None]) -> "xr.Dataset":
    """The map of a plan of which a part is computed, in rounds, and the rest filled."""
    of = planned.cells
    varied = [dim for dim in of.dynamic if of.sizes[dim] > 1]
    mesh = refinement.Mesh(tuple(of.given[dim].values for dim in varied), planned.refine)
    level_ground = of.flat(of.quantities["gamma"], np.arange(of.count)) == 0
    asked = replace(planned, outputs=tuple(dict.fromkeys((*planned.outputs, *refinement.NEEDS))))
    found: Fields = {}
    computed = np.zeros(of.count, bool)
    past = 0
    for cells_wanted in refinement.rounds(mesh, found, level_ground):
        tell(past, past + cells_wanted.size)
        # The tile of the whole plane for all rounds: one program to compile, and the one of the plane in full.
        for done in _compute(asked, cells_wanted, found, _share(of.count)):
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


def _compute(planned: Plan, wanted: np.ndarray, found: Fields, rows: int | None = None) -> Iterator[int]:
    """Compute cells, given by flat indices, into fields over all cells; yields how many are done."""
    of, done = planned.cells, 0
    gamma = of.flat(of.quantities["gamma"], wanted)
    # Level cells have a faster program, and one cell with gravity in a tile would keep all of it from that.
    for group in (wanted[gamma == 0], wanted[gamma != 0]):
        for index, part in _simulate_all(planned, group, rows or _share(group.size)):
            _put(found, of.count, index, part)
            done += index.size
            yield done


def _compile_ahead(planned: Plan) -> None:
    """Begin to compile what the tiles of a new store need: XLA needs no Python, and importing zarr a core."""
    most = math.prod(study.blocks(planned.cells).values())
    tile = _Tile(planned, np.arange(min(most, planned.count)), _rows(most), 0)
    ThreadPoolExecutor(1).submit(_compile, tile, places()[0])


def _fill(plane: study.Study, tell: Callable[[int, int], None], workers: cluster.Workers | None) -> None:
    """Simulate and write the tiles of a study that are not done."""
    left = study.left(plane, _LOG.warning)
    total = plane.planned.count
    done = total - sum(map(plane.count, left))
    tiles = map(plane.tile, left)
    try:
        tell(done, total)
        # Closed at once whatever happens, or workers would go on for as long as somebody holds the error.
        with closing(_made(tiles, _rows(plane.most), workers)) as made:
            for tile in made:
                done += tile.planned.count
                tell(done, total)
    except (KeyboardInterrupt, OSError) as error:
        error.add_note(f"{done:,} of {total:,} cells are in {plane.path}; the same command goes on from there")
        raise


def _made(tiles: Iterable[study.Tile], rows: int, workers: cluster.Workers | None) -> Generator[study.Tile, None, None]:
    """Tiles as they are done, by whomever."""
    if workers is None:
        yield from _here(tiles, rows)
    else:
        yield from cluster.done(partial(_make, rows), tiles, workers)


def _here(tiles: Iterable[study.Tile], rows: int) -> Iterator[study.Tile]:
    """Tiles, simulated and written by this process, as they are done."""
    running: dict[int, study.Tile] = {}

    def calls() -> Iterator[_Tile]:
        for tile in tiles:
            running[tile.number] = tile
            yield _whole(tile, rows)

    with closing(_in_turn(calls())) as ended:
        for call, found, seconds in ended:
            study.write(running[call.number], variables(call.planned, found), seconds)
            yield running.pop(call.number)


def _make(rows: int, tile: study.Tile) -> None:
    """Simulate and write a tile, in a worker, on its first device."""
    call, place = _whole(tile, rows), places()[0]
    _compile(call, place)
    found, seconds = _simulate(call, place)
    study.write(tile, variables(tile.planned, found), seconds)


class _Tile(NamedTuple):
    """Cells of a plan by flat index, how many rows their call has, and which tile it is."""

    planned: Plan
    cells: np.ndarray
    rows: int
    number: int


def _whole(tile: study.Tile, rows: int) -> _Tile:
    """All cells of a tile of a study."""
    return _Tile(tile.planned, np.arange(tile.planned.count), rows, tile.number)


def _rows(cells: int) -> int:
    """Rows of the call for so many cells: a power of two, so that few programs are compiled."""
    return max(1 << max(cells - 1, 0).bit_length(), SMALLEST_TILE)


def _put(found: Fields, count: int, index: np.ndarray, part: Fields) -> None:
    """Lay a part of the cells into the fields of all."""
    for name, values in part.items():
        found.setdefault(name, np.empty((count, *values.shape[1:]), values.dtype))[index] = values


def _share(cells: int) -> int:
    """Rows of a call where there are so many cells for all devices together."""
    return min(_rows(math.ceil(cells / len(places()))), LARGEST_TILE)


def _simulate_all(planned: Plan, group: np.ndarray, rows: int) -> Iterator[tuple[np.ndarray, Fields]]:
    """Flat indices and fields of `Summary` of every tile of a group of cells, as the tiles are done."""
    if not group.size:
        return
    # Strided tiles are samples of the whole plane: they cost the same, and nobody is left with the slow corner.
    number = max(math.ceil(group.size / rows), min(len(places()), math.ceil(group.size / SMALLEST_TILE)))
    for tile, found, _ in _in_turn(_Tile(planned, group[first::number], rows, first) for first in range(number)):
        yield tile.cells, found


def _in_turn(tiles: Iterable[_Tile]) -> Generator[tuple[_Tile, Fields, float], None, None]:
    """Tiles, their fields and the seconds they took, as they are done; the next ones run meanwhile."""
    tiles, here = iter(tiles), places()
    free: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
    for place in here:
        free.put(place)
    # No tile runs on the calling thread: a compiled call or a compilation there would keep Ctrl-C waiting.
    pool = ThreadPoolExecutor(len(here))
    running: dict[Future[tuple[Fields, float]], _Tile] = {}

    def fill() -> None:
        for tile in itertools.islice(tiles, len(here) + 1 - len(running)):  # one waits, so that nobody does
            running[pool.submit(_where_free, tile, free)] = tile

    try:
        if len(here) > 1 and (first := next(tiles, None)):
            # Or the first tiles' seconds would hold it.
            wait([pool.submit(_compile, first, place) for place in set(here)])
            tiles = itertools.chain([first], tiles)
        fill()
        while running:
            done = wait(running, return_when=FIRST_COMPLETED).done
            for future in [future for future in running if future in done]:  # in the order in which they began
                tile = running.pop(future)
                fill()
                yield tile, *future.result()
    finally:
        # After Ctrl-C the waiting tiles are dropped, and those that run end by themselves.
        pool.shutdown(wait=False, cancel_futures=True)


def _where_free(tile: _Tile, free: "queue.SimpleQueue[jax.Device]") -> tuple[Fields, float]:
    """As `_simulate`, on a device that is free."""
    place = free.get()
    try:
        return _simulate(tile, place)
    finally:
        free.put(place)


def _simulate(tile: _Tile, place: jax.Device) -> tuple[Fields, float]:
    """Fields of `Summary` for the cells of a tile, and the seconds it took."""
    began = time.perf_counter()
    _LOG.info("tile %d begins", tile.number)
    found: Fields = {}
    for part in _kinds(tile):
        _put(found, tile.cells.size, part, _summarise(tile, tile.cells[part], part.size, place))
    return found, time.perf_counter() - began


def _compile(tile: _Tile, place: jax.Device) -> None:
    """What the tile needs, without running a cell. Threads that ask for the same wait for one of them, by `jax.jit`."""
    for part in _kinds(tile):
        _summarise(tile, tile.cells[part], 0, place)


def _kinds(tile: _Tile) -> list[np.ndarray]:
    """Places of a tile's level cells, which have a faster program, and of the others; those that there are."""
    of = tile.planned.cells
    level = of.flat(of.quantities["gamma"], tile.cells) == 0
    return [kind for kind in (np.flatnonzero(level), np.flatnonzero(~level)) if kind.size]


def _summarise(tile: _Tile, index: np.ndarray, count: int, place: jax.Device) -> Fields:
    """Fields of `Summary` for the first `count` of these cells, padded so that one program serves all."""
    planned = tile.planned
    of, settings = planned.cells, planned.settings
    padded = np.resize(index, tile.rows)
    needs = planned.needs

    def column(quantity: "xr.Variable") -> jax.Array:
        return jnp.asarray(of.flat(quantity, padded).astype(settings["dtype"]))

    def factors(scale: "xr.Variable") -> jax.Array:
        return jnp.asarray(of.factors(scale).astype(settings["dtype"]))

    d, kappa, r, gamma, u0, v0 = (column(of.quantities[name]) for name in ("d", "kappa", "r", "gamma", "u0", "v0"))
    summary = simulate.summarise(
        ImpactPair(d=d, kappa=kappa if settings["wall"] == "soft" else None, r=r, gamma=gamma),
        u0,
        v0,
        simulate.Scale(
            length=column(of.length),
            speed=column(of.speed),
            length_variant=factors(of.length),
            speed_variant=factors(of.speed),
        ),
        jax.tree.map(lambda constant: np.asarray(constant, settings["dtype"]), planned.device),
        periods=settings["periods"],
        until=settings["until"],
        transient=settings["transient"],
        outputs=needs,
        method=planned.method,
        count=count,
        on=place,
    )
    return {name: getattr(summary, name)[:count] for name in needs}
