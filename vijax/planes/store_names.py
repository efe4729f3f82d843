"""Names of the files of a store. Whatever has another name in a store is foreign: it is never written or removed.

    zarr.json, vijax.json                        metadata of the group; list of the files
    <array>/zarr.json                            metadata of an array
    <array>/c/<i>/<j>                            chunk i along the first dimension, j along the second
    status/tiles/lock, status/tiles/<n>.json     lock of a study; record of tile n

Beside each there may be its part (`files.part_of`), which is being written. Links are foreign, too: nothing of a store
lies behind one.
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

from vijax.runtime import checks
from vijax.runtime.files import TOKEN
from vijax.runtime.pages import see

LIST = "vijax.json"
METADATA = "zarr.json"
TILES = Path("status", "tiles")
# Bytes of the longest file of JSON that is read: the list of a map in ten million files.
_LONGEST = 1 << 30
_NUMBER = "(?:0|[1-9][0-9]*)"
_ARRAY = rf"(?!(?:\.\.?|{METADATA}|{LIST})/)[^/]+"
_ANY = re.compile(
    rf"{METADATA}|{LIST}|status/tiles/(?:lock|{_NUMBER}\.json)|{_ARRAY}/(?:{METADATA}|c(?:/{_NUMBER})*)", re.DOTALL
)
# Parts of earlier versions have the number of a process in place of a random word.
_PART = re.compile(rf"\.(\w+)\.(?:[0-9]+|{TOKEN})\.part(\.json)?")


def content(file: Path) -> dict[str, Any] | None:
    """Read the JSON object in a file; None if there is none, or what takes too long to read."""
    try:
        if not file.is_file() or file.stat().st_size > _LONGEST:
            return None
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def is_name(name: str) -> bool:
    """Return True if some store has a file of this name."""
    return _ANY.fullmatch(name) is not None


def final(name: str) -> str:
    """Return the name that a part will have, and other names as they are."""
    folder, slash, last = name.rpartition("/")
    part = _PART.fullmatch(last)
    return f"{folder}{slash}{part[1]}{part[2] or ''}" if part else name


# --- arrays ----------------------------------------------------------------------------------------------------------


class ArrayLayout(NamedTuple):
    """How an array is cut into chunks: names, lengths and lengths of a chunk along its dimensions, and its type."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: str

    @property
    def counts(self) -> tuple[int, ...]:
        """Count the chunks along every dimension."""
        return tuple(-(-length // step) for length, step in zip(self.shape, self.chunk, strict=True))

    @property
    def size(self) -> int:
        """Count the bytes of all elements; eight for one of a type that NumPy does not know by this name."""
        try:
            item = np.dtype(self.dtype).itemsize
        except (SyntaxError, TypeError, ValueError):
            item = 8
        return math.prod(self.shape) * item

    def holds(self, place: tuple[int, ...]) -> bool:
        """Return True if there is a chunk with these numbers."""
        counts = self.counts
        return len(place) == len(counts) and all(number < count for number, count in zip(place, counts, strict=True))


def layout(metadata: Any) -> ArrayLayout | None:
    """Read the layout of an array from its metadata; None if these are not of an array that zarr could read."""
    try:
        shape, chunk = metadata["shape"], metadata["chunk_grid"]["configuration"]["chunk_shape"]
        dims = metadata.get("dimension_names") or [None] * len(shape)
        numbers = [*shape, *chunk]
        if metadata["node_type"] != "array" or not len(shape) == len(chunk) == len(dims):
            return None
    except (AttributeError, KeyError, TypeError):
        return None
    if not all(type(number) is int and number >= 0 for number in numbers) or not all(chunk):
        return None
    return ArrayLayout(tuple(map(str, dims)), (*shape,), (*chunk,), str(metadata.get("data_type")))


def layouts(path: Path) -> dict[str, ArrayLayout | None]:
    """Find the arrays of a store: those with metadata, with a copy of these in its first file, outputs of a study."""
    root = content(path / METADATA) or {}
    copies = _copies(root)
    # A map that was saved may be a part of what was asked for.
    outputs = str(_entry(root, "attributes").get("outputs", "")).split() if (path / TILES).is_dir() else []
    own = [file.parent.name for file in path.glob(f"*/{METADATA}")]
    names = [name for name in dict.fromkeys([*copies, *outputs, *own]) if is_name(f"{name}/{METADATA}")]
    return {name: layout(content(path / name / METADATA)) or copies.get(name) for name in names}


def declared(path: Path) -> list[tuple[str, ArrayLayout]]:
    """List the arrays that a reader may find in a store: by their own metadata, and by copies, which may differ."""
    both = [*layouts(path).items(), *_copies(content(path / METADATA) or {}).items()]
    return [(name, grid) for name, grid in both if grid is not None]


def _copies(root: Mapping[str, Any]) -> dict[str, ArrayLayout | None]:
    copies = _entry(_entry(root, "consolidated_metadata"), "metadata")
    return {name: layout(metadata) for name, metadata in copies.items()}


def _entry(found: Mapping[str, Any], name: str) -> dict[str, Any]:
    entry = found.get(name)
    return entry if isinstance(entry, dict) else {}


# --- what is in a store ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoreNames:
    """Names that the files and folders of one store have.

    Attributes:
        arrays: Layout of every array; None where its metadata are lost: it then has the chunks that others have.
        tiles: Whether it has a lock and records of tiles.
    """

    arrays: Mapping[str, ArrayLayout | None]
    tiles: bool

    def holds(self, name: str, entry: "os.DirEntry[str]") -> bool:
        """Return True if something in the store is vijax's, by its name and kind."""
        if entry.is_dir(follow_symlinks=False):
            return self._folder(name)
        return entry.is_file(follow_symlinks=False) and self._file(final(name))

    def _file(self, name: str) -> bool:
        if not is_name(name):
            return False
        array, _, rest = name.partition("/")
        if Path(name).parent == TILES:
            return self.tiles and self._tile(Path(name).stem)
        if not rest or rest == METADATA:
            return not rest or array in self.arrays
        place = tuple(map(int, rest.split("/")[1:]))
        return any(grid.holds(place) for grid in self._grids(array))

    def _tile(self, stem: str) -> bool:
        grids = self._grids("status")
        return stem == "lock" or any(int(stem) < math.prod(grid.counts) for grid in grids)

    def _folder(self, name: str) -> bool:
        array, *below = name.split("/")
        if Path(name) == TILES:
            return self.tiles
        if array not in self.arrays or (below and below[0] != "c"):
            return False
        numbers = below[1:]
        if not all(re.fullmatch(_NUMBER, number) for number in numbers):
            return False
        place = tuple(map(int, numbers))
        # A folder of chunks has further numbers below it.
        grids = [grid for grid in self._grids(array) if len(grid.shape) > len(place)]
        return not place or any(
            all(number < count for number, count in zip(place, grid.counts, strict=False)) for grid in grids
        )

    def _grids(self, array: str) -> list[ArrayLayout]:
        """Find the layout of an array; those of all others where its own is lost."""
        if array not in self.arrays:
            return []
        own = self.arrays[array]
        return [grid for grid in self.arrays.values() if grid is not None] if own is None else [own]


def entries(path: Path) -> "Iterator[tuple[str, os.DirEntry[str]]]":
    """Yield all that a folder holds at any depth, a folder before its contents; follows no link."""
    waiting = [""]
    while waiting:
        within = waiting.pop()
        with os.scandir(path / within) as listed:
            for entry in listed:
                name = f"{within}/{entry.name}" if within else entry.name
                yield name, entry
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(name)


def foreign(path: Path, names: StoreNames) -> str | None:
    """Find something in a store that vijax did not make: a file if there is one, else a folder."""
    found = [
        (entry.is_dir(follow_symlinks=False), name) for name, entry in entries(path) if not names.holds(name, entry)
    ]
    return min(found)[1] if found else None


def check_way(path: Path, name: str) -> None:
    """Raise FileExistsError unless every folder on the way to a file of a store is a folder, or missing."""
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
                    f"{checks.shown_path(above)} must be a folder of a store; got {got}; remove it, or take another "
                    "store",
                )
            )
