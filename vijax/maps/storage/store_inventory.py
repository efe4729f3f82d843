"""The list of the files of a store, records of its tiles, and detection of files that changed since they were written.

A store lists its files with lengths and checksums in `vijax.json`: all files of a saved map; metadata and coordinates
of a study. Each tile of a study has a list of its own, its record. Stores of earlier versions have no `vijax.json`. A
list is valid only if every name in it is a file name of stores.
"""

import itertools
import json
import os
import stat
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vijax.maps.storage import store_names
from vijax.maps.storage.store_names import LIST, METADATA, TILES, ArrayLayout, StoreNames, check_folders_above
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import json_bytes

# Former names of entries in the JSON files of stores, and their present names.
_RENAMED_ENTRIES = {"birth": "store_id"}


def fingerprint(content: bytes) -> str:
    """Return length and checksum of a file's content, as text."""
    return f"{len(content)} bytes, CRC-32 {zlib.crc32(content):08x}"


def integrity_error(path: Path, name: str, expected: str | None) -> str:
    """Return as text how a file differs from its fingerprint `expected`; an empty text if it does not differ.

    Raises:
        FileExistsError: If the file is a folder, or if a folder on its path is a link or a file.
    """
    check_folders_above(path, name)
    file = path / name
    try:
        entry_stat = os.lstat(file)
    except FileNotFoundError:
        return "is missing"
    if stat.S_ISDIR(entry_stat.st_mode):
        raise FileExistsError(
            see(
                "studies",
                f"{validation.path_text(file)} must be a file that vijax wrote; got a folder; remove it, or take "
                "another store",
            )
        )
    if not stat.S_ISREG(entry_stat.st_mode):
        return "is no regular file"  # not to be read: reading a pipe may never end
    # The length is compared first: it needs no read, and detects truncation, the usual damage.
    if not str(expected).startswith(f"{entry_stat.st_size} bytes"):
        return "is not what was written"
    try:
        content = file.read_bytes()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if fingerprint(content) == expected else "is not what was written"


# --- the list --------------------------------------------------------------------------------------------------------


class FileList:
    """The list of the files of a new store, which grows as they are written."""

    def __init__(self) -> None:
        self._files: dict[str, str] = {}
        self._metadata: dict[str, str] = {}

    def add(self, name: str, content: bytes) -> None:
        """Add a file; metadata are listed with a copy of their content."""
        self._files[name] = fingerprint(content)
        if name.rpartition("/")[2] == METADATA:
            # Copies of metadata allow a repair without the plan that made the store.
            self._metadata[name] = content.decode()

    def content(self, **facts: Any) -> bytes:
        """Return the content of the file `vijax.json`, with further entries `facts` about the store."""
        files, metadata = (dict(sorted(entries.items())) for entries in (self._files, self._metadata))
        file_list = {**facts, "files": files, "metadata": metadata}
        return json_bytes({**file_list, "checksum": _list_checksum(file_list)})


def read(path: Path) -> dict[str, Any] | None:
    """Return the list of the files of a store; None if there is none or its checksum is wrong."""
    file_list = store_names.content(path / LIST)
    if file_list is None or file_list.pop("checksum", None) != _list_checksum(file_list):
        return None
    # The checksum is of the entries as written, so they are renamed after it is verified.
    file_list = with_current_names(file_list)
    return file_list if _is_list(file_list) else None


def with_current_names(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a list or of a tile record with the names that this version writes."""
    return {_RENAMED_ENTRIES.get(name, name): entry for name, entry in entries.items()}


def _list_checksum(file_list: Mapping[str, Any]) -> str:
    """Return the fingerprint of a list without its own checksum."""
    return fingerprint(json.dumps(file_list, sort_keys=True).encode())


def _is_list(file_list: Mapping[str, Any]) -> bool:
    """Return True if a list has the required entries, and all its names are file names of stores."""
    # The checksum only shows that a list is unchanged. It may be of another version or forged, so all types and names
    # are checked: names become paths.
    files, metadata = file_list.get("files"), file_list.get("metadata")
    if not isinstance(files, dict) or not isinstance(metadata, dict):
        return False
    if not all(map(store_names.is_name, (*files, *metadata))):
        return False
    if not all(isinstance(text, str) for text in (*files.values(), *metadata.values())):
        return False
    # "store_id" and "tile" are entries of studies alone: the id of the store and the lengths of its tiles.
    if "store_id" not in file_list:
        return True
    store_id, tile = file_list["store_id"], file_list.get("tile")
    return (
        isinstance(store_id, str)
        and isinstance(tile, dict)
        and all(type(length) is int and length > 0 for length in tile.values())
    )


def integrity_errors(path: Path, files: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield name and description of every file that differs from its fingerprint in `files`."""
    for name, expected in files.items():
        if reason := integrity_error(path, name, expected):
            yield name, reason


def list_errors(path: Path) -> Iterator[tuple[str, str]]:
    """Yield name and description of every damaged file of a store.

    The files are those in the list of the store, `vijax.json`. If the list itself is damaged, only the list is yielded,
    because it has the checksums of the others. In a store without a list, every unreadable file is yielded.
    """
    file_list = read(path)
    if file_list is not None:
        yield from integrity_errors(path, file_list["files"])
    elif os.path.lexists(path / LIST):
        yield LIST, integrity_error(path, LIST, None)
    else:
        yield from _unlisted_errors(path)


def _unlisted_errors(path: Path) -> Iterator[tuple[str, str]]:
    """Yield name and description of every unreadable file of a store without a list and so without checksums."""
    for name, entry in store_names.entries(path):
        # A pipe or device must not be read: that may never end.
        if not entry.is_dir(follow_symlinks=False) and not entry.is_file(follow_symlinks=False):
            yield name, "is no regular file"
    # Folders with chunks or with metadata of zarr format 2 must be arrays, even without metadata of their own.
    arrays = [file.parent.name for mark in ("c", ".zarray") for file in sorted(path.glob(f"*/{mark}"))]
    for array in dict.fromkeys([*store_names.layouts(path), *arrays]):
        name = f"{array}/{METADATA}"
        if not os.path.lexists(path / name):
            yield name, "is missing"
        elif store_names.content(path / name) is None:
            yield name, "cannot be read"


def had_list(path: Path) -> bool:
    """Return True if a store without a list once had one, so that the list was lost.

    The tile records of such a store name files. Earlier versions, which wrote no list, wrote records that name
    variables.
    """
    # Any one record decides, because one version of vijax wrote all records of a store.
    record = store_names.content(next((path / TILES).glob("[0-9]*.json"), path / TILES)) or {}
    return any("/" in name for name in record.get("files") or ())


def record_errors(path: Path) -> Iterator[tuple[str, str]]:
    """Yield name and description of every damaged file or record of completed tiles; nothing without a list."""
    # A store without a list is of an earlier version: its records have other names.
    for record in sorted((path / TILES).glob("[0-9]*.json")) if read(path) else ():
        content = store_names.content(record)
        if (
            content is None
            or not isinstance(content.get("files"), dict)
            or not all(map(store_names.is_name, content["files"]))
        ):
            yield record.relative_to(path).as_posix(), "cannot be read"
        else:
            yield from integrity_errors(path, content["files"])


def missing_chunks(path: Path, arrays: Mapping[str, ArrayLayout]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield the missing chunks of arrays of a store: name of the array and indices of the chunk."""
    present = {name for name, entry in store_names.entries(path) if entry.is_file(follow_symlinks=False)}
    for name, grid in arrays.items():
        for index in itertools.product(*map(range, grid.counts)):
            if "/".join([name, "c", *map(str, index)]) not in present:
                yield name, index


# --- files that belong to a store -------------------------------------------------------------------------------------


def is_study(path: Path) -> bool:
    """Return True if a store is written tile by tile, so that damaged tiles can be computed again."""
    return (path / TILES).is_dir() or "store_id" in (read(path) or {})


def is_store(path: Path) -> bool:
    """Return True if a folder is a store of vijax, of any version; it may be damaged."""
    if (path / LIST).is_file():
        return True
    attributes = (store_names.content(path / METADATA) or {}).get("attributes")
    return isinstance(attributes, dict) and str(attributes.get("source")).startswith("vijax ")


def names(path: Path) -> StoreNames:
    """Return the names that files of a store may have, from its list or, if the list is lost, from its metadata."""
    file_list = read(path)
    if file_list is None:
        return StoreNames(store_names.layouts(path), tiles=is_study(path))
    # Names without a slash are files of the group, not of an array.
    arrays = [array for array, slash, _ in (name.partition("/") for name in file_list["files"]) if slash]
    copies = {array: file_list["metadata"].get(f"{array}/{METADATA}", "") for array in arrays}
    return StoreNames(
        {array: store_names.layout(_parse_json(text)) for array, text in copies.items()}, "store_id" in file_list
    )


def _parse_json(text: str) -> Any:
    """Parse JSON text; None if it is invalid."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def partial_files(path: Path) -> list[Path]:
    """Return the temporary files of a store; a running process may still be writing some of them."""
    allowed = names(path)
    return [
        path / name
        for name, entry in store_names.entries(path)
        if store_names.final(name) != name and allowed.holds(name, entry)
    ]
