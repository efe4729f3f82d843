"""A plane in tiles on disk: what is done, what is left, who may write.

A tile is a block of the dimensions that the dynamics see, with all their variants: one chunk of every variable. Its
record is written last, after its chunks, and tells how and by what the tile was made, and what its files must be like.
Records and lock lie beside the chunks of `status`, where no reader of zarr looks.
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

from vijax.planes import inventory, store_metadata, store_names, tile_size
from vijax.planes.cells import Cells
from vijax.planes.dataset import SweepPlan, made_by
from vijax.planes.store import chunk, encoded, void, write_files
from vijax.planes.store_folder import check_place, check_store, exclusive_writer, flush_names, lock, replacing_store
from vijax.runtime import checks
from vijax.runtime.files import create, flush, make_folder, make_folders, remove, remove_part, replace_files, write_json
from vijax.runtime.pages import see
from vijax.runtime.tiles import places

if TYPE_CHECKING:
    import xarray as xr

# Tiles of a small plane for everyone who takes some. With one each, all wait for whoever has the dearest block.
_SHARES = 2
# Factor by which a share may be larger, as halves of odd lengths are rounded up: without, it would be halved once more.
_ROUNDING = 1.1
# Numbers of a chunk, at most: of many variants a tile has fewer cells.
_LARGEST_CHUNK = 1 << 21
# Characters that are read of a lock file, at most: somebody may have written over it.
_LONGEST_BIRTH = 100
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Study:
    """A store that holds a plane, or will.

    Attributes:
        path: Of the store.
        planned: The whole plane.
        dims: Dimensions of every variable.
        extents: Length of a tile along every dynamic dimension; the last ones may be shorter.
        birth: Of the store: no other has the same.
    """

    path: Path
    planned: SweepPlan
    dims: dict[str, tuple[str, ...]]
    extents: dict[str, int]
    birth: str

    @property
    def counts(self) -> tuple[int, ...]:
        """Count the tiles along every dynamic dimension."""
        sizes = self.planned.cells.sizes
        return tuple(-(-sizes[dim] // extent) for dim, extent in self.extents.items())

    @property
    def tiles(self) -> range:
        """Number the tiles, the last dimension running first."""
        return range(math.prod(self.counts))

    @property
    def most(self) -> int:
        """Count the cells of the largest tile."""
        return math.prod(self.extents.values())

    def place(self, tile: int) -> dict[str, int]:
        """Find the number of a tile along every dynamic dimension."""
        numbers = np.unravel_index(tile, self.counts) if self.extents else ()
        return {dim: int(number) for dim, number in zip(self.extents, numbers, strict=True)}

    def block(self, tile: int) -> dict[str, slice]:
        """Find where a tile lies in the plane."""
        sizes, place = self.planned.cells.sizes, self.place(tile)
        return {
            dim: slice(place[dim] * extent, min((place[dim] + 1) * extent, sizes[dim]))
            for dim, extent in self.extents.items()
        }

    def count(self, tile: int) -> int:
        """Count the cells of a tile."""
        return math.prod(part.stop - part.start for part in self.block(tile).values())

    def tile(self, number: int) -> "StudyTile":
        """Cut out a tile alone."""
        block, path = self.block(number), self.path.absolute()
        chunk = {**self.planned.cells.sizes, **self.extents}
        shapes = {name: tuple(chunk[dim] for dim in along) for name, along in self.dims.items()}
        return StudyTile(number, path, self.birth, self.planned.cut(block), self.dims, shapes, self.place(number))

    def record(self, tile: int) -> Path:
        """Name the file where it is written that a tile is done."""
        return _record(self.path, tile)


@dataclass(frozen=True)
class StudyTile:
    """One tile, as light as its cells: all that who runs and writes it must know, on whatever machine.

    Attributes:
        number: Which of the study's.
        path: Of the store, from the root: workers start elsewhere.
        birth: Of the store.
        planned: The cells of the tile alone.
        dims: Dimensions of every variable.
        shapes: Of a chunk of every variable; the tile may be smaller.
        place: Its number along every dynamic dimension.
    """

    number: int
    path: Path
    birth: str
    planned: SweepPlan
    dims: dict[str, tuple[str, ...]]
    shapes: dict[str, tuple[int, ...]]
    place: dict[str, int]


def _record(path: Path, tile: int) -> Path:
    return path / store_names.TILES / f"{tile}.json"


def extents(sizes: dict[str, int], most: int) -> dict[str, int]:
    """Find the lengths of blocks of at most so many cells, by halving the longest dimension."""
    found = dict(sizes)
    while math.prod(found.values()) > most:
        longest = max(found, key=lambda dim: found[dim])
        found[longest] = -(-found[longest] // 2)
    return found


def blocks(of: Cells) -> dict[str, int]:
    """Find the lengths of the tiles of a new store."""
    return extents({dim: of.sizes[dim] for dim in of.dynamic}, _most(of))


# --- who may write ---------------------------------------------------------------------------------------------------


def check(planned: SweepPlan, path: str | Path, overwrite: bool = False) -> None:
    """Raise unless the plane can be written there, or goes on there; makes nothing, and mends what is damaged.

    Raises:
        ValueError: If there is what is no name of a store.
        FileExistsError: If there is something else, or another plane, and it is not to be replaced.
        BlockingIOError: If another run writes there.
        FileNotFoundError, PermissionError: If the place cannot be written.
    """
    target = _target(path, overwrite)
    if target.exists():
        with _locked(target, overwrite):
            if not overwrite:
                _check_same(planned, target)


def _target(path: str | Path, overwrite: bool) -> Path:
    """Find where to write: nothing is there, or a store, or what may be replaced."""
    target = check_place("out", path)
    return target if inventory.is_store(target) and not overwrite else check_store("out", path, overwrite)


@contextmanager
def opened(planned: SweepPlan, path: str | Path, overwrite: bool = False) -> Iterator[Study]:
    """Open the study of a plane, made or found, which no one else may write meanwhile.

    Raises:
        As `check`.
    """
    target, birth = _target(path, overwrite), uuid.uuid4().hex
    if not target.exists():
        _make(planned, birth, target)
    elif overwrite:
        with _locked(target, overwrite), replacing_store("out", target, overwrite) as new:
            _write_blank(planned, birth, new)
    with _locked(target):
        # What was made here a moment ago is known.
        if _birth(target) != birth:
            _check_same(planned, target)
            flush_names(target)
        yield _found(planned, target)


def _make(planned: SweepPlan, birth: str, target: Path) -> None:
    """Make a store without any tile, unless another run was faster."""
    try:
        with replacing_store("out", target, overwrite=False) as new:
            _write_blank(planned, birth, new)
    except FileExistsError:
        if not target.exists():
            raise


def _write_blank(planned: SweepPlan, birth: str, path: Path) -> None:
    write_files(path, store_metadata.contents(planned, blocks(planned.cells), birth))
    make_folder(lock(path).parent)
    create(lock(path), birth.encode())
    # Folders of chunks that are on disk with the store need not be flushed with every tile.
    arrays = {name: grid for name, grid in store_names.layouts(path).items() if grid and grid.shape}
    firsts = {name: itertools.product(*map(range, grid.counts[:-1]), [0]) for name, grid in arrays.items()}
    make_folders(path, (path / chunk(name, place) for name, places in firsts.items() for place in places))


def _birth(path: Path) -> str:
    """Read the birth of a store in its lock."""
    with lock(path).open("rb") as file:
        return file.read(_LONGEST_BIRTH).decode(errors="replace")


def _most(of: Cells) -> int:
    """Find how many cells a tile has, at most."""
    share = max(int(_ROUNDING * of.count / (_SHARES * len(places()))), tile_size.smallest())
    room = _LARGEST_CHUNK // math.prod(of.sizes[dim] for dim in of.variant)
    return min(share, tile_size.largest(), max(room, 1))


def _found(planned: SweepPlan, path: Path) -> Study:
    """Describe the study that a store is, its tiles as long as they were when it was made."""
    arrays = store_names.layouts(path)
    dims = {name: grid.dims for name in planned.outputs if (grid := arrays[name])}
    tile = arrays["status"]
    assert tile is not None  # which `check_same` saw, or this process made it
    return Study(path, planned, dims, dict(zip(tile.dims, tile.chunk, strict=True)), _birth(path))


@contextmanager
def _locked(path: Path, overwrite: bool = False) -> Iterator[None]:
    """Be the only writer of a study; a map that was saved whole is written by nobody."""
    if not overwrite and not inventory.is_study(path):
        raise FileExistsError(
            see(
                "studies",
                f"out must be new or the store of a run that can go on; got {checks.shown_path(path)}, which was saved "
                "whole; allow overwriting, or take another name",
            )
        )
    with exclusive_writer("out", path):
        if (listed := inventory.read(path)) and "birth" in listed and listed["birth"] != _birth(path):
            # In place: a new file under this name would not be the one that is locked.
            create(lock(path), listed["birth"].encode())
            flush([lock(path)])
        yield


def begun(out: str | Path | None, overwrite: bool) -> Collection[str] | None:
    """Return the names of the variables of a study with which a run will go on; None if it begins a new one."""
    if out is None or overwrite or not inventory.is_study(path := checks.path("out", out)):
        return None
    return store_names.layouts(path)


def _check_same(planned: SweepPlan, path: Path) -> None:
    """Raise unless a store holds this plane; what is damaged of it, but for its tiles, is mended."""
    store_metadata.mend(planned, blocks(planned.cells), _birth(path), path, _LOG.warning)
    store_metadata.check_same(planned, path)


# --- what is done, what is left --------------------------------------------------------------------------------------


def unfinished(study: Study) -> list[int]:
    """Find the tiles that have no record."""
    return [tile for tile in study.tiles if not os.path.lexists(study.record(tile))]


def left(study: Study, say: Callable[[str], None]) -> list[int]:
    """Find tiles that are not done, and those whose files are no longer what was written; of these say why."""
    for file in inventory.half_written(study.path):
        remove_part(file)  # unless a worker that lost its driver is still writing it
    found = []
    without = set(unfinished(study))
    for tile in study.tiles:
        if tile in without:
            found.append(tile)
        elif reason := _damage(study, tile):
            remove(study.record(tile))
            found.append(tile)
            say(f"tile {tile} of {checks.shown_path(study.path)} is run again: {reason}")
    return found


def _damage(study: Study, tile: int) -> str:
    """Describe what is wrong with the files of a tile; return no text if all are as they were written."""
    file = study.record(tile)
    odd = inventory.fault(study.path, file.relative_to(study.path).as_posix(), None)
    record = None if odd == "is no regular file" else store_names.content(file)
    if record is None or not isinstance(record.get("files"), dict):
        return "its record cannot be read"
    if record.get("birth") != study.birth:
        return "its record is of another store"
    for name, relative in _files(study.dims, study.place(tile)):
        # Earlier versions wrote fingerprints under the names of variables.
        if reason := inventory.fault(study.path, relative, record["files"].get(relative, record["files"].get(name))):
            return f"{relative} {reason}"
    return ""


def _files(dims: Mapping[str, tuple[str, ...]], place: Mapping[str, int]) -> Iterator[tuple[str, str]]:
    """Name the chunk of every variable of a tile."""
    for name, along in dims.items():
        yield name, chunk(name, (place.get(dim, 0) for dim in along))


def write(tile: StudyTile, found: "Mapping[str, xr.Variable]", seconds: float) -> None:
    """Write the variables of a tile, then its record; all are on disk when this returns.

    Args:
        tile: Which.
        found: Of its plan; see `dataset.variables`.
        seconds: That it took.

    Raises:
        OSError: If the store cannot be written, or is no longer the one that the tile is of.
    """
    _check_born(tile)
    contents = {}
    for name, file in _files(tile.dims, tile.place):
        store_names.check_way(tile.path, file)
        contents[file] = encoded(_filled(name, found[name].values, tile.shapes[name]))
    record = {
        "cells": tile.planned.count,
        "seconds": round(seconds, 3),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        **made_by(),
        "birth": tile.birth,
        "files": {file: inventory.fingerprint(content) for file, content in contents.items()},
    }
    # No reader finds a status before the numbers that it is of.
    stages: tuple[dict[Path, bytes], ...] = ({}, {})
    for file, content in contents.items():
        stages[file.startswith("status/")][tile.path / file] = content
    replace_files(*stages, within=tile.path)
    _check_born(tile)
    write_json(record, _record(tile.path, tile.number))


def _filled(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Fill a chunk of a variable, void where it reaches beyond the plane."""
    chunk = np.full(shape, void(name, values.dtype), values.dtype)
    chunk[tuple(slice(size) for size in values.shape)] = values
    return chunk


def _check_born(tile: StudyTile) -> None:
    """Raise if another store has taken the place of the tile's.

    The lock is the driver's, and a worker may outlive it: it then writes what the next driver has run again, the same
    bits if on the same kind of device. Whatever mixture of both is left, no file is half of each, and one that the
    record does not fit is found and run again. But the next driver may have begun another plane there.
    """
    if _birth(tile.path) != tile.birth:
        raise FileExistsError(
            f"{checks.shown_path(tile.path)} is no longer the store that tile {tile.number} was run for"
        )
