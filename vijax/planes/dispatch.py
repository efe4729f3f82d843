"""Compiled calls over the cells of a plan, on every device and core, each as it is done."""

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

from vijax.batch import lanes, simulate
from vijax.planes import tile_size
from vijax.planes.cells import Places
from vijax.planes.dataset import SweepPlan
from vijax.planes.expected import NEEDS, ManyStarts
from vijax.planes.start_places import start_places
from vijax.planes.sweep_settings import SPEED
from vijax.runtime import context
from vijax.runtime.tiles import padded, places

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)
# Says at INFO what a run is waiting for: the command shows it at its progress bar.
_WAITING = logging.getLogger("vijax.waiting")

Fields = dict[str, np.ndarray]
"""Fields of `Summary`, or of `expected.ManyStarts`, by name."""

Part = np.ndarray | slice
"""Some of an array's cells, by their places in it; `_ALL` of them in order."""

_ALL = slice(None)


class Call(NamedTuple):
    """Cells of a plan by flat index, how many rows their call has at least, and which tile it is."""

    planned: SweepPlan
    cells: np.ndarray
    rows: int
    number: int


def rows_for(cells: int) -> int:
    """Find how many rows the call for so many cells has at least: a power of two, so that few programs are compiled."""
    return padded(cells) if lanes.few(cells) else max(padded(cells), tile_size.smallest())


def rows_each(cells: int) -> int:
    """Find how many rows a call has at least where there are so many cells for all devices together."""
    return min(rows_for(math.ceil(cells / len(places()))), tile_size.largest())


def compute(planned: SweepPlan, wanted: np.ndarray, found: Fields, rows: int | None = None) -> Iterator[int]:
    """Compute cells, given by flat indices, into fields over all cells; yield how many are done."""
    of, done = planned.cells, 0
    # Level cells have a faster program, and one cell with gravity in a call would keep all of it from that.
    for kind in _kinds(planned, wanted):
        group = wanted[kind]
        for index, part in _each(planned, group, rows or rows_each(group.size)):
            _put(found, of.count, _ALL if np.array_equal(index, np.arange(of.count)) else index, part)
            done += index.size
            yield done


def _each(planned: SweepPlan, group: np.ndarray, rows: int) -> Iterator[tuple[np.ndarray, Fields]]:
    """Yield flat indices and fields of every call over a group of cells, as the calls are done."""
    if not group.size:
        return
    # Strided tiles are samples of the whole plane: they cost the same, and nobody is left with the slow corner.
    number = max(math.ceil(group.size / rows), min(len(places()), math.ceil(group.size / tile_size.smallest())))
    for call, found, _ in in_turn(Call(planned, group[first::number], rows, first) for first in range(number)):
        yield call.cells, found


def _put(found: Fields, count: int, index: Part, part: Fields) -> None:
    """Lay a part of the cells into the fields of all; what is all of them is not copied."""
    if isinstance(index, slice):
        found.update(part)
        return
    for name, values in part.items():
        found.setdefault(name, np.empty((count, *values.shape[1:]), values.dtype))[index] = values


def in_turn(calls: Iterable[Call]) -> Generator[tuple[Call, Fields, float], None, None]:
    """Yield calls, their fields and the seconds they took, as they are done; the next ones run meanwhile."""
    calls, here = iter(calls), places()
    free: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
    for place in here:
        free.put(place)
    # Nothing runs on the calling thread: a compiled call or a compilation there would keep Ctrl-C waiting.
    pool = context.pool(len(here))
    running: dict[Future[tuple[Fields, float]], Call] = {}
    stopped = threading.Event()

    def fill() -> None:
        for call in itertools.islice(calls, len(here) + 1 - len(running)):  # one waits, so that nobody does
            running[pool.submit(_where_free, call, free, stopped)] = call

    try:
        if first := next(calls, None):
            # Programs are compiled before any call, whose seconds would otherwise hold that time.
            _WAITING.info("compiling")
            wait([pool.submit(prepare, first, place) for place in set(here)])
            _WAITING.info("running %s cells side by side, done with the slowest", f"{first.cells.size:,}")
            calls = itertools.chain([first], calls)
        fill()
        while running:
            done = wait(running, return_when=FIRST_COMPLETED).done
            # Calls are given in the order in which they began, whichever of them ended first.
            for future in [future for future in running if future in done]:
                call = running.pop(future)
                fill()
                yield call, *future.result()
    finally:
        # After Ctrl-C the waiting calls are dropped, and those that run end by themselves, or between two starts.
        stopped.set()
        pool.shutdown(wait=False, cancel_futures=True)


def _where_free(call: Call, free: "queue.SimpleQueue[jax.Device]", stopped: threading.Event) -> tuple[Fields, float]:
    """Perform a call on a device that is free."""
    place = free.get()
    try:
        return perform(call, place, stopped)
    finally:
        free.put(place)


def perform(call: Call, place: jax.Device, stopped: threading.Event | None = None) -> tuple[Fields, float]:
    """Compute the fields for the cells of a call, unless stopped before; give them and the seconds it took."""
    began = time.perf_counter()
    _LOG.info("tile %d begins", call.number)
    found: Fields = {}
    for part in _kinds(call.planned, call.cells):
        cells = call.cells[part]
        _put(found, call.cells.size, part, _summarise(call, cells, cells.size, place, stopped))
    return found, time.perf_counter() - began


def prepare(call: Call, place: jax.Device) -> None:
    """Compile what a call needs, without running a cell. Threads that ask for the same wait for one, by `jax.jit`."""
    of = call.planned.cells
    for part in _kinds(call.planned, call.cells):
        # The steepest cell stands for all: which program they have depends on it, and on how many they are.
        cells = call.cells[part]
        gamma = of.quantities["gamma"]
        steepest = np.argmax(np.abs(of.flat(gamma, cells))) if gamma.dims else 0
        _summarise(call, cells[steepest : steepest + 1], 0, place)


def _kinds(planned: SweepPlan, cells: np.ndarray) -> list[Part]:
    """Find the places of level cells, which have a faster program, and of the others; those that there are."""
    gamma = planned.cells.quantities["gamma"]
    if not gamma.dims:
        return [_ALL]
    level = planned.cells.flat(gamma, cells) == 0
    return [kind for kind in (np.flatnonzero(level), np.flatnonzero(~level)) if kind.size]


def _summarise(
    call: Call, index: np.ndarray, count: int, place: jax.Device, stopped: threading.Event | None = None
) -> Fields:
    """Compute fields for the first `count` of these cells, from the one start of each or from many."""
    planned = call.planned
    of = planned.cells
    rows = of.places(index)  # where no cell is run, one is laid out
    if planned.starts == 1:
        u0, v0 = (of.flat(of.quantities[name], rows) for name in ("u0", "v0"))
        return _run(call, rows, count, place, (u0, v0), planned.needs)
    d = of.flat(of.quantities["d"], rows)
    folded = ManyStarts(of.pair(index[:count], planned.settings.wall).symmetric & planned.mirrored)
    # Where programs are compiled and no cell is run, one start does.
    for across, speed in start_places(planned.starts if count else 1).T:
        if stopped is not None and stopped.is_set():
            raise CancelledError
        start = across * d, np.full(d.shape, 2 * SPEED * speed)
        folded.add(_run(call, rows, count, place, start, NEEDS | (planned.needs & simulate.DEEP)))
    found = folded.fields()
    return {name: found[name] for name in planned.needs}


def _run(
    call: Call,
    rows: Places,
    count: int,
    place: jax.Device,
    start: tuple[Any, Any],
    needs: frozenset[str],
) -> Fields:
    """Compute fields of `Summary` from a start of every cell, padded so that one program serves all."""
    planned = call.planned
    of, settings = planned.cells, planned.settings

    # Arrays stay NumPy's until they are packed: they are checked first, here and not on a device.
    kind = np.dtype(settings.dtype)

    def column(quantity: "xr.Variable") -> Any:
        return of.flat(quantity, rows).astype(kind, copy=False)

    def factors(scale: "xr.Variable") -> Any:
        own = of.factors(scale).astype(kind)
        return np.resize(own, padded(own.size))

    pair = jax.tree.map(lambda x: x.astype(kind, copy=False), of.pair(rows, settings.wall))
    u0, v0 = (values.astype(kind, copy=False) for values in start)
    summary = simulate.summarise(
        pair,
        u0,
        v0,
        simulate.Scale(
            length=column(of.length),
            speed=column(of.speed),
            length_variant=factors(of.length),
            speed_variant=factors(of.speed),
        ),
        jax.tree.map(lambda constant: np.asarray(constant, settings.dtype), planned.device),
        periods=settings.periods,
        until=settings.until,
        transient=settings.transient,
        outputs=needs,
        method=planned.method,
        count=count,
        padded=call.rows,
        on=place,
    )
    variants = of.factors(of.length).size
    fields = {name: getattr(summary, name) for name in needs}
    return {name: field if field.ndim == 1 else field[:, :variants] for name, field in fields.items()}
