"""The list of the files of a store, and records of its tiles: what was written, and what is no longer as it was.

A store lists its files with their lengths and checksums in `vijax.json`, as they are written: of a saved map all of
them, of a study metadata and coordinates. A tile of a study has a list of its own, its record. Stores of earlier
versions have no `vijax.json`. A list is valid only if every name in it is one that vijax gives to files of stores.
"""

import itertools
import json
import os
import stat
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vijax.planes import store_names
from vijax.planes.store_names import LIST, METADATA, TILES, ArrayLayout, StoreNames, check_way
from vijax.runtime import checks
from vijax.runtime.files import json_bytes
from vijax.runtime.pages import see


def fingerprint(content: bytes) -> str:
    """Return length and checksum of a file, as text."""
    return f"{len(content)} bytes, CRC-32 {zlib.crc32(content):08x}"


def fault(path: Path, name: str, expected: str | None) -> str:
    """Describe what is wrong with a file of a store that had this fingerprint; return no text if it still has.

    Raises:
        FileExistsError: If a folder stands in its place, or a link or a file in that of one of its folders.
    """
    check_way(path, name)
    file = path / name
    try:
        there = os.lstat(file)
    except FileNotFoundError:
        return "is missing"
    if stat.S_ISDIR(there.st_mode):
        raise FileExistsError(
            see(
                "studies",
                f"{checks.shown_path(file)} must be a file that vijax wrote; got a folder; remove it, or take another "
                "store",
            )
        )
    if not stat.S_ISREG(there.st_mode):
        return "is no regular file"  # It must not be read: a pipe would take for ever.
    if not str(expected).startswith(f"{there.st_size} bytes"):
        return "is not what was written"
    try:
        found = file.read_bytes()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if fingerprint(found) == expected else "is not what was written"


# --- the list --------------------------------------------------------------------------------------------------------


class FileList:
    """The list of a new store, which grows as its files are written."""

    def __init__(self) -> None:
        self._files: dict[str, str] = {}
        self._metadata: dict[str, str] = {}

    def add(self, name: str, content: bytes) -> None:
        """Add a file; metadata are listed with a copy."""
        self._files[name] = fingerprint(content)
        if name.rpartition("/")[2] == METADATA:
            self._metadata[name] = content.decode()

    def content(self, **facts: Any) -> bytes:
        """Return the content of the file `vijax.json`, with facts about the store."""
        files, metadata = (dict(sorted(each.items())) for each in (self._files, self._metadata))
        listed = {**facts, "files": files, "metadata": metadata}
        return json_bytes({**listed, "checksum": _own(listed)})


def read(path: Path) -> dict[str, Any] | None:
    """Read the list of a store; None if there is none, or it is not as vijax wrote it."""
    listed = store_names.content(path / LIST)
    if listed is None or listed.pop("checksum", None) != _own(listed) or not _is_list(listed):
        return None
    return listed


def _own(listed: Mapping[str, Any]) -> str:
    return fingerprint(json.dumps(listed, sort_keys=True).encode())


def _is_list(listed: Mapping[str, Any]) -> bool:
    """Return True if a list has the entries that lists have, and names files of stores alone."""
    files, metadata = listed.get("files"), listed.get("metadata")
    if not isinstance(files, dict) or not isinstance(metadata, dict):
        return False
    if not all(map(store_names.is_name, (*files, *metadata))):
        return False
    if not all(isinstance(text, str) for text in (*files.values(), *metadata.values())):
        return False
    if "birth" not in listed:
        return True
    birth, tile = listed["birth"], listed.get("tile")
    return (
        isinstance(birth, str)
        and isinstance(tile, dict)
        and all(type(length) is int and length > 0 for length in tile.values())
    )


def faults(path: Path, files: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files of a list: names and reasons."""
    for name, expected in files.items():
        if reason := fault(path, name, expected):
            yield name, reason


def listed(path: Path) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files that the list of a store names, or with that list."""
    found = read(path)
    if found is not None:
        yield from faults(path, found["files"])
    elif os.path.lexists(path / LIST):
        yield LIST, fault(path, LIST, None)
    else:
        yield from _unlisted(path)


def _unlisted(path: Path) -> Iterator[tuple[str, str]]:
    """Find what cannot be read of a store without a list; there is nothing to compare its files with."""
    for name, entry in store_names.entries(path):
        # To read a pipe would take for ever.
        if not entry.is_dir(follow_symlinks=False) and not entry.is_file(follow_symlinks=False):
            yield name, "is no regular file"
    # Chunks without metadata, and arrays of zarr's second format, are no folders of anything else.
    arrays = [file.parent.name for mark in ("c", ".zarray") for file in sorted(path.glob(f"*/{mark}"))]
    for array in dict.fromkeys([*store_names.layouts(path), *arrays]):
        name = f"{array}/{METADATA}"
        if not os.path.lexists(path / name):
            yield name, "is missing"
        elif store_names.content(path / name) is None:
            yield name, "cannot be read"


def had_list(path: Path) -> bool:
    """Return True if a store without a list had one: if so, its records name files, and not variables."""
    record = store_names.content(next((path / TILES).glob("[0-9]*.json"), path / TILES)) or {}
    return any("/" in name for name in record.get("files") or ())


def records(path: Path) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files of the tiles that are done, and with their records; nothing without a list."""
    for record in sorted((path / TILES).glob("[0-9]*.json")) if read(path) else ():
        found = store_names.content(record)
        if (
            found is None
            or not isinstance(found.get("files"), dict)
            or not all(map(store_names.is_name, found["files"]))
        ):
            yield record.relative_to(path).as_posix(), "cannot be read"
        else:
            yield from faults(path, found["files"])


def missing(path: Path, arrays: Mapping[str, ArrayLayout]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Find the chunks that arrays of a store lack: names of arrays and numbers of chunks."""
    there = {name for name, entry in store_names.entries(path) if entry.is_file(follow_symlinks=False)}
    for name, grid in arrays.items():
        for place in itertools.product(*map(range, grid.counts)):
            if "/".join([name, "c", *map(str, place)]) not in there:
                yield name, place


# --- what is vijax's -------------------------------------------------------------------------------------------------


def is_study(path: Path) -> bool:
    """Return True if the files of a store are made tile by tile, so that what is damaged is made again."""
    return (path / TILES).is_dir() or "birth" in (read(path) or {})


def is_store(path: Path) -> bool:
    """Return True if a folder is a store of vijax, of an earlier version too; it may be damaged."""
    if (path / LIST).is_file():
        return True
    attributes = (store_names.content(path / METADATA) or {}).get("attributes")
    return isinstance(attributes, dict) and str(attributes.get("source")).startswith("vijax ")


def names(path: Path) -> StoreNames:
    """Find the names that the files of a store have: by its list or, where that is lost, by its metadata."""
    listed = read(path)
    if listed is None:
        return StoreNames(store_names.layouts(path), tiles=is_study(path))
    arrays = [array for array, slash, _ in (name.partition("/") for name in listed["files"]) if slash]
    copies = {array: listed["metadata"].get(f"{array}/{METADATA}", "") for array in arrays}
    return StoreNames({array: store_names.layout(_parsed(text)) for array, text in copies.items()}, "birth" in listed)


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def half_written(path: Path) -> list[Path]:
    """Find the parts of files that a store has; some may still be written."""
    known = names(path)
    return [
        path / name
        for name, entry in store_names.entries(path)
        if store_names.final(name) != name and known.holds(name, entry)
    ]
