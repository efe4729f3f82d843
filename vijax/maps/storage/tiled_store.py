"""A plane in tiles on disk: division into tiles, exclusive writing, completed and unfinished tiles.

A tile is a block of the dynamic dimensions with all their variants: one chunk of every variable. Its record is written
last, after its chunks, and contains the software, the machine and the duration of its computation, and the fingerprints
of its files. Records and lock lie next to the chunks of `status`, where no reader of zarr looks.
"""

import itertools
import logging
import math
import os
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vijax.maps.cells import Cells
from vijax.maps.execution import tile_size
from vijax.maps.map_dataset import SweepPlan, installation_attributes
from vijax.maps.storage import store_inventory, store_metadata, store_names
from vijax.maps.storage.store import chunk, encode_chunk, void_value, write_files
from vijax.maps.storage.store_folder import (
    exclusive_writer,
    flush_names,
    lock,
    replacing_store,
    validate_new_store_path,
    validate_store_path,
)
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import create, flush, make_folder, make_folders, remove, remove_part, replace_files, write_json
from vijax.runtime.tiles import tile_devices

if TYPE_CHECKING:
    import xarray as xr

# Tiles per device of a small plane. With one each, all devices would wait for the one with the most expensive tile.
_TILES_PER_DEVICE = 2
# Largest size of a tile, relative to its share of the cells. Halves of odd lengths are rounded up, so a tile may be
# slightly too large, and without this factor it would be halved once more.
_ROUNDING = 1.1
# Maximum number of elements of a chunk: with many variants a tile has fewer cells.
_MAX_CHUNK_NUMBERS = 1 << 21
# Maximum number of characters that are read from a lock file, which somebody may have overwritten.
_MAX_ID_CHARS = 100
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Study:
    """A store that is written tile by tile, and holds a plane or will hold it.

    Attributes:
        path: Path of the store.
        plan: Plan of the whole plane.
        dims: Dimensions of every variable.
        tile_lengths: Length of a tile along every dynamic dimension; the last tiles may be shorter.
        store_id: Unique id of the store.
    """

    path: Path
    plan: SweepPlan
    dims: dict[str, tuple[str, ...]]
    tile_lengths: dict[str, int]
    store_id: str

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of tiles along every dynamic dimension."""
        sizes = self.plan.cells.sizes
        return tuple(-(-sizes[dim] // extent) for dim, extent in self.tile_lengths.items())

    @property
    def tiles(self) -> range:
        """Numbers of the tiles, in C order: the last dimension varies fastest."""
        return range(math.prod(self.counts))

    @property
    def max_tile_cells(self) -> int:
        """Number of cells of the largest tile."""
        return math.prod(self.tile_lengths.values())

    def index(self, tile: int) -> dict[str, int]:
        """Return the index of a tile along every dynamic dimension."""
        # A plane of a single cell has no dynamic dimensions, and one tile.
        numbers = np.unravel_index(tile, self.counts) if self.tile_lengths else ()
        return {dim: int(number) for dim, number in zip(self.tile_lengths, numbers, strict=True)}

    def block(self, tile: int) -> dict[str, slice]:
        """Return the slices of the plane that a tile covers."""
        sizes, index = self.plan.cells.sizes, self.index(tile)
        return {
            dim: slice(index[dim] * extent, min((index[dim] + 1) * extent, sizes[dim]))
            for dim, extent in self.tile_lengths.items()
        }

    def count(self, tile: int) -> int:
        """Return the number of cells of a tile."""
        return math.prod(part.stop - part.start for part in self.block(tile).values())

    def tile(self, number: int) -> "StudyTile":
        """Return a tile as an independent object that can be sent to a worker."""
        block, path = self.block(number), self.path.absolute()
        # Variant dimensions are never divided: a chunk has all variants of its cells.
        chunk = {**self.plan.cells.sizes, **self.tile_lengths}
        shapes = {name: tuple(chunk[dim] for dim in along) for name, along in self.dims.items()}
        return StudyTile(number, path, self.store_id, self.plan.cut(block), self.dims, shapes, self.index(number))

    def record(self, tile: int) -> Path:
        """Return the path of the record that a completed tile has."""
        return _record(self.path, tile)


@dataclass(frozen=True)
class StudyTile:
    """One tile with all data to run and write it on any machine; its bytes are proportional to its cells.

    Attributes:
        number: Number of the tile in the study.
        path: Absolute path of the store, because workers have other working directories.
        store_id: Unique id of the store.
        plan: Plan of the cells of the tile.
        dims: Dimensions of every variable.
        shapes: Shape of a chunk of every variable; the tile may be smaller.
        index: Index of the tile along every dynamic dimension.
    """

    number: int
    path: Path
    store_id: str
    plan: SweepPlan
    dims: dict[str, tuple[str, ...]]
    shapes: dict[str, tuple[int, ...]]
    index: dict[str, int]


def _record(path: Path, tile: int) -> Path:
    """Return the path of the record of a tile."""
    return path / store_names.TILES / f"{tile}.json"


def block_lengths(sizes: dict[str, int], most: int) -> dict[str, int]:
    """Return block lengths with a product of at most `most`, by repeated halving of the longest dimension."""
    lengths = dict(sizes)
    while math.prod(lengths.values()) > most:
        longest = max(lengths, key=lambda dim: lengths[dim])
        lengths[longest] = -(-lengths[longest] // 2)
    return lengths


def tile_lengths(of: Cells) -> dict[str, int]:
    """Return the lengths of the tiles of a new store along its dynamic dimensions."""
    return block_lengths({dim: of.sizes[dim] for dim in of.dynamic}, _max_tile_cells(of))


# --- exclusive writing -----------------------------------------------------------------------------------------------


def check_writable(plan: SweepPlan, path: str | Path, overwrite: bool = False) -> None:
    """Raise an error unless the plane can be written at `path` or continued there; repairs damage, creates no store.

    Raises:
        ValueError: If the path does not end in .zarr.
        FileExistsError: If the path holds anything but this plane, and may not be replaced.
        BlockingIOError: If another run writes there.
        FileNotFoundError, PermissionError: If the path cannot be written.
    """
    target = _target(path, overwrite)
    if target.exists():
        with _exclusive_study(target, overwrite):
            if not overwrite:
                _check_same(plan, target)


def _target(path: str | Path, overwrite: bool) -> Path:
    """Return the path to write to, after a check that it is free, is a store to continue, or may be replaced."""
    target = validate_store_path("out", path)
    return (
        target
        if store_inventory.is_store(target) and not overwrite
        else validate_new_store_path("out", path, overwrite)
    )


@contextmanager
def open_study(plan: SweepPlan, path: str | Path, overwrite: bool = False) -> Iterator[Study]:
    """Open the study of a plane, new or existing, locked for this writer.

    Raises:
        As `check_writable`.
    """
    target, store_id = _target(path, overwrite), uuid.uuid4().hex
    if not target.exists():
        _create_store(plan, store_id, target)
    elif overwrite:
        with _exclusive_study(target, overwrite), replacing_store("out", target, overwrite) as new:
            _write_blank(plan, store_id, new)
    with _exclusive_study(target):
        # A store that was just made here needs no check.
        if _read_store_id(target) != store_id:
            _check_same(plan, target)
            flush_names(target)
        yield _existing_study(plan, target)


def _create_store(plan: SweepPlan, store_id: str, target: Path) -> None:
    """Make a store without tiles, unless another run made it first."""
    try:
        with replacing_store("out", target, overwrite=False) as new:
            _write_blank(plan, store_id, new)
    except FileExistsError:
        if not target.exists():
            raise


def _write_blank(plan: SweepPlan, store_id: str, path: Path) -> None:
    """Write the metadata, the lock and the folders of a store without tiles."""
    write_files(path, store_metadata.contents(plan, tile_lengths(plan.cells), store_id))
    make_folder(lock(path).parent)
    create(lock(path), store_id.encode())
    # Make all folders of chunks now, so that they need not be flushed with every tile.
    arrays = {name: grid for name, grid in store_names.layouts(path).items() if grid and grid.shape}
    firsts = {name: itertools.product(*map(range, grid.counts[:-1]), [0]) for name, grid in arrays.items()}
    make_folders(path, (path / chunk(name, index) for name, indices in firsts.items() for index in indices))


def _read_store_id(path: Path) -> str:
    """Return the id of a store, read from its lock."""
    with lock(path).open("rb") as file:
        return file.read(_MAX_ID_CHARS).decode(errors="replace")


def _max_tile_cells(of: Cells) -> int:
    """Return the maximum number of cells of a tile."""
    # Small planes are divided evenly among the devices, but not into tiles too small for full lanes.
    by_share = max(int(_ROUNDING * of.count / (_TILES_PER_DEVICE * len(tile_devices()))), tile_size.min_cells())
    by_chunk = _MAX_CHUNK_NUMBERS // math.prod(of.sizes[dim] for dim in of.variant)
    return min(by_share, tile_size.max_cells(), max(by_chunk, 1))


def _existing_study(plan: SweepPlan, path: Path) -> Study:
    """Return the study in a store, with the tile lengths that it was made with."""
    arrays = store_names.layouts(path)
    dims = {name: grid.dims for name in plan.outputs if (grid := arrays[name])}
    tile = arrays["status"]
    assert tile is not None  # `check_same` has verified this, or this process made the store
    return Study(path, plan, dims, dict(zip(tile.dims, tile.chunk, strict=True)), _read_store_id(path))


@contextmanager
def _exclusive_study(path: Path, overwrite: bool = False) -> Iterator[None]:
    """Lock a study for this process alone; raise FileExistsError for a map that was saved complete."""
    if not overwrite and not store_inventory.is_study(path):
        raise FileExistsError(
            see(
                "studies",
                f"out must be new or the store of an unfinished run; got {validation.path_text(path)}, which was saved "
                "whole; allow overwriting, or take another name",
            )
        )
    with exclusive_writer("out", path):
        if (
            (listed := store_inventory.read(path))
            and "store_id" in listed
            and listed["store_id"] != _read_store_id(path)
        ):
            # The lock file has lost the id of the store. It is rewritten in place, because a new file would not be
            # locked.
            create(lock(path), listed["store_id"].encode())
            flush([lock(path)])
        yield


def existing_variables(out: str | Path | None, overwrite: bool) -> Collection[str] | None:
    """Return the names of the variables of the study that a run would continue; None if it starts a new one."""
    if out is None or overwrite or not store_inventory.is_study(path := validation.validate_path("out", out)):
        return None
    return store_names.layouts(path)


def _check_same(plan: SweepPlan, path: Path) -> None:
    """Raise an error unless a store holds this plane; repair damaged files other than tiles."""
    store_metadata.repair(plan, tile_lengths(plan.cells), _read_store_id(path), path, _LOG.warning)
    store_metadata.check_same(plan, path)


# --- completed and unfinished tiles ----------------------------------------------------------------------------------


def unfinished(study: Study) -> list[int]:
    """Return the tiles without a record."""
    return [tile for tile in study.tiles if not os.path.lexists(study.record(tile))]


def tiles_to_run(study: Study, notify: Callable[[str], None]) -> list[int]:
    """Return the numbers of unfinished and damaged tiles; call `notify` with the damage of each damaged tile."""
    for file in store_inventory.partial_files(study.path):
        remove_part(file)  # unless a worker that outlived its driver still writes it
    tiles = []
    unfinished_tiles = set(unfinished(study))
    for tile in study.tiles:
        if tile in unfinished_tiles:
            tiles.append(tile)
        elif reason := _damage(study, tile):
            remove(study.record(tile))
            tiles.append(tile)
            notify(f"tile {tile} of {validation.path_text(study.path)} is run again: {reason}")
    return tiles


def _damage(study: Study, tile: int) -> str:
    """Return a description of the damage to the files of a tile; an empty text if there is none."""
    file = study.record(tile)
    damage = store_inventory.integrity_error(study.path, file.relative_to(study.path).as_posix(), None)
    record = None if damage == "is no regular file" else store_names.content(file)
    if record is None or not isinstance(record.get("files"), dict):
        return "its record cannot be read"
    if store_inventory.with_current_names(record).get("store_id") != study.store_id:
        return "its record is of another store"
    for name, relative in _chunk_files(study.dims, study.index(tile)):
        # Earlier versions stored fingerprints under the names of variables.
        if reason := store_inventory.integrity_error(
            study.path, relative, record["files"].get(relative, record["files"].get(name))
        ):
            return f"{relative} {reason}"
    return ""


def _chunk_files(dims: Mapping[str, tuple[str, ...]], index: Mapping[str, int]) -> Iterator[tuple[str, str]]:
    """Yield the name of every variable and of its chunk in a tile."""
    for name, along in dims.items():
        yield name, chunk(name, (index.get(dim, 0) for dim in along))


def write_tile(tile: StudyTile, variables: "Mapping[str, xr.Variable]", seconds: float) -> None:
    """Write the variables of a tile, then its record; all are on disk when this returns.

    Args:
        tile: The tile.
        variables: Variables of its plan; see `map_dataset.variables`.
        seconds: Duration of its simulation [s].

    Raises:
        OSError: If the store cannot be written, or another store has taken its place.
    """
    _check_store_id(tile)
    contents = {}
    for name, file in _chunk_files(tile.dims, tile.index):
        store_names.check_folders_above(tile.path, file)
        # All chunks have the full tile size, as zarr requires; at the end of the plane they are padded.
        contents[file] = encode_chunk(_padded_chunk(name, variables[name].values, tile.shapes[name]))
    record = {
        "cells": tile.plan.count,
        "seconds": round(seconds, 3),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        **installation_attributes(),
        "store_id": tile.store_id,
        "files": {file: store_inventory.fingerprint(content) for file, content in contents.items()},
    }
    # Chunks of `status` are written last: a reader never sees the status of a cell before its numbers.
    stages: tuple[dict[Path, bytes], ...] = ({}, {})
    for file, content in contents.items():
        stages[file.startswith("status/")][tile.path / file] = content
    replace_files(*stages, within=tile.path)
    _check_store_id(tile)
    # The record makes the tile count as completed, so it is written last.
    write_json(record, _record(tile.path, tile.number))


def _padded_chunk(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a chunk of a variable, void beyond the end of the plane."""
    chunk = np.full(shape, void_value(name, values.dtype), values.dtype)
    chunk[tuple(slice(size) for size in values.shape)] = values
    return chunk


def _check_store_id(tile: StudyTile) -> None:
    """Raise FileExistsError if another store has taken the place of the tile's store.

    Only the driver, the process that distributes the tiles, holds the lock, and a worker may outlive its driver. If the
    next driver continues the same plane, such a worker does no harm: it writes the same bits on the same kind of
    device, every file is complete, and a tile with a file that does not fit its record is run again. But the next
    driver may have replaced the store by another plane, which must not receive the tile.
    """
    if _read_store_id(tile.path) != tile.store_id:
        raise FileExistsError(
            f"{validation.path_text(tile.path)} is no longer the store that tile {tile.number} was run for"
        )
