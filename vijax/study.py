"""A plane in tiles on disk: what is done, what is left, who may write.

A tile is a block of the dimensions that the dynamics see, with all their variants: one chunk of every variable. Its
record is written last, after its chunks, and tells how and by what the tile was made, and what its files must be like.
Records and lock lie beside the chunks of `status`, where no reader of zarr looks.
"""

import json
import math
import os
import shutil
import time
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.axes import Cells
from vijax.dataset import Plan, asked, coordinates, made_by, provenance, specimen
from vijax.lanes import places
from vijax.model import Status
from vijax.store import check_output, compressors, encoded, replacing, view, write_json
from vijax.store import write as write_store

if TYPE_CHECKING:
    import xarray as xr

# A second or two of a core: large enough to keep lanes full and files few, small enough to lose.
SMALLEST_TILE, LARGEST_TILE = 1024, 32768
_SHARES = 2  # tiles of a small plane for everyone who takes some: blocks do not cost the same
_ROUNDING = 1.1  # of such a share: halves of odd lengths are rounded up
_LARGEST_CHUNK = 1 << 21  # numbers: of many variants a tile has fewer cells
_RECORDS = Path("status", "tiles")
_SHOWN = 3  # of the settings that differ


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
    planned: Plan
    dims: dict[str, tuple[str, ...]]
    extents: dict[str, int]
    birth: str

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of tiles along every dynamic dimension."""
        sizes = self.planned.cells.sizes
        return tuple(-(-sizes[dim] // extent) for dim, extent in self.extents.items())

    @property
    def tiles(self) -> range:
        """The tiles by number, the last dimension running first."""
        return range(math.prod(self.counts))

    @property
    def most(self) -> int:
        """Cells of the largest tile."""
        return math.prod(self.extents.values())

    def place(self, tile: int) -> dict[str, int]:
        """Number of a tile along every dynamic dimension."""
        numbers = np.unravel_index(tile, self.counts) if self.extents else ()
        return {dim: int(number) for dim, number in zip(self.extents, numbers, strict=True)}

    def block(self, tile: int) -> dict[str, slice]:
        """Where a tile lies in the plane."""
        sizes, place = self.planned.cells.sizes, self.place(tile)
        return {
            dim: slice(place[dim] * extent, min((place[dim] + 1) * extent, sizes[dim]))
            for dim, extent in self.extents.items()
        }

    def count(self, tile: int) -> int:
        """Cells of a tile."""
        return math.prod(part.stop - part.start for part in self.block(tile).values())

    def tile(self, number: int) -> "Tile":
        """A tile alone."""
        block, path = self.block(number), self.path.absolute()
        chunk = {**self.planned.cells.sizes, **self.extents}
        shapes = {name: tuple(chunk[dim] for dim in along) for name, along in self.dims.items()}
        return Tile(number, path, self.birth, self.planned.cut(block), self.dims, shapes, self.place(number))

    def record(self, tile: int) -> Path:
        """Where it is written that a tile is done."""
        return _record(self.path, tile)


@dataclass(frozen=True)
class Tile:
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
    planned: Plan
    dims: dict[str, tuple[str, ...]]
    shapes: dict[str, tuple[int, ...]]
    place: dict[str, int]


def _record(path: Path, tile: int) -> Path:
    return path / _RECORDS / f"{tile}.json"


def extents(sizes: dict[str, int], most: int) -> dict[str, int]:
    """Lengths of blocks of at most so many cells, by halving the longest dimension."""
    found = dict(sizes)
    while math.prod(found.values()) > most:
        longest = max(found, key=lambda dim: found[dim])
        found[longest] = -(-found[longest] // 2)
    return found


def blocks(of: Cells) -> dict[str, int]:
    """Lengths of the tiles of a new store."""
    return extents({dim: of.sizes[dim] for dim in of.dynamic}, _most(of))


# --- who may write ---------------------------------------------------------------------------------------------------


def check(planned: Plan, path: str | Path, overwrite: bool = False) -> None:
    """Raise unless the plane can be written there, or goes on there; makes nothing.

    Raises:
        FileExistsError: If there is something else, or another plane, and it is not to be replaced.
        BlockingIOError: If another run writes there.
        FileNotFoundError, PermissionError: If the place cannot be written.
    """
    target = _target(path, overwrite)
    if target.exists() and not overwrite:
        _check_same(planned, target)
    if target.exists():
        with _locked(target, overwrite):
            pass


def _target(path: str | Path, overwrite: bool) -> Path:
    """Where to write: nothing is there, or a store, or what may be replaced."""
    return check_output("out", path, overwrite or (Path(path) / "zarr.json").is_file())


@contextmanager
def opened(planned: Plan, path: str | Path, overwrite: bool = False) -> Iterator[Study]:
    """The study of a plane, made or found, which no one else may write meanwhile.

    Raises:
        As `check`.
    """
    target = _target(path, overwrite)
    if not target.exists():
        _make(planned, target)
    elif overwrite:
        with _locked(target, overwrite), replacing(target) as part:
            _write_blank(planned, part)
    with _locked(target):
        _check_same(planned, target)
        yield _found(planned, target)


def _make(planned: Plan, target: Path) -> None:
    """A store without any tile, unless another run was faster."""
    part = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        _write_blank(planned, part)
        part.rename(target)
    except OSError:
        if not target.exists():
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_blank(planned: Plan, path: Path) -> None:
    import xarray as xr
    import zarr

    of = planned.cells
    write_store(xr.Dataset(coords=coordinates(of), attrs=provenance(planned)), path)
    group = zarr.open_group(path, mode="r+")
    tile = blocks(of)
    for name, variable in specimen(planned).data_vars.items():
        group.create_array(
            str(name),
            shape=tuple(of.sizes[str(dim)] for dim in variable.dims),
            chunks=tuple(tile.get(str(dim), of.sizes[str(dim)]) for dim in variable.dims),
            dtype=variable.dtype,
            fill_value=_void(str(name), variable.dtype),
            compressors=compressors(),
            dimension_names=[str(dim) for dim in variable.dims],
            attributes=variable.attrs,
        )
    (path / _RECORDS).mkdir()
    _lock(path).write_text(uuid.uuid4().hex, encoding="utf-8")


def _lock(path: Path) -> Path:
    """The file that a writer of the store locks; within, the birth of the store."""
    return path / _RECORDS / "lock"


def _birth(path: Path) -> str:
    return _lock(path).read_text(encoding="utf-8")


def _most(of: Cells) -> int:
    """Cells of a tile, at most."""
    share = max(int(_ROUNDING * of.count / (_SHARES * len(places()))), SMALLEST_TILE)
    room = _LARGEST_CHUNK // math.prod(of.sizes[dim] for dim in of.variant)
    return min(share, LARGEST_TILE, max(room, 1))


def _void(name: str, dtype: np.dtype) -> Any:
    """What a variable holds where nothing was run."""
    if name == "status":
        return int(Status.NOT_RUN)
    return {"f": np.nan, "i": -1, "b": False}[dtype.kind]


def _found(planned: Plan, path: Path) -> Study:
    """The study that a store is, its tiles as long as they were when it was made."""
    with view(path) as store:
        dims = {name: tuple(map(str, store[name].dims)) for name in planned.outputs}
        chunks = store["status"].encoding["chunks"]
    return Study(path, planned, dims, dict(zip(planned.cells.dynamic, chunks, strict=True)), _birth(path))


@contextmanager
def _locked(path: Path, overwrite: bool = False) -> Iterator[None]:
    """Alone with a store; the lock ends with its process, however that ends. What was saved whole nobody writes."""
    import fcntl

    lock = _lock(path)
    if not lock.exists():
        if not overwrite:
            raise FileExistsError(
                f"out must be new or the store of a run that can go on; got {path}, which was saved whole; "
                "allow overwriting, or take another name"
            )
        yield
        return
    try:
        file = lock.open("r+")
    except OSError as error:
        raise PermissionError(f"out must be a store that can be written; got {path} ({error.strerror})") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(f"out must not be in use; got {path}, which another run is writing") from None
        yield


def _check_same(planned: Plan, path: Path) -> None:
    with view(path) as store:
        found = list(_differences(planned, store))
    if found:
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise FileExistsError(
            f"out must be new or hold the same plane; got {path}, where {'; '.join(found[:_SHOWN])}{more}; "
            "allow overwriting, or take another name"
        )


def _differences(planned: Plan, store: "xr.Dataset") -> Iterator[str]:
    """What was asked otherwise than the store has it, a phrase each."""
    for name, value in json.loads(json.dumps(asked(planned))).items():
        if store.attrs.get(name, "left out") != value:
            yield f"{name} is {store.attrs.get(name, 'left out')}, and not {value}"
    axes = coordinates(planned.cells)
    for name in dict.fromkeys([*axes, *map(str, store.coords)]):
        here, there = axes.get(name), store.coords.get(name)
        if here is None or there is None or here.dims != there.dims or not _equal(here.values, there.values):
            yield f"{name} is {_words(there)}, and not {_words(here)}"


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def _words(values: "xr.Variable | xr.DataArray | None") -> str:
    """A coordinate in a few words."""
    if values is None:
        return "left out"
    if values.ndim == 0:
        return f"{float(values)}"
    first, last = (float(values.values.flat[at]) for at in (0, -1))
    return f"{values.size} values over {', '.join(map(str, values.dims))} from {first} to {last}"


# --- what is done, what is left --------------------------------------------------------------------------------------


def left(study: Study, say: Callable[[str], None]) -> list[int]:
    """Tiles that are not done, and those whose files are no longer what was written; of these is said why."""
    for half_written in study.path.rglob("*.part*"):  # what a killed process was at
        half_written.unlink(missing_ok=True)  # a worker that lost its driver may still be writing
    found = []
    for tile in study.tiles:
        record = study.record(tile)
        if not record.exists():
            found.append(tile)
        elif reason := _damage(study, tile):
            record.unlink()
            found.append(tile)
            say(f"tile {tile} of {study.path} is run again: {reason}")
    return found


def _damage(study: Study, tile: int) -> str:
    """What is wrong with the files of a tile, nothing if all are as they were written."""
    try:
        record = json.loads(study.record(tile).read_text(encoding="utf-8"))
        birth, prints = record["birth"], record["files"]
    except (ValueError, KeyError, TypeError):
        return "its record cannot be read"
    if birth != study.birth:
        return "its record is of another store"
    for name, file in _files(study.path, study.dims, study.place(tile)):
        if not file.exists():
            return f"{file.relative_to(study.path)} is missing"
        if _print(file.read_bytes()) != prints.get(name):
            return f"{file.relative_to(study.path)} is not what was written"
    return ""


def _files(path: Path, dims: Mapping[str, tuple[str, ...]], place: Mapping[str, int]) -> Iterator[tuple[str, Path]]:
    """The chunk of every variable of a tile."""
    for name, along in dims.items():
        yield name, path.joinpath(name, "c", *(str(place.get(dim, 0)) for dim in along))


def _print(content: bytes) -> str:
    """Length and checksum of a file."""
    return f"{len(content)} bytes, CRC-32 {zlib.crc32(content):08x}"


def write(tile: Tile, found: "Mapping[str, xr.Variable]", seconds: float) -> None:
    """Write the variables of a tile, then its record.

    Args:
        tile: Which.
        found: Of its plan; see `dataset.variables`.
        seconds: That it took.

    Raises:
        OSError: If the store cannot be written, or is no longer the one that the tile is of.
    """
    _check_born(tile)
    prints = {}
    for name, file in _files(tile.path, tile.dims, tile.place):
        content = encoded(_filled(name, found[name].values, tile.shapes[name]))
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as part:
            part.write_bytes(content)
        prints[name] = _print(content)
    record = {
        "cells": tile.planned.count,
        "seconds": round(seconds, 3),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        **made_by(),
        "birth": tile.birth,
        "files": prints,
    }
    _check_born(tile)
    write_json(record, _record(tile.path, tile.number))


def _filled(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A chunk of a variable, void where it reaches beyond the plane."""
    chunk = np.full(shape, _void(name, values.dtype), values.dtype)
    chunk[tuple(slice(size) for size in values.shape)] = values
    return chunk


def _check_born(tile: Tile) -> None:
    """Raise if another store has taken the place of the tile's.

    The lock is the driver's, and a worker may outlive it: it then writes what the next driver has run again, the same
    bits if on the same kind of device. Whatever mixture of both is left, no file is half of each, and one that the
    record does not fit is found and run again. But the next driver may have begun another plane there.
    """
    if _birth(tile.path) != tile.birth:
        raise FileExistsError(f"{tile.path} is no longer the store that tile {tile.number} was run for")
