"""Compiled calls over the cells of a plan, distributed over all devices and cores, yielded as they complete.

A call computes many cells side by side (lanes, `vijax.simulation`). Cells of a plane are split into strided calls
(every n-th cell) of about equal cost; one worker thread per device takes calls from a common queue. Level cells (gamma
= 0) and inclined cells use different compiled programs and are summarised separately.
"""

import itertools
import logging
import math
import queue
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from vijax.maps.cells import CellPositions
from vijax.maps.execution import tile_size
from vijax.maps.execution.start_lattice import unit_starts
from vijax.maps.map_dataset import SweepPlan
from vijax.maps.start_statistics import SUMMARY_FIELDS, StartStatistics
from vijax.maps.sweep_settings import SPEED
from vijax.runtime import public_api
from vijax.runtime.tiles import padded, tile_devices
from vijax.simulation import simulate
from vijax.simulation.scheduler import lane_scheduler

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)
# Messages at level INFO name the step that a run waits for; the command shows them beside its progress bar.
_STATUS_LOG = logging.getLogger("vijax.waiting")

Fields = dict[str, np.ndarray]
"""Fields of `Summary`, or of `start_statistics.StartStatistics`, by name."""

Subset = np.ndarray | slice
"""Positions of some cells in an array; the slice `_ALL` means all of them in order."""

_ALL = slice(None)


class Call(NamedTuple):
    """Cells of a plan that one compiled call computes.

    Attributes:
        plan: The plan.
        cells: Flat indices of the cells.
        rows: Least number of rows of the arrays passed to the device; more rows than cells are padding.
        number: Number of the tile, for logs and stores.
    """

    plan: SweepPlan
    cells: np.ndarray
    rows: int
    number: int


def min_rows(cells: int) -> int:
    """Return the least number of rows of a call for this many cells: a power of two, so that few programs exist."""
    # Small planes on a CPU have a program of their own (`lane_scheduler.uses_small_batch`), which needs no least number
    # of rows.
    return padded(cells) if lane_scheduler.uses_small_batch(cells) else max(padded(cells), tile_size.min_cells())


def min_rows_per_device(cells: int) -> int:
    """Return the least number of rows of a call if this many cells are divided among all devices."""
    return min(min_rows(math.ceil(cells / len(tile_devices()))), tile_size.max_cells())


def compute(plan: SweepPlan, indices: np.ndarray, fields: Fields, rows: int | None = None) -> Iterator[int]:
    """Compute cells into fields over all cells; yield the number of completed cells after every call.

    Args:
        plan: The plan.
        indices: Flat indices of the cells to compute.
        fields: Fields over all cells, filled in place.
        rows: Least number of rows of a call; by default chosen from the number of cells.
    """
    all_cells, done = plan.cells, 0
    # Level cells have a faster program. A call that contains a single inclined cell would have to use the slower
    # program for all its cells.
    for subset in _split_by_gravity(plan, indices):
        group = indices[subset]
        for index, part_fields in _compute_group(plan, group, rows or min_rows_per_device(group.size)):
            _copy_fields(
                fields,
                all_cells.count,
                _ALL if np.array_equal(index, np.arange(all_cells.count)) else index,
                part_fields,
            )
            done += index.size
            yield done


def _compute_group(plan: SweepPlan, group: np.ndarray, rows: int) -> Iterator[tuple[np.ndarray, Fields]]:
    """Yield flat indices and fields of every call over a group of cells, as the calls complete."""
    if not group.size:
        return
    # Each call takes every `number`-th cell of the whole plane, so that calls cost about the same and no device gets
    # the slow corner of the plane alone. At least one call per device, unless the calls would become smaller than the
    # smallest tile.
    number = max(math.ceil(group.size / rows), min(len(tile_devices()), math.ceil(group.size / tile_size.min_cells())))
    for call, fields, _ in run_calls(Call(plan, group[first::number], rows, first) for first in range(number)):
        yield call.cells, fields


def _copy_fields(fields: Fields, count: int, index: Subset, part_fields: Fields) -> None:
    """Copy the fields of a part of the cells into the fields of all; a part with all cells is taken without a copy."""
    if isinstance(index, slice):
        fields.update(part_fields)
        return
    for name, values in part_fields.items():
        # The first part allocates the arrays over all cells.
        fields.setdefault(name, np.empty((count, *values.shape[1:]), values.dtype))[index] = values


def run_calls(calls: Iterable[Call]) -> Generator[tuple[Call, Fields, float], None, None]:
    """Yield calls, their fields and their durations [s] as they complete, while the next calls run."""
    calls, devices = iter(calls), tile_devices()
    free_devices: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
    for device in devices:
        free_devices.put(device)
    # Nothing runs on the calling thread, because Ctrl-C would wait there for a compiled call or a compilation to end.
    pool = public_api.pool(len(devices))
    running: dict[Future[tuple[Fields, float]], Call] = {}
    stopped = threading.Event()

    def fill() -> None:
        # one more than devices, so that no device waits for the next call
        for call in itertools.islice(calls, len(devices) + 1 - len(running)):
            running[pool.submit(_run_on_free_device, call, free_devices, stopped)] = call

    try:
        if first := next(calls, None):
            # Programs are compiled before the first call, so that its duration does not include the compilation.
            _STATUS_LOG.info("compiling")
            wait([pool.submit(compile_call, first, device) for device in set(devices)])
            _STATUS_LOG.info("running %s cells side by side, done with the slowest", f"{first.cells.size:,}")
            calls = itertools.chain([first], calls)
        fill()
        while running:
            done = wait(running, return_when=FIRST_COMPLETED).done
            # Yield calls that complete together in the order of their submission.
            for future in [future for future in running if future in done]:
                call = running.pop(future)
                fill()
                yield call, *future.result()
    finally:
        # After Ctrl-C the waiting calls are dropped; running calls end by themselves, or between two starts.
        stopped.set()
        pool.shutdown(wait=False, cancel_futures=True)


def _run_on_free_device(
    call: Call, free_devices: "queue.SimpleQueue[jax.Device]", stopped: threading.Event
) -> tuple[Fields, float]:
    """Run a call on the next free device."""
    device = free_devices.get()
    try:
        return run_call(call, device, stopped)
    finally:
        free_devices.put(device)


def run_call(call: Call, device: jax.Device, stopped: threading.Event | None = None) -> tuple[Fields, float]:
    """Compute the fields of the cells of a call; return them and the duration [s]. Raises CancelledError if stopped."""
    began = time.perf_counter()
    _LOG.info("tile %d begins", call.number)
    fields: Fields = {}
    for subset in _split_by_gravity(call.plan, call.cells):
        cells = call.cells[subset]
        _copy_fields(fields, call.cells.size, subset, _summarise(call, cells, cells.size, device, stopped))
    return fields, time.perf_counter() - began


def compile_call(call: Call, device: jax.Device) -> None:
    """Compile the programs of a call without simulating a cell.

    If several threads compile the same program at once, `jax.jit` compiles it in one thread, and the others wait.
    """
    all_cells = call.plan.cells
    for subset in _split_by_gravity(call.plan, call.cells):
        # The program depends only on the largest |gamma| of the cells and on the rows of the call, so the steepest cell
        # alone is enough to compile it.
        cells = call.cells[subset]
        gamma = all_cells.quantities["gamma"]
        steepest = np.argmax(np.abs(all_cells.flat(gamma, cells))) if gamma.dims else 0
        _summarise(call, cells[steepest : steepest + 1], 0, device)


def _split_by_gravity(plan: SweepPlan, cells: np.ndarray) -> list[Subset]:
    """Return positions of level cells, which have a faster program, and of inclined cells; omits empty groups."""
    gamma = plan.cells.quantities["gamma"]
    if not gamma.dims:
        return [_ALL]
    level = plan.cells.flat(gamma, cells) == 0
    return [subset for subset in (np.flatnonzero(level), np.flatnonzero(~level)) if subset.size]


def _summarise(
    call: Call, index: np.ndarray, count: int, device: jax.Device, stopped: threading.Event | None = None
) -> Fields:
    """Compute fields for the first `count` cells of `index`, from the one start of each cell or from many."""
    plan = call.plan
    all_cells = plan.cells
    positions = all_cells.positions(index)  # has one cell where only the program is compiled (count = 0)
    if plan.starts == 1:
        u0, v0 = (all_cells.flat(all_cells.quantities[name], positions) for name in ("u0", "v0"))
        return _summarise_start(call, positions, count, device, (u0, v0), plan.needs)
    d = all_cells.flat(all_cells.quantities["d"], positions)
    statistics = StartStatistics(all_cells.pair(index[:count], plan.settings.wall).symmetric & plan.mirrored)
    # One start is enough where only the program is compiled.
    for unit_gap, unit_speed in unit_starts(plan.starts if count else 1).T:
        # A compiled call cannot be interrupted, so the computation stops only between two starts.
        if stopped is not None and stopped.is_set():
            raise CancelledError
        # Positions of `unit_starts` lie in [-1/2, 1/2]: displacements cover the gap, velocities [-SPEED, SPEED].
        start = unit_gap * d, np.full(d.shape, 2 * SPEED * unit_speed)
        statistics.add(
            _summarise_start(call, positions, count, device, start, SUMMARY_FIELDS | (plan.needs & simulate.DEEP))
        )
    all_fields = statistics.fields()
    return {name: all_fields[name] for name in plan.needs}


def _summarise_start(
    call: Call,
    positions: CellPositions,
    count: int,
    device: jax.Device,
    start: tuple[Any, Any],
    needs: frozenset[str],
) -> Fields:
    """Compute fields of `Summary` from one start of every cell, padded so that one program serves many plans."""
    plan = call.plan
    all_cells, settings = plan.cells, plan.settings

    # Arrays stay NumPy arrays until they are packed, because they are validated first, on the host.
    dtype = np.dtype(settings.dtype)

    def column(quantity: "xr.Variable") -> Any:
        return all_cells.flat(quantity, positions).astype(dtype, copy=False)

    def factors(scale: "xr.Variable") -> Any:
        variant_factors = all_cells.factors(scale).astype(dtype)
        # Padded by repetition, so that plans with similar numbers of variants share a program.
        return np.resize(variant_factors, padded(variant_factors.size))

    pair = jax.tree.map(lambda x: x.astype(dtype, copy=False), all_cells.pair(positions, settings.wall))
    u0, v0 = (values.astype(dtype, copy=False) for values in start)
    summary = simulate.summarise(
        pair,
        u0,
        v0,
        simulate.Scale(
            length=column(all_cells.length),
            speed=column(all_cells.speed),
            length_variant=factors(all_cells.length),
            speed_variant=factors(all_cells.speed),
        ),
        jax.tree.map(lambda constant: np.asarray(constant, settings.dtype), plan.device),
        periods=settings.periods,
        until=settings.until,
        transient=settings.transient,
        outputs=needs,
        method=plan.method,
        count=count,
        padded=call.rows,
        on=device,
    )
    variants = all_cells.factors(all_cells.length).size
    fields = {name: getattr(summary, name) for name in needs}
    # Columns beyond the variants of the plan are padding.
    return {name: field if field.ndim == 1 else field[:, :variants] for name, field in fields.items()}
