"""Maps on disk: zarr stores (format 3), complete or absent, with a checksum per chunk and a list of all files."""

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

from vijax.maps.storage import store_inventory, store_names
from vijax.maps.storage.store_folder import exclusive_writer, recover, replacing_store, validate_new_store_path
from vijax.maps.storage.store_names import LIST, METADATA, ArrayLayout
from vijax.model.records import Status
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import create, make_folder, make_folders

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.metadata import ArrayV3Metadata

# Compression level of zstd. Level 3 takes twice as long and saves another 0.1 %.
_ZSTD_LEVEL = 1
# Maximum number of chunks of a loaded array: zarr looks up every one, whether it exists or not.
_MAX_CHUNKS = 10**6
# Upper bound of the size that an error shows, because corrupt metadata may declare a size beyond the range of floats.
_MAX_REPORTED_BYTES = 10**30
# Values of cells that were not simulated, by kind of dtype.
_VOID: dict[str, Any] = {"f": np.nan, "i": -1, "b": False}


def save(dataset: "xr.Dataset", path: str | Path, *, overwrite: bool = False) -> None:
    """Write a map as a zarr store (format 3, zstd, CRC-32C), on disk when this returns; a failed write leaves nothing.

    If two calls write to one path at the same time, the store of the last one to finish remains, complete.

    Args:
        dataset: The dataset returned by `sweep`, or any part of it.
        path: Folder to make; its name ends in .zarr.
        overwrite: Replace an existing store, which is removed once the new one is on disk.

    Raises:
        ValueError: If the path does not end in .zarr.
        FileExistsError: If the path exists and may not be replaced; files that vijax did not write are never replaced.
        FileNotFoundError, PermissionError: If the parent folder is missing or not writable.
        BlockingIOError: If a run is writing the store that would be replaced.
    """
    validation.validate_dataset("dataset", dataset, (), "sweep")
    for variable in dataset.variables:
        if not store_names.is_name(f"{variable}/{METADATA}"):
            raise ValueError(
                f"dataset must have variables that can name a folder; got {validation.value_text(variable)}"
            )
    target = validate_new_store_path("path", path, validation.validate_flag("overwrite", overwrite))
    with exclusive_writer("path", target), replacing_store("path", target, overwrite) as new:
        write_store(dataset, new)


def write_store(dataset: "xr.Dataset", path: Path) -> None:
    """Write a new store and the list of its files, with copies of all metadata in its first file, `zarr.json`.

    Every chunk is written, even if it contains only fill values. Fill values are void (NaN, -1 or False), so that a
    lost chunk is never mistaken for results.
    """
    from zarr.abc.store import Store
    from zarr.core.buffer import Buffer
    from zarr.storage import LocalStore

    listed = store_inventory.FileList()

    class RecordingStore(LocalStore):
        async def set(self, key: str, value: Buffer) -> None:
            content = value.to_bytes()
            listed.add(key, content)
            await asyncio.to_thread(_put, path, key, content)

        # zarr writes some files by this method; they belong in the list, too.
        async def set_if_not_exists(self, key: str, value: Buffer) -> None:
            if not await self.exists(key):
                await self.set(key, value)

    store: Store = RecordingStore(path)
    # Fill values mark lost chunks as void: a default fill value of 0 would pass for a number.
    encoding = {name: {"compressors": compressors(), **_fill(variable)} for name, variable in dataset.variables.items()}
    make_folder(path)
    with warnings.catch_warnings():
        # Consolidated metadata are no part of format 3 yet. A reader without support for them reads the same metadata
        # from the file of every array.
        warnings.filterwarnings("ignore", "Consolidated metadata", UserWarning)
        dataset.to_zarr(store, mode="w-", zarr_format=3, consolidated=True, encoding=encoding, write_empty_chunks=True)
    _put(path, LIST, listed.content())


def write_files(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write a new store from the contents of all its files."""
    make_folder(path)
    for name, content in contents.items():
        _put(path, name, content)


def _put(path: Path, name: str, content: bytes) -> None:
    """Write a file of a new store."""
    make_folders(path, [path / name])
    create(path / name, content)


def metadata_files(attributes: Mapping[str, Any], arrays: "Mapping[str, ArrayV3Metadata]") -> dict[str, bytes]:
    """Return the metadata files of a store, encoded as `write_store` does.

    Here zarr only encodes the metadata and does not write them. To create one array through zarr takes two
    milliseconds; for all arrays of a map, a thousand cells could be simulated in that time.
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


def void_value(name: str, dtype: np.dtype) -> Any:
    """Return the value of a variable in cells that were not simulated."""
    if name == "status":
        return int(Status.NOT_RUN)
    return _VOID[dtype.kind]


def _fill(variable: "xr.Variable") -> dict[str, Any]:
    """Return the encoding with the void fill value, read for a lost chunk; empty if the dtype has no void value."""
    name = "status" if "not_run" in variable.attrs.get("flag_meanings", "").split() else ""
    return {"fill_value": void_value(name, variable.dtype)} if variable.dtype.kind in _VOID else {}


def array_metadata(
    variable: "xr.Variable", shape: tuple[int, ...], chunks: tuple[int, ...], fill_value: Any
) -> "ArrayV3Metadata":
    """Return the metadata of an array of a store, with dimensions, dtype and attributes of a variable.

    Args:
        variable: Variable with these properties.
        shape: Shape of the array.
        chunks: Lengths of its chunks.
        fill_value: Value of elements without a chunk.
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
            # NaN is the only value unequal to itself; JSON has no number for it.
            "fill_value": "NaN" if fill_value != fill_value else fill_value,
            "codecs": codecs,
            "attributes": variable.attrs,
            "dimension_names": [str(dim) for dim in variable.dims] or None,
        }
    )


def chunk(name: str, index: Iterable[int]) -> str:
    """Return the file name of a chunk of an array, from its index along every dimension."""
    return "/".join([name, "c", *map(str, index)])


def compressors() -> tuple[Any, ...]:
    """Return the codecs of every chunk, the checksum last."""
    from zarr.codecs import Crc32cCodec, ZstdCodec  # here, as importing vijax must not load it

    return ZstdCodec(level=_ZSTD_LEVEL), Crc32cCodec()


def encode_chunk(chunk: np.ndarray) -> bytes:
    """Encode a chunk in the format of `compressors`, without zarr, which takes three times as long."""
    from numcodecs import Zstd
    from numcodecs.checksum32 import CRC32C

    # Little-endian C order, as declared by the codec `bytes` in `array_metadata`.
    ordered = np.ascontiguousarray(chunk, chunk.dtype.newbyteorder("<"))
    return bytes(CRC32C(location="end").encode(Zstd(level=_ZSTD_LEVEL).encode(ordered)))


def load(path: str | Path) -> "xr.Dataset":
    """Load into memory a map that `save` wrote, or the completed part of a study, a map written tile by tile.

    Raises:
        FileNotFoundError: If there is no store.
        ValueError: If a file of the store differs from the file that was written, or the map does not fit in memory;
            FileExistsError if a folder has the name of a file.

    Warns:
        UserWarning: If the store has no list of its files, as in earlier versions: then only chunks are verified, and
            cells with a missing chunk have the status `not_run`.
    """
    target = validation.validate_path("path", path)
    while True:  # repeat if another process replaced the store meanwhile
        # A store is replaced as a whole, with its list: an unchanged list means that all files were of one store.
        before = _stamp(target / LIST)
        try:
            result = _load_once(target)
        except (OSError, ValueError):
            if _stamp(target / LIST) == before:
                raise
        else:
            if _stamp(target / LIST) == before:
                break
    if store_inventory.read(target) is None:
        warnings.warn(
            see(
                "studies",
                f"{validation.path_text(target)} has no {LIST}, the list of its files, as stores of earlier versions: "
                "changes of its metadata cannot be detected, and cells in missing chunks have the status not_run; "
                "write it again to enable verification",
            ),
            stacklevel=2,
        )
    return result


def _stamp(file: Path) -> tuple[int, ...]:
    """Return device, inode and modification time, which identify one version of a file; empty if there is no file."""
    try:
        file_stat = file.stat()
    except OSError:
        return ()
    return file_stat.st_dev, file_stat.st_ino, file_stat.st_mtime_ns


def _load_once(path: Path) -> "xr.Dataset":
    """Verify and load a store once; `load` repeats this if another process replaces the store meanwhile."""
    _check_exists(path)
    arrays = store_names.declared(path)
    _check_size(path, arrays)
    with open_store(path) as dataset:
        _check(path, store_inventory.record_errors(path))
        with _short_errors(path):
            loaded = dataset.load()
    # Reversed, so that an array's own metadata take precedence over the copy in the first file.
    return loaded if store_inventory.read(path) else _mark_lost_chunks(path, loaded, dict(reversed(arrays)))


def open_store(path: str | Path) -> "xr.Dataset":
    """Open a map as `load` does, but read data only on access, and do not verify the files of tiles."""
    import xarray as xr  # here, as importing vijax must not load it

    target = Path(path)
    _check_exists(target)
    _check(target, store_inventory.list_errors(target))
    for name, grid in store_names.layouts(target).items():
        if grid is None:
            raise _unreadable(path, f"{validation.path_text(name)} is no array of vijax")
    # A store without a list may be of an earlier version, with metadata that are not consolidated. Format 2 is
    # excluded: vijax never wrote it, and its codecs can execute code.
    with _short_errors(path):
        return xr.open_zarr(path, zarr_format=3, consolidated=store_inventory.read(target) is not None, chunks=None)


def _check_exists(path: Path) -> None:
    """Raise FileNotFoundError unless there is a store; first restore one that a killed run had moved away."""
    if not os.path.lexists(path):
        recover(path)
    if not (path / METADATA).is_file() and not store_inventory.is_store(path):
        raise FileNotFoundError(f"path must name a zarr store written by vijax; got {validation.path_text(path)}")


def _check_size(path: Path, arrays: list[tuple[str, ArrayLayout]]) -> None:
    """Raise ValueError unless a store can be loaded: it fits in memory, has few enough chunks, and has cells."""
    sizes: dict[str, int] = {}
    for name, grid in arrays:
        # The metadata of an array may be declared twice, in its own file and in the first file of the store. A reader
        # may use either declaration, so the larger size counts.
        sizes[name] = max(sizes.get(name, 0), grid.size)
        if name == "status" and not grid.size:
            _refuse(path, "a map of at least one cell", f"where status has {' x '.join(map(str, grid.shape))}")
    size, available = sum(sizes.values()), validation.memory()
    if size > available:
        required = validation.gigabytes(min(size, _MAX_REPORTED_BYTES))
        _refuse(
            path,
            f"a map that fits in memory, {validation.gigabytes(available)}",
            f"whose arrays take {required}; read parts of it by xarray.open_zarr",
        )
    for name, grid in arrays:
        if (count := math.prod(grid.counts)) > _MAX_CHUNKS:
            _refuse(
                path,
                f"a map of at most {_MAX_CHUNKS:,} chunks in an array",
                f"where {name} has {count:,}; read parts of it by xarray.open_zarr",
            )
        # Tiles of a study are at most as long as the plane, so longer chunks show damage. Chunks of a saved map may be
        # longer, if it is a part of another map.
        if store_inventory.is_study(path) and any(map(operator.gt, grid.chunk, grid.shape)):
            by, of = (" x ".join(map(str, lengths)) for lengths in (grid.shape, grid.chunk))
            _refuse(path, "a store as it was written", f"where {name} has {by} elements in chunks of {of}")


def _refuse(path: Path, must: str, got: str) -> None:
    """Raise ValueError with the requirement and the reason."""
    raise ValueError(see("studies", f"path must name {must}; got {validation.path_text(path)}, {got}"))


def _mark_lost_chunks(path: Path, dataset: "xr.Dataset", arrays: Mapping[str, ArrayLayout]) -> "xr.Dataset":
    """Set the values of lost chunks to void, and the status of their cells to `not_run`.

    Raises:
        ValueError: If a lost chunk belongs to a coordinate or has no void value, or if the map has no `status`.
    """
    for name, index in store_inventory.missing_chunks(path, arrays):
        if not {name, "status"} <= set(dataset.data_vars) or dataset[name].dtype.kind not in _VOID:
            _check(path, iter([(chunk(name, index), "is missing")]))
        grid, status = arrays[name], dataset["status"]
        steps = zip(grid.dims, index, grid.chunk, strict=True)
        block = {dim: slice(number * step, (number + 1) * step) for dim, number, step in steps}
        dataset[name][block] = void_value(name, dataset[name].dtype)
        status[{dim: part for dim, part in block.items() if dim in status.dims}] = int(Status.NOT_RUN)
    return dataset


def _check(path: Path, errors: Iterator[tuple[str, str]]) -> None:
    """Raise ValueError with the first of some integrity errors, if there is any."""
    name, reason = next(errors, ("", ""))
    if reason:
        remedy = (
            "repeat the call that made it, which repairs it" if store_inventory.is_study(path) else "write it again"
        )
        raise ValueError(
            see(
                "studies",
                f"path must name a store as it was written; got {validation.path_text(path)}, where "
                f"{validation.path_text(name)} {reason}; {remedy}",
            )
        )


@contextmanager
def _short_errors(path: str | Path) -> Iterator[None]:
    """Convert errors of zarr and xarray for an unreadable store to a ValueError of one line."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        raise _unreadable(path, " ".join(str(error).split()) or type(error).__name__) from error


def _unreadable(path: str | Path, reason: str) -> ValueError:
    """Return the error for a store that cannot be read."""
    path_text = validation.path_text(path)
    return ValueError(
        see("studies", f"path must name a store that can be read; got {path_text} ({reason}); write it again")
    )
