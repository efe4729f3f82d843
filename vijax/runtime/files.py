"""Files that are whole or absent, and on disk once they have their name; what a killed run left; JSON.

A new file is written under a hidden name beside its place, its *part*, flushed to disk, and renamed; then its folder is
flushed. Parts have random names. The writer of a part locks it, so that no other process takes the part of a living
writer for a leftover. The lock (flock) ends with the process, holds between containers, and between machines where the
network file system has locks.

Everything that changes a store goes through `create`, `make_folder`, `flush`, `rename`, `exchange` and `remove`: a
test of power cuts records their calls and replays them.
"""

import ctypes
import errno
import json
import logging
import math
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from vijax.runtime import checks

if sys.platform != "win32":
    import fcntl

_LOG = logging.getLogger(__name__)
# Files that are flushed at once. Journals commit together what waits for them: 20 files take 3 ms, in turn 70 (ext4).
_FLUSHED_AT_ONCE = 16
# Errors of a disk that has no locks, or cannot flush a folder or exchange two names.
_UNSUPPORTED = {errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_AT_WORKING_FOLDER, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux

TOKEN = "[0-9a-f]{16}"
"""What makes the name of a part its own, as a regular expression."""


def check_ending(name: str, path: str | Path, ending: str) -> None:
    """Raise ValueError unless a path ends so; `name` is the argument that an error speaks of."""
    if checks.path(name, path).suffix != ending:
        raise ValueError(f"{name} must end in {ending}; got {checks.shown(str(path))}")


def check_output(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Check that a file can be written, and return its path; `name` is the argument that an error speaks of.

    Parts that killed runs left beside it are removed.

    Raises:
        FileExistsError: If it exists and may not be replaced; a folder is never replaced.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = check_folder(name, path)
    _clear(target)
    if os.path.lexists(target):
        shown = checks.shown_path(path)
        if not overwrite:
            raise FileExistsError(f"{name} must not exist yet; got {shown}; allow overwriting, or take another name")
        if target.is_dir():
            raise FileExistsError(f"{name} must not replace a folder; got {shown}; take another name")
    return target


def check_folder(name: str, path: str | Path) -> Path:
    """Check that a name can be given to something new, and return its path.

    Raises:
        FileNotFoundError, PermissionError: If its folder is missing or closed, or it is a link that leads to itself.
    """
    target, shown = checks.path(name, path), checks.shown_path(path)
    folder = target.absolute().parent
    if not target.name:
        raise FileNotFoundError(f"{name} must name a file; got {str(path)!r}")
    if not folder.is_dir():
        file = next((one for one in (folder, *folder.parents) if one.exists() and not one.is_dir()), None)
        there = checks.shown_path(folder if file is None else file)
        advice = f"make {there} first" if file is None else f"{there} is no folder, take another place"
        raise FileNotFoundError(f"{name} must lie in a folder that exists; got {shown}; {advice}")
    if os.path.islink(os.path.realpath(target)):
        raise FileNotFoundError(f"{name} must not be a link that leads to itself; got {shown}; take another name")
    try:
        # Leaves no name behind. To ask for permission is not enough: all is allowed to root, and nothing in /proc.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise PermissionError(f"{name} must lie in a folder that can be written; got {shown} ({reason})") from None
    return target


# --- changes of the disk ---------------------------------------------------------------------------------------------


def create(file: Path, content: bytes) -> None:
    """Write a file that nobody else knows yet; until it is flushed, a power cut may take it, or a part of it."""
    file.write_bytes(content)


def make_folder(folder: Path) -> None:
    """Make a folder; another process may have made it."""
    with suppress(FileExistsError):
        os.mkdir(folder)


def make_folders(within: Path, paths: Iterable[Path]) -> list[Path]:
    """Make the folders of files that lie in a folder, where they are missing; return those that were missing."""
    above = (within / folder for path in paths for folder in reversed(path.relative_to(within).parents) if folder.name)
    missing = [folder for folder in dict.fromkeys(above) if not folder.is_dir()]
    for folder in missing:
        make_folder(folder)
    return missing


def flush(paths: Iterable[Path]) -> None:
    """Flush contents of files, and names in folders, to disk; they survive a power cut when this returns."""
    distinct = list(dict.fromkeys(paths))
    if len(distinct) < 2:
        for path in distinct:
            _flush(path)
        return
    with ThreadPoolExecutor(min(len(distinct), _FLUSHED_AT_ONCE)) as pool:
        list(pool.map(_flush, distinct))


def _flush(path: Path) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder that may be written but not read
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(descriptor)


def rename(source: Path, target: Path) -> None:
    """Rename a file, which replaces another; or a folder, which replaces none that holds anything."""
    os.rename(source, target)


def exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step; return False where the system, or the disk, cannot."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if call is None:
        return False
    here, names = ctypes.c_int(_AT_WORKING_FOLDER), [ctypes.c_char_p(os.fsencode(path)) for path in (one, other)]
    if call(here, names[0], here, names[1], ctypes.c_uint(_EXCHANGE)) == 0:
        return True
    if (number := ctypes.get_errno()) in _UNSUPPORTED:
        return False
    raise OSError(number, os.strerror(number), str(other))


def remove(path: Path) -> None:
    """Remove a file, a link (not its target), or an empty folder."""
    if stat.S_ISDIR(os.lstat(path).st_mode):
        os.rmdir(path)
    else:
        os.unlink(path)


# --- parts -----------------------------------------------------------------------------------------------------------


def part_of(path: Path) -> Path:
    """Return a new name for the part of a file or folder."""
    return path.with_name(f".{path.stem}.{secrets.token_hex(8)}.part{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """Find the parts of a file or folder, whoever writes them or left them."""
    if not os.access(path.parent, os.R_OK):
        return []
    name = re.compile(rf"\.{re.escape(path.stem)}\.{TOKEN}\.part{re.escape(path.suffix)}")
    return sorted(file for file in path.parent.iterdir() if name.fullmatch(file.name))


@contextmanager
def locked(file: Path) -> Iterator[bool]:
    """Lock a file, made if it is missing, while the block runs; give False where somebody else has locked it.

    Where the disk has no locks nothing is locked, and the file passes for new or for locked by another.
    """
    new = False
    with suppress(FileExistsError):
        os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666))
        new = True
    try:
        descriptor = os.open(file, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:  # whoever had it has removed it since
        yield False
        return
    try:
        yield _lock(descriptor, new) and _has_name(descriptor, file)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, new: bool) -> bool:
    if sys.platform == "win32":
        return new
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        return new
    return True


def _has_name(descriptor: int, file: Path) -> bool:
    """Return True if an open file still has its name: another process may have removed it before it was locked."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(file))
    except FileNotFoundError:
        return False


@contextmanager
def _own_part(path: Path) -> Iterator[Path]:
    """Give a new empty file beside a path, locked; it is removed at the end unless it was renamed."""
    with ExitStack() as stack:
        part = part_of(path)
        while not stack.enter_context(locked(part)):  # another process took it for a leftover before it was locked
            part = part_of(path)
        try:
            yield part
        finally:
            with suppress(FileNotFoundError):
                remove(part)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a part to write; it becomes the file, on disk, when the block succeeds and is removed when it does not."""
    with _own_part(path) as part:
        yield part
        flush([part])
        rename(part, path)
        flush([path.parent])


def replace_files(*stages: Mapping[Path, bytes], within: Path | None = None) -> None:
    """Write files, each whole or not at all; all are on disk when this returns.

    Args:
        stages: Contents by path. Files of a stage have their names only once those of the stages before are on disk.
        within: Folder in which the folders of the files are made where they are missing.
    """
    with ExitStack() as stack:
        paths = [path for files in stages for path in files]
        made = [] if within is None else make_folders(within, paths)
        parts = {path: stack.enter_context(_own_part(path)) for path in paths}
        for files in stages:
            for path, content in files.items():
                create(parts[path], content)
        flush([*parts.values(), *(folder.parent for folder in made)])
        for files in stages:
            for path in files:
                rename(parts[path], path)
            flush(path.parent for path in files)


def _clear(path: Path) -> None:
    """Remove the parts of a file that killed runs left, with a warning for each."""
    for part in parts_of(path):
        if remove_part(part):
            _LOG.warning("%s, which a killed run had left, is removed", checks.shown_path(part.name))


def remove_part(part: Path) -> bool:
    """Remove a part whose writer lives no more; return True if it was removed."""
    try:
        if not stat.S_ISREG(os.lstat(part).st_mode):
            return False
        with locked(part) as alone:
            if alone:
                remove(part)
            return alone
    except OSError:  # what cannot be removed is in nobody's way
        return False


# --- JSON ------------------------------------------------------------------------------------------------------------


def json_bytes(report: Any) -> bytes:
    """Encode nested dicts, sequences, arrays and numbers as strict JSON; numbers that are not finite become null."""
    return (json.dumps(_plain(report), indent=1, allow_nan=False) + "\n").encode()


def write_json(report: Any, path: Path) -> None:
    """Write a report as `json_bytes` encodes it, whole or not at all."""
    replace_files({path: json_bytes(report)})


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if hasattr(value, "__array__"):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
