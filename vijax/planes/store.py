"""Maps on disk: zarr stores (format 3) that are whole or absent, each chunk with a checksum, every file in a list."""

import asyncio
import math
import operator
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.model.records import Status
from vijax.planes import inventory, store_names
from vijax.planes.store_folder import check_store, exclusive_writer, recover, replacing_store
from vijax.planes.store_names import LIST, METADATA, ArrayLayout
from vijax.runtime import checks
from vijax.runtime.files import create, make_folder, make_folders
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.metadata import ArrayV3Metadata

# Level of zstd. Level 3 takes twice as long and saves a thousandth more.
_LEVEL = 1
# Chunks of an array that is loaded, at most: zarr looks for each, whether it is there or not.
_MOST_CHUNKS = 10**6
# Bytes of a store that an error shows, at most: a number that metadata declare may exceed any float.
_LARGEST = 10**30
# Values where nothing was run, by kind of type.
_VOID: dict[str, Any] = {"f": np.nan, "i": -1, "b": False}


def save(dataset: "xr.Dataset", path: str | Path, *, overwrite: bool = False) -> None:
    """Write a map as a zarr store (format 3, zstd, CRC-32C), on disk when this returns; a failed write leaves nothing.

    Of two calls that write to one path at the same time the last one to finish wins, whole.

    Args:
        dataset: What `sweep` returned, or any part of it.
        path: Folder to make; it ends in .zarr.
        overwrite: Replace a store that is there; it is removed once the new one is on disk.

    Raises:
        ValueError: If the path has another ending.
        FileExistsError: If the place is taken and may not be replaced; what vijax did not write is never replaced.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
        BlockingIOError: If a run is writing the store that would be replaced.
    """
    checks.variables("dataset", dataset, (), "sweep")
    for variable in dataset.variables:
        if not store_names.is_name(f"{variable}/{METADATA}"):
            raise ValueError(f"dataset must have variables that can name a folder; got {checks.shown(variable)}")
    target = check_store("path", path, checks.flag("overwrite", overwrite))
    with exclusive_writer("path", target), replacing_store("path", target, overwrite) as new:
        write(dataset, new)


def write(dataset: "xr.Dataset", path: Path) -> None:
    """Write a new store and the list of its files; its first file has all metadata, so that it opens at once anywhere.

    Every chunk is written, whatever it holds, and fill values are void: so a lost chunk never passes for numbers.
    """
    from zarr.abc.store import Store
    from zarr.core.buffer import Buffer
    from zarr.storage import LocalStore

    listed = inventory.FileList()

    class Listed(LocalStore):
        async def set(self, key: str, value: Buffer) -> None:
            content = value.to_bytes()
            listed.add(key, content)
            await asyncio.to_thread(_put, path, key, content)

        async def set_if_not_exists(self, key: str, value: Buffer) -> None:
            if not await self.exists(key):
                await self.set(key, value)

    whole: Store = Listed(path)
    encoding = {name: {"compressors": compressors(), **_fill(variable)} for name, variable in dataset.variables.items()}
    make_folder(path)
    with warnings.catch_warnings():
        # A reader that does not know of them finds the same in every array.
        warnings.filterwarnings("ignore", "Consolidated metadata", UserWarning)
        dataset.to_zarr(whole, mode="w-", zarr_format=3, consolidated=True, encoding=encoding, write_empty_chunks=True)
    _put(path, LIST, listed.content())


def write_files(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write a new store, given all its files."""
    make_folder(path)
    for name, content in contents.items():
        _put(path, name, content)


def _put(path: Path, name: str, content: bytes) -> None:
    """Write a file of a new store."""
    make_folders(path, [path / name])
    create(path / name, content)


def metadata_files(attributes: Mapping[str, Any], arrays: "Mapping[str, ArrayV3Metadata]") -> dict[str, bytes]:
    """Encode the metadata of a store, as `write` does.

    Here zarr makes the metadata and does not write them: it takes two milliseconds to create an array, for all arrays
    of a map as long as a thousand cells run.
    """
    from zarr.buffer import default_buffer_prototype
    from zarr.core.group import ConsolidatedMetadata, GroupMetadata

    group = GroupMetadata(attributes=dict(attributes), consolidated_metadata=ConsolidatedMetadata(dict(arrays)))
    metadata: dict[str, GroupMetadata | ArrayV3Metadata] = {"": group, **arrays}
    return {
        f"{folder}/{name}" if folder else name: content.to_bytes()
        for folder, described in metadata.items()
        for name, content in described.to_buffer_dict(default_buffer_prototype()).items()
    }


def void(name: str, dtype: np.dtype) -> Any:
    """Return the value of a variable where nothing was run."""
    if name == "status":
        return int(Status.NOT_RUN)
    return _VOID[dtype.kind]


def _fill(variable: "xr.Variable") -> dict[str, Any]:
    """Choose the value that readers of zarr see in place of a lost chunk, where the type has a void one."""
    name = "status" if "not_run" in variable.attrs.get("flag_meanings", "").split() else ""
    return {"fill_value": void(name, variable.dtype)} if variable.dtype.kind in _VOID else {}


def array(variable: "xr.Variable", shape: tuple[int, ...], chunks: tuple[int, ...], void: Any) -> "ArrayV3Metadata":
    """Describe an array of a store, with dimensions, numbers and attributes of a variable.

    Args:
        variable: What it is like.
        shape: Of the array.
        chunks: Lengths of its chunks.
        void: What it holds where there is no chunk.
    """
    from zarr.core.metadata import ArrayV3Metadata

    codecs = [{"name": "bytes", "configuration": {"endian": "little"}}, *(codec.to_dict() for codec in compressors())]
    return ArrayV3Metadata.from_dict(
        {
            "zarr_format": 3,
            "node_type": "array",
            "shape": shape,
            "data_type": variable.dtype.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": "NaN" if void != void else void,
            "codecs": codecs,
            "attributes": variable.attrs,
            "dimension_names": [str(dim) for dim in variable.dims] or None,
        }
    )


def chunk(name: str, place: Iterable[int]) -> str:
    """Name the file of a chunk of an array, by its number along every dimension."""
    return "/".join([name, "c", *map(str, place)])


def compressors() -> tuple[Any, ...]:
    """Make the codecs of every chunk, its checksum last."""
    from zarr.codecs import Crc32cCodec, ZstdCodec  # here, as importing vijax must not load it

    return ZstdCodec(level=_LEVEL), Crc32cCodec()


def encoded(chunk: np.ndarray) -> bytes:
    """Encode the file of a chunk in the format of `compressors`, as zarr does at three times the cost."""
    from numcodecs import Zstd
    from numcodecs.checksum32 import CRC32C

    ordered = np.ascontiguousarray(chunk, chunk.dtype.newbyteorder("<"))
    return bytes(CRC32C(location="end").encode(Zstd(level=_LEVEL).encode(ordered)))


def load(path: str | Path) -> "xr.Dataset":
    """Load the map that `save` wrote, equal to the one that was saved, or what there is of a study.

    Raises:
        FileNotFoundError: If there is no store.
        ValueError: If a file of it is not what was written, or it does not fit in memory; FileExistsError if a folder
            stands in the place of a file.

    Warns:
        UserWarning: If the store has no list of its files, as those of earlier versions: chunks alone are checked then,
            and cells of which a chunk is missing have the status `not_run`.
    """
    target = checks.path("path", path)
    while True:  # until no other process has replaced the store meanwhile
        before = _stamp(target / LIST)
        try:
            found = _loaded(target)
        except (OSError, ValueError):
            if _stamp(target / LIST) == before:
                raise
        else:
            if _stamp(target / LIST) == before:
                break
    if inventory.read(target) is None:
        warnings.warn(
            see(
                "studies",
                f"{checks.shown_path(target)} has no {LIST}, the list of its files, as stores of earlier versions: "
                "edits of its metadata go unseen, and cells of which a chunk is missing have the status not_run; make "
                "it anew for a store that is checked",
            ),
            stacklevel=2,
        )
    return found


def _stamp(file: Path) -> tuple[int, ...]:
    """Distinguish a file from any other that had its name before; nothing if there is none."""
    try:
        found = file.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _loaded(path: Path) -> "xr.Dataset":
    _check_there(path)
    arrays = store_names.declared(path)
    _check_size(path, arrays)
    with view(path) as dataset:
        _check(path, inventory.records(path))
        with _in_one_line(path):
            found = dataset.load()
    return found if inventory.read(path) else _without_lost_chunks(path, found, dict(reversed(arrays)))


def view(path: str | Path) -> "xr.Dataset":
    """Open a map as `load` does, but read nothing before it is looked at, nor compare files of tiles with records."""
    import xarray as xr  # here, as importing vijax must not load it

    target = Path(path)
    _check_there(target)
    _check(target, inventory.listed(target))
    for name, grid in store_names.layouts(target).items():
        if grid is None:
            raise _unreadable(path, f"{checks.shown_path(name)} is no array of vijax")
    # What has no list may be of an earlier version, whose metadata are not consolidated. Format 2 has codecs that run
    # code, and vijax never wrote it.
    with _in_one_line(path):
        return xr.open_zarr(path, zarr_format=3, consolidated=inventory.read(target) is not None, chunks=None)


def _check_there(path: Path) -> None:
    if not os.path.lexists(path):
        recover(path)
    if not (path / METADATA).is_file() and not inventory.is_store(path):
        raise FileNotFoundError(f"path must name a zarr store written by vijax; got {checks.shown_path(path)}")


def _check_size(path: Path, arrays: list[tuple[str, ArrayLayout]]) -> None:
    """Raise ValueError unless a store can be loaded: it fits in memory, has few enough chunks, and a map has cells."""
    sizes: dict[str, int] = {}
    for name, grid in arrays:
        sizes[name] = max(sizes.get(name, 0), grid.size)
        if name == "status" and not grid.size:
            _refuse(path, "a map of at least one cell", f"where status has {' x '.join(map(str, grid.shape))}")
    size, room = sum(sizes.values()), checks.memory()
    if size > room:
        took = checks.gigabytes(min(size, _LARGEST))
        _refuse(
            path,
            f"a map that fits in memory, {checks.gigabytes(room)}",
            f"whose arrays take {took}; read parts of it by xarray.open_zarr",
        )
    for name, grid in arrays:
        if (count := math.prod(grid.counts)) > _MOST_CHUNKS:
            _refuse(
                path,
                f"a map of at most {_MOST_CHUNKS:,} chunks in an array",
                f"where {name} has {count:,}; read parts of it by xarray.open_zarr",
            )
        # Tiles are no longer than the plane; chunks of a map that was saved may be.
        if inventory.is_study(path) and any(map(operator.gt, grid.chunk, grid.shape)):
            by, of = (" x ".join(map(str, lengths)) for lengths in (grid.shape, grid.chunk))
            _refuse(path, "a store as it was written", f"where {name} has {by} elements in chunks of {of}")


def _refuse(path: Path, must: str, got: str) -> None:
    raise ValueError(see("studies", f"path must name {must}; got {checks.shown_path(path)}, {got}"))


def _without_lost_chunks(path: Path, found: "xr.Dataset", arrays: Mapping[str, ArrayLayout]) -> "xr.Dataset":
    """Make void what lost chunks would hold, and `not_run` the status of its cells.

    Raises:
        ValueError: If a chunk is lost of a coordinate, or of a variable whose cells have no status.
    """
    for name, place in inventory.missing(path, arrays):
        if not {name, "status"} <= set(found.data_vars) or found[name].dtype.kind not in _VOID:
            _check(path, iter([(chunk(name, place), "is missing")]))
        grid, status = arrays[name], found["status"]
        steps = zip(grid.dims, place, grid.chunk, strict=True)
        block = {dim: slice(at * step, (at + 1) * step) for dim, at, step in steps}
        found[name][block] = void(name, found[name].dtype)
        status[{dim: part for dim, part in block.items() if dim in status.dims}] = int(Status.NOT_RUN)
    return found


def _check(path: Path, faults: Iterator[tuple[str, str]]) -> None:
    """Raise ValueError with the first of some faults, if there is any."""
    name, reason = next(faults, ("", ""))
    if reason:
        remedy = "run again, the call that made it mends it" if inventory.is_study(path) else "make it anew"
        raise ValueError(
            see(
                "studies",
                f"path must name a store as it was written; got {checks.shown_path(path)}, where "
                f"{checks.shown_path(name)} {reason}; {remedy}",
            )
        )


@contextmanager
def _in_one_line(path: str | Path) -> Iterator[None]:
    """Raise in one line what zarr and xarray raise for a store that they cannot read."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        raise _unreadable(path, " ".join(str(error).split()) or type(error).__name__) from error


def _unreadable(path: str | Path, reason: str) -> ValueError:
    shown = checks.shown_path(path)
    return ValueError(see("studies", f"path must name a store that can be read; got {shown} ({reason}); make it anew"))
