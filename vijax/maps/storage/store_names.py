"""File names of a store. A file with any other name is foreign: vijax never writes or removes it.

    zarr.json, vijax.json                        metadata of the group; list of the files
    <array>/zarr.json                            metadata of an array
    <array>/c/<i>/<j>                            chunk i along the first dimension, j along the second
    status/tiles/lock, status/tiles/<n>.json     lock of a study; record of tile n

Each file may have a temporary part next to it (`files.part_of`) while it is written. Links are foreign, too: no file of
a store lies behind one.
"""

import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import TOKEN

LIST = "vijax.json"
METADATA = "zarr.json"
TILES = Path("status", "tiles")
# Maximum size in bytes of a JSON file that is read: the list of a map in ten million files.
_MAX_JSON_BYTES = 1 << 30
_NUMBER = "(?:0|[1-9][0-9]*)"
# Escaped, because a point would match any character: a foreign file `zarrXjson` would count as a file of the store.
_METADATA, _LIST = re.escape(METADATA), re.escape(LIST)
# A folder of an array: not . or .., which leave the store, and not the name of a file of the group.
_ARRAY = rf"(?!(?:\.\.?|{_METADATA}|{_LIST})/)[^/]+"
_FILE_NAME = re.compile(
    rf"{_METADATA}|{_LIST}|status/tiles/(?:lock|{_NUMBER}\.json)|{_ARRAY}/(?:{_METADATA}|c(?:/{_NUMBER})*)", re.DOTALL
)
# Parts of earlier versions have a process number in place of a random token.
_PART = re.compile(rf"\.(\w+)\.(?:[0-9]+|{TOKEN})\.part(\.json)?")


def content(file: Path) -> dict[str, Any] | None:
    """Return the JSON object in a file; None if there is none, or the file is too long."""
    try:
        if not file.is_file() or file.stat().st_size > _MAX_JSON_BYTES:
            return None
        parsed = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return parsed if isinstance(parsed, dict) else None


def is_name(name: str) -> bool:
    """Return True if a store may have a file of this name."""
    return _FILE_NAME.fullmatch(name) is not None


def final(name: str) -> str:
    """Return the final name of a temporary part; other names unchanged."""
    folder, slash, last = name.rpartition("/")
    part = _PART.fullmatch(last)
    return f"{folder}{slash}{part[1]}{part[2] or ''}" if part else name


# --- arrays ----------------------------------------------------------------------------------------------------------


class ArrayLayout(NamedTuple):
    """Division of an array into chunks.

    Attributes:
        dims: Names of its dimensions.
        shape: Lengths of its dimensions.
        chunk: Lengths of a chunk along its dimensions.
        dtype: Name of its data type.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: str

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of chunks along every dimension."""
        # -(-a // b) is the quotient rounded up.
        return tuple(-(-length // step) for length, step in zip(self.shape, self.chunk, strict=True))

    @property
    def size(self) -> int:
        """Bytes of all elements; eight per element if NumPy does not know the type by this name."""
        try:
            item = np.dtype(self.dtype).itemsize
        except (SyntaxError, TypeError, ValueError):
            item = 8
        return math.prod(self.shape) * item

    def holds(self, index: tuple[int, ...]) -> bool:
        """Return True if there is a chunk with this index."""
        counts = self.counts
        return len(index) == len(counts) and all(number < count for number, count in zip(index, counts, strict=True))


def layout(metadata: Any) -> ArrayLayout | None:
    """Return the layout of an array from its metadata; None if they do not describe an array that zarr could read."""
    try:
        shape, chunk = metadata["shape"], metadata["chunk_grid"]["configuration"]["chunk_shape"]
        dims = metadata.get("dimension_names") or [None] * len(shape)
        numbers = [*shape, *chunk]
        if metadata["node_type"] != "array" or not len(shape) == len(chunk) == len(dims):
            return None
    except (AttributeError, KeyError, TypeError):
        return None
    # Metadata are untrusted: numbers may be floats, booleans or negative, and chunk lengths may be 0.
    if not all(type(number) is int and number >= 0 for number in numbers) or not all(chunk):
        return None
    return ArrayLayout(tuple(map(str, dims)), (*shape,), (*chunk,), str(metadata.get("data_type")))


def layouts(path: Path) -> dict[str, ArrayLayout | None]:
    """Return the layouts of the arrays of a store by name; None if the metadata of an array are lost.

    The arrays have a metadata file, or a copy of their metadata in the first file, or are listed as outputs of a study.
    """
    root = content(path / METADATA) or {}
    copies = _copies(root)
    # The attribute `outputs` is read only for a study, because a saved map may be a part of a sweep and lack outputs.
    outputs = str(_entry(root, "attributes").get("outputs", "")).split() if (path / TILES).is_dir() else []
    array_files = [file.parent.name for file in path.glob(f"*/{METADATA}")]
    names = [name for name in dict.fromkeys([*copies, *outputs, *array_files]) if is_name(f"{name}/{METADATA}")]
    return {name: layout(content(path / name / METADATA)) or copies.get(name) for name in names}


def declared(path: Path) -> list[tuple[str, ArrayLayout]]:
    """Return all declared layouts: from metadata of arrays, and from copies in the first file, which may differ."""
    declarations = [*layouts(path).items(), *_copies(content(path / METADATA) or {}).items()]
    return [(name, grid) for name, grid in declarations if grid is not None]


def _copies(root: Mapping[str, Any]) -> dict[str, ArrayLayout | None]:
    """Return the layouts in the consolidated metadata of a store."""
    copies = _entry(_entry(root, "consolidated_metadata"), "metadata")
    return {name: layout(metadata) for name, metadata in copies.items()}


def _entry(mapping: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a mapping nested in another; empty if it is absent or no mapping."""
    entry = mapping.get(name)
    return entry if isinstance(entry, dict) else {}


# --- contents of a store ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoreNames:
    """Names that the files and folders of one store have.

    Attributes:
        arrays: Layout of every array; None if its metadata are lost. The array may then have the chunks of any other
            array.
        tiles: Whether the store has a lock and records of tiles.
    """

    arrays: Mapping[str, ArrayLayout | None]
    tiles: bool

    def holds(self, name: str, entry: "os.DirEntry[str]") -> bool:
        """Return True if an entry of the store belongs to vijax, by its name and kind."""
        if entry.is_dir(follow_symlinks=False):
            return self._folder(name)
        return entry.is_file(follow_symlinks=False) and self._file(final(name))

    def _file(self, name: str) -> bool:
        """Return True if the store may have a file of this name."""
        if not is_name(name):
            return False
        # A chunk is named <array>/c/<i>/<j>; a scalar array has the chunk <array>/c.
        array, _, rest = name.partition("/")
        if Path(name).parent == TILES:
            return self.tiles and self._tile(Path(name).stem)
        if not rest or rest == METADATA:
            return not rest or array in self.arrays
        index = tuple(map(int, rest.split("/")[1:]))
        return any(grid.holds(index) for grid in self._grids(array))

    def _tile(self, stem: str) -> bool:
        """Return True if the store may have a tile record, or the lock, with this stem."""
        grids = self._grids("status")
        return stem == "lock" or any(int(stem) < math.prod(grid.counts) for grid in grids)

    def _folder(self, name: str) -> bool:
        """Return True if the store may have a folder of this name."""
        array, *below = name.split("/")
        if Path(name) == TILES:
            return self.tiles
        if array not in self.arrays or (below and below[0] != "c"):
            return False
        numbers = below[1:]
        if not all(re.fullmatch(_NUMBER, number) for number in numbers):
            return False
        index = tuple(map(int, numbers))
        # A folder of chunks must have further indices below it.
        grids = [grid for grid in self._grids(array) if len(grid.shape) > len(index)]
        return not index or any(
            all(number < count for number, count in zip(index, grid.counts, strict=False)) for grid in grids
        )

    def _grids(self, array: str) -> list[ArrayLayout]:
        """Return the layout of an array; if its own is lost, the layouts of all others."""
        if array not in self.arrays:
            return []
        layout_of_array = self.arrays[array]
        return (
            [grid for grid in self.arrays.values() if grid is not None]
            if layout_of_array is None
            else [layout_of_array]
        )


def entries(path: Path) -> "Iterator[tuple[str, os.DirEntry[str]]]":
    """Yield all entries of a folder at any depth, a folder before its contents, without following links."""
    # A list of pending folders in place of recursion, which a deeply nested folder would exhaust.
    pending = [""]
    while pending:
        folder = pending.pop()
        with os.scandir(path / folder) as listed:
            for entry in listed:
                name = f"{folder}/{entry.name}" if folder else entry.name
                yield name, entry
                if entry.is_dir(follow_symlinks=False):
                    pending.append(name)


def foreign(path: Path, names: StoreNames) -> str | None:
    """Return the name of an entry of a store that vijax did not make: a file if there is one, else a folder."""
    foreign_entries = [
        (entry.is_dir(follow_symlinks=False), name) for name, entry in entries(path) if not names.holds(name, entry)
    ]
    # False sorts before True: files come before folders.
    return min(foreign_entries)[1] if foreign_entries else None


def check_folders_above(path: Path, name: str) -> None:
    """Raise FileExistsError unless every existing folder on the path to a file of a store is a real folder."""
    above = path
    for step in name.split("/")[:-1]:
        above = above / step
        try:
            mode = os.lstat(above).st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISDIR(mode):
            got = "a link" if stat.S_ISLNK(mode) else "a file"
            raise FileExistsError(
                see(
                    "studies",
                    f"{validation.path_text(above)} must be a folder of a store; got {got}; remove it, or take another "
                    "store",
                )
            )
