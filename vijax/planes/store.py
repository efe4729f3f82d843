"""Maps on disk: zarr stores that are whole or absent, each chunk with a checksum, every file in an inventory."""

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.planes import inventory
from vijax.runtime import checks
from vijax.runtime.files import check_ending, check_folder, recover, replacing_folder
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.metadata import ArrayV3Metadata

# Level of zstd. Level 3 takes twice as long and saves a thousandth more.
_LEVEL = 1


def check_store(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Check that a new store can be written, and give its path; `name` is the argument that an error speaks of.

    Raises:
        ValueError: If it has another ending than stores have.
        FileExistsError: If it is taken, and may not be replaced: what vijax did not write never.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = check_place(name, path)
    if os.path.lexists(target):
        if not overwrite:
            raise FileExistsError(
                see("studies", f"{name} must not exist yet; got {path}; allow overwriting, or take another name")
            )
        check_ours(name, target)
    return target


def check_place(name: str, path: str | Path) -> Path:
    """Check that a store can have this name, and give its path; what a killed run left there is put right.

    Raises:
        ValueError, FileNotFoundError, PermissionError: As `check_store`.
    """
    check_ending(name, path, ".zarr")
    target = check_folder(name, path)
    recover(target)
    return target


def check_ours(name: str, target: Path) -> None:
    """Raise FileExistsError unless something is a store and all that it holds was written by vijax."""
    if target.is_dir() and (stranger := inventory.foreign(target)):
        raise FileExistsError(
            see(
                "studies",
                f"{name} must not replace what vijax did not write; got {target}, which holds {stranger}; "
                "move it elsewhere, or take another name",
            )
        )
    if not inventory.is_store(target):
        raise FileExistsError(
            see("studies", f"{name} must not replace what is no store of vijax; got {target}; take another name")
        )


def save(dataset: "xr.Dataset", path: str | Path, *, overwrite: bool = False) -> None:
    """Write a map as a zarr store (format 3, zstd, CRC-32C); a write that fails or is stopped leaves nothing behind.

    Args:
        dataset: What `sweep` returned, or any part of it.
        path: Folder to make; it ends in .zarr.
        overwrite: Replace a store that is there.

    Raises:
        ValueError: If the path has another ending.
        FileExistsError: If the place is taken and may not be replaced: what vijax did not write never.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    checks.variables("dataset", dataset, (), "sweep")
    target = check_store("path", path, checks.flag("overwrite", overwrite))
    with replacing_folder(target) as part:
        write(dataset, part)
        inventory.write(part)


def write(dataset: "xr.Dataset", path: Path) -> None:
    """Write a new store, all its metadata in its first file, too, so that it opens at once anywhere."""
    encoding = {name: {"compressors": compressors()} for name in dataset.variables}
    with warnings.catch_warnings():
        # A reader that does not know of them finds the same in every array.
        warnings.filterwarnings("ignore", "Consolidated metadata", UserWarning)
        dataset.to_zarr(path, mode="w-", zarr_format=3, consolidated=True, encoding=encoding)


def write_blank(path: Path, attributes: Mapping[str, Any], arrays: "Mapping[str, ArrayV3Metadata]") -> None:
    """Write a new store without a chunk, as `write` does.

    Here zarr makes the metadata and does not write them: it takes two milliseconds to create an array, for all arrays
    of a map as long as a thousand cells run.
    """
    from zarr.buffer import default_buffer_prototype
    from zarr.core.group import ConsolidatedMetadata, GroupMetadata

    group = GroupMetadata(attributes=dict(attributes), consolidated_metadata=ConsolidatedMetadata(dict(arrays)))
    metadata: dict[str, GroupMetadata | ArrayV3Metadata] = {"": group, **arrays}
    for folder, described in metadata.items():
        (path / folder).mkdir()
        for name, content in described.to_buffer_dict(default_buffer_prototype()).items():
            (path / folder / name).write_bytes(content.to_bytes())


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


def chunk(path: Path, name: str, place: Iterable[int]) -> Path:
    """Name the file of a chunk of an array, by its number along every dimension."""
    return path.joinpath(name, "c", *map(str, place))


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
        ValueError: If a file of it is not what was written; FileExistsError if a folder stands in its place.

    Warns:
        UserWarning: If the store has no list of its files, as those of earlier versions: chunks alone are checked then.
    """
    path = checks.path("path", path)
    with view(path) as dataset:
        _check(path, inventory.records(path))
        with _in_one_line(path):
            found = dataset.load()
    if inventory.read(path) is None:
        warnings.warn(
            see(
                "studies",
                f"{path} has no {inventory.LIST}, the list of its files, as stores of earlier versions: edits of its "
                "metadata go unseen; make it anew for a store that is checked",
            ),
            stacklevel=2,
        )
    return found


def view(path: str | Path) -> "xr.Dataset":
    """Open a map as `load` does, but read nothing before it is looked at, nor compare files of tiles with records."""
    import xarray as xr  # here, as importing vijax must not load it

    target = Path(path)
    if not (target / "zarr.json").is_file() and not inventory.is_store(target):
        raise FileNotFoundError(f"path must name a zarr store written by vijax; got {path}")
    _check(target, inventory.listed(target))
    # What has no list may be of an earlier version, whose metadata are not consolidated.
    with _in_one_line(path):
        return xr.open_zarr(path, consolidated=inventory.read(target) is not None, chunks=None)


def _check(path: Path, faults: Iterator[tuple[str, str]]) -> None:
    """Raise ValueError with the first of some faults, if there is any."""
    name, reason = next(faults, ("", ""))
    if reason:
        remedy = "run again, the call that made it mends it" if inventory.is_study(path) else "make it anew"
        raise ValueError(
            see("studies", f"path must name a store as it was written; got {path}, where {name} {reason}; {remedy}")
        )


@contextmanager
def _in_one_line(path: str | Path) -> Iterator[None]:
    """Raise in one line what zarr and xarray say of a store that they cannot read."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            see("studies", f"path must name a store that can be read; got {path} ({said}); make it anew")
        ) from error
