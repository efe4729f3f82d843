"""Simulation of the tiles of a store, each written when complete: by this process on all devices, or by a cluster."""

import logging
import math
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from functools import partial

import numpy as np

from vijax.maps.execution import cluster, dispatch
from vijax.maps.execution.dispatch import Call
from vijax.maps.map_dataset import SweepPlan, variables
from vijax.maps.storage import tiled_store
from vijax.runtime import validation
from vijax.runtime.public_api import public_api, start_in_thread
from vijax.runtime.tiles import tile_devices

_LOG = logging.getLogger(__name__)


def compile_ahead(plan: SweepPlan) -> None:
    """Start to compile the program of the tiles of a new store in a background thread.

    XLA compiles without Python's lock, so the import of zarr proceeds on another core meanwhile.
    """
    cells = math.prod(tiled_store.tile_lengths(plan.cells).values())
    first_tile = Call(plan, np.arange(min(cells, plan.count)), dispatch.min_rows(cells), 0)
    start_in_thread(dispatch.compile_call, first_tile, tile_devices()[0])


def fill(plane: tiled_store.Study, notify: Callable[[int, int], None], workers: cluster.Workers | None) -> None:
    """Simulate and write the unfinished tiles of a study, a map on disk that is written tile by tile."""
    # Damaged tiles are run again along with the unfinished ones.
    remaining = tiled_store.tiles_to_run(plane, _LOG.warning)
    total = plane.plan.count
    done = total - sum(map(plane.count, remaining))
    tiles = map(plane.tile, remaining)
    try:
        notify(done, total)
        # Close the generator at once on any error; otherwise workers would continue as long as the error is referenced.
        with closing(_completed_tiles(tiles, dispatch.min_rows(plane.max_tile_cells), workers)) as completed:
            for tile in completed:
                done += tile.plan.count
                notify(done, total)
    except (KeyboardInterrupt, OSError) as error:
        # Count again from disk: workers may have written tiles after their last report.
        done = total - sum(map(plane.count, tiled_store.unfinished(plane)))
        path = validation.path_text(plane.path)
        error.add_note(f"{done:,} of {total:,} cells are in {path}; the same command continues from there")
        raise


def _completed_tiles(
    tiles: Iterable[tiled_store.StudyTile], rows: int, workers: cluster.Workers | None
) -> Generator[tiled_store.StudyTile, None, None]:
    """Yield tiles as they complete, in this process or on a cluster."""
    if workers is None:
        yield from _local_tiles(tiles, rows)
    else:
        yield from cluster.run_tasks(partial(fill_tile, rows), tiles, workers)


def _local_tiles(tiles: Iterable[tiled_store.StudyTile], rows: int) -> Iterator[tiled_store.StudyTile]:
    """Yield tiles, simulated and written by this process, as they complete."""
    running: dict[int, tiled_store.StudyTile] = {}

    def calls() -> Iterator[Call]:
        for tile in tiles:
            # Calls complete in any order, so the tile of a call is found by the number of the call.
            running[tile.number] = tile
            yield _call_of_tile(tile, rows)

    with closing(dispatch.run_calls(calls())) as completed:
        for call, fields, seconds in completed:
            tiled_store.write_tile(running[call.number], variables(call.plan, fields), seconds)
            yield running.pop(call.number)


@public_api
def fill_tile(rows: int, tile: tiled_store.StudyTile) -> None:
    """Simulate and write a tile on the first device of a worker."""
    call, device = _call_of_tile(tile, rows), tile_devices()[0]
    # Compiled first, so that the recorded duration excludes the compilation.
    dispatch.compile_call(call, device)
    fields, seconds = dispatch.run_call(call, device)
    tiled_store.write_tile(tile, variables(tile.plan, fields), seconds)


def _call_of_tile(tile: tiled_store.StudyTile, rows: int) -> Call:
    """Return the call for all cells of a tile."""
    return Call(tile.plan, np.arange(tile.plan.count), rows, tile.number)
