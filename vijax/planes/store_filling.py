"""The tiles of a store, simulated and written as they are done: by this process on every device, or by a cluster."""

import logging
import math
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from functools import partial

import numpy as np

from vijax.planes import cluster, dispatch, tiled_store
from vijax.planes.dataset import SweepPlan, variables
from vijax.planes.dispatch import Call
from vijax.runtime import checks, context
from vijax.runtime.context import door
from vijax.runtime.tiles import places

_LOG = logging.getLogger(__name__)


def compile_ahead(planned: SweepPlan) -> None:
    """Begin to compile what the tiles of a new store need: XLA needs no Python, and importing zarr a core."""
    most = math.prod(tiled_store.blocks(planned.cells).values())
    whole = Call(planned, np.arange(min(most, planned.count)), dispatch.rows_for(most), 0)
    context.beside(dispatch.prepare, whole, places()[0])


def fill(plane: tiled_store.Study, tell: Callable[[int, int], None], workers: cluster.Workers | None) -> None:
    """Simulate and write the tiles of a study that are not done."""
    left = tiled_store.left(plane, _LOG.warning)
    total = plane.planned.count
    done = total - sum(map(plane.count, left))
    tiles = map(plane.tile, left)
    try:
        tell(done, total)
        # Closed at once whatever happens, or workers would go on for as long as somebody holds the error.
        with closing(_made(tiles, dispatch.rows_for(plane.most), workers)) as made:
            for tile in made:
                done += tile.planned.count
                tell(done, total)
    except (KeyboardInterrupt, OSError) as error:
        # Workers may have written tiles since they were last heard of.
        done = total - sum(map(plane.count, tiled_store.unfinished(plane)))
        there = checks.shown_path(plane.path)
        error.add_note(f"{done:,} of {total:,} cells are in {there}; the same command goes on from there")
        raise


def _made(
    tiles: Iterable[tiled_store.StudyTile], rows: int, workers: cluster.Workers | None
) -> Generator[tiled_store.StudyTile, None, None]:
    """Yield tiles as they are done, by whomever."""
    if workers is None:
        yield from _here(tiles, rows)
    else:
        yield from cluster.done(partial(fill_tile, rows), tiles, workers)


def _here(tiles: Iterable[tiled_store.StudyTile], rows: int) -> Iterator[tiled_store.StudyTile]:
    """Yield tiles, simulated and written by this process, as they are done."""
    running: dict[int, tiled_store.StudyTile] = {}

    def one_each() -> Iterator[Call]:
        for tile in tiles:
            running[tile.number] = tile
            yield _whole(tile, rows)

    with closing(dispatch.in_turn(one_each())) as ended:
        for call, found, seconds in ended:
            tiled_store.write(running[call.number], variables(call.planned, found), seconds)
            yield running.pop(call.number)


@door
def fill_tile(rows: int, tile: tiled_store.StudyTile) -> None:
    """Simulate and write a tile, in a worker, on its first device."""
    call, place = _whole(tile, rows), places()[0]
    dispatch.prepare(call, place)
    found, seconds = dispatch.perform(call, place)
    tiled_store.write(tile, variables(tile.planned, found), seconds)


def _whole(tile: tiled_store.StudyTile, rows: int) -> Call:
    """Make the call for all cells of a tile of a study."""
    return Call(tile.planned, np.arange(tile.planned.count), rows, tile.number)
