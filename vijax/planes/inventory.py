"""What vijax wrote into a store, file by file: what is no longer as it was written, what is not vijax's at all.

A store lists its files with their lengths and checksums in `vijax.json`, as it is made: of a saved map all of them, of
a study metadata and coordinates. A tile of a study has a list of its own, its record, beside the chunks of `status`,
where no reader of zarr looks. Stores of earlier versions have no `vijax.json`.
"""

import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vijax.runtime.files import write_json
from vijax.runtime.pages import see

LIST = "vijax.json"
TILES = Path("status", "tiles")
# Bytes of the longest list that is read: that of a map in ten million files.
_LONGEST = 1 << 30
# The name that `files.beside` gives to a file that is being written.
_PART = re.compile(r"\.(\w+)\.\d+\.part(\.json)?")


def fingerprint(content: bytes) -> str:
    """Tell length and checksum of a file."""
    return f"{len(content)} bytes, CRC-32 {zlib.crc32(content):08x}"


def fault(file: Path, expected: str | None) -> str:
    """Say what is wrong with a file that had this fingerprint when it was written; nothing if it still has.

    Raises:
        FileExistsError: If a folder or a file stands in its way, which may be somebody's.
    """
    if file.is_dir():
        raise FileExistsError(
            see("studies", f"{file} must be a file that vijax wrote; got a folder; remove it, or take another store")
        )
    if not file.exists():
        _check_way(file)
        return "is missing"
    if not file.is_file():
        return "is no regular file"  # It must not be read: a pipe would take for ever.
    if not str(expected).startswith(f"{file.stat().st_size} bytes"):
        return "is not what was written"
    try:
        content = file.read_bytes()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if fingerprint(content) == expected else "is not what was written"


def _check_way(file: Path) -> None:
    """Raise unless a file could be made."""
    above = next(folder for folder in file.parents if folder.exists())
    if not above.is_dir():
        raise FileExistsError(
            see("studies", f"{above} must be a folder of a store; got a file; remove it, or take another store")
        )


def content(file: Path) -> dict[str, Any] | None:
    """Read the JSON object in a file; None if there is none, or what takes too long to read."""
    try:
        if not file.is_file() or file.stat().st_size > _LONGEST:
            return None
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def write(path: Path, **facts: Any) -> None:
    """List all files of a new store, with copies of those of metadata, and facts about it."""
    files = {_name(path, file): file for file in sorted(path.rglob("*")) if file.is_file()}
    metadata = {name: file.read_text(encoding="utf-8") for name, file in files.items() if file.name == "zarr.json"}
    fingerprints = {name: fingerprint(file.read_bytes()) for name, file in files.items()}
    listed = {**facts, "files": fingerprints, "metadata": metadata}
    write_json({**listed, "checksum": _own(listed)}, path / LIST)


def read(path: Path) -> dict[str, Any] | None:
    """Read the list of a store, if there is one that is as it was written."""
    listed = content(path / LIST)
    if listed is None or listed.pop("checksum", None) != _own(listed):
        return None
    return listed


def _own(listed: Mapping[str, Any]) -> str:
    return fingerprint(json.dumps(listed, sort_keys=True).encode())


def faults(path: Path, files: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files of a list: names and reasons."""
    for name, expected in files.items():
        if reason := fault(path / name, expected):
            yield name, reason


def listed(path: Path) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files that the list of a store names, or with that list."""
    found = read(path)
    if found is not None:
        yield from faults(path, found["files"])
    elif os.path.lexists(path / LIST):
        yield LIST, fault(path / LIST, None)
    else:
        # There is nothing to compare with, but to read a pipe would take for ever.
        odd = (file for file in path.rglob("*") if file.exists() and not file.is_dir() and not file.is_file())
        yield from ((_name(path, file), "is no regular file") for file in odd)
        unread = (file for file in path.glob("*/zarr.json") if content(file) is None)
        yield from ((_name(path, file), "cannot be read") for file in unread)


def had_list(path: Path) -> bool:
    """Tell whether a store without a list had one: if so, its records name files, and not variables."""
    record = content(next((path / TILES).glob("[0-9]*.json"), path / TILES)) or {}
    return any("/" in name for name in record.get("files") or ())


def records(path: Path) -> Iterator[tuple[str, str]]:
    """Find what is wrong with the files of the tiles that are done, and with their records; nothing without a list."""
    for record in sorted((path / TILES).glob("[0-9]*.json")) if read(path) else ():
        found = content(record)
        if found is None or not isinstance(found.get("files"), dict):
            yield _name(path, record), "cannot be read"
        else:
            yield from faults(path, found["files"])


def is_study(path: Path) -> bool:
    """Tell whether the files of a store are made tile by tile, so that what is damaged is made again."""
    return (path / TILES).is_dir() or "birth" in (read(path) or {})


# --- what is vijax's -------------------------------------------------------------------------------------------------


def is_store(path: Path) -> bool:
    """Tell whether a folder is a store of vijax, of an earlier version too; it may be damaged."""
    if (path / LIST).is_file():
        return True
    attributes = (content(path / "zarr.json") or {}).get("attributes")
    return isinstance(attributes, dict) and str(attributes.get("source")).startswith("vijax ")


def foreign(path: Path) -> str | None:
    """Find a file in a store that vijax did not write."""
    listed = read(path)
    # Where the list is lost or was never written, every array passes for one of vijax's.
    arrays = None if listed is None else {name.partition("/")[0] for name in listed["files"]}
    names = (_name(path, file) for file in path.rglob("*") if file.is_symlink() or not file.is_dir())
    return next((name for name in names if not _ours(name, arrays)), None)


def half_written(path: Path) -> list[Path]:
    """Find what killed processes were at, inside a store."""
    found = [file for file in path.rglob(".*.part*") if file.is_file() and not file.is_symlink()]
    return [file for file in found if _PART.fullmatch(file.name) and _ours(_name(path, file), None)]


def _ours(name: str, arrays: set[str] | None) -> bool:
    """Tell whether vijax gives such names to files of a store with these arrays; with any if None."""
    folder, _, last = name.rpartition("/")
    if part := _PART.fullmatch(last):
        last = part[1] + (part[2] or "")
    if not folder:
        return last in ("zarr.json", LIST)
    if folder == TILES.as_posix():
        return last == "lock" or bool(re.fullmatch(r"\d+\.json", last))
    array, *chunk = (*folder.split("/"), last)
    known = arrays is None or array in arrays
    return known and (chunk == ["zarr.json"] or (chunk[0] == "c" and all(map(str.isdecimal, chunk[1:]))))


def _name(path: Path, file: Path) -> str:
    return file.relative_to(path).as_posix()
