"""Files that are complete or absent, and on disk once they have their name; leftovers of killed runs; JSON.

A new file is written under a hidden name beside its target, its *part*, flushed to disk, and renamed; then its folder
is flushed. Parts have random names. The writer of a part locks it, so that no other process mistakes the part of a
running writer for a leftover. The lock (flock) ends with the process. It is effective between containers, and between
machines if the network file system supports locks.

All changes of a store use `create`, `make_folder`, `flush`, `rename`, `exchange` and `remove`: a test of power cuts
records the calls of these functions and replays them.
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

from vijax.runtime import validation

if sys.platform != "win32":
    import fcntl

_LOG = logging.getLogger(__name__)
# Files flushed concurrently. File systems with journals commit waiting flushes together: 20 files take 3 ms, one after
# another 70 ms (ext4).
_FLUSHED_AT_ONCE = 16
# Errors of file systems that have no locks, or cannot flush a folder or exchange two names.
_UNSUPPORTED = {errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_AT_WORKING_FOLDER, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux

TOKEN = "[0-9a-f]{16}"
"""Random token in the name of a part, as a regular expression."""


def check_ending(name: str, path: str | Path, ending: str) -> None:
    """Raise ValueError unless a path has the given ending; `name` is the argument named in the error."""
    if validation.validate_path(name, path).suffix != ending:
        raise ValueError(f"{name} must end in {ending}; got {validation.value_text(str(path))}")


def check_output(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Check that a file can be written, and return its path; `name` is the argument named in the error.

    Parts (unfinished files) that killed runs left in the folder under this name are removed.

    Raises:
        FileExistsError: If the file exists and may not be replaced; a folder is never replaced.
        FileNotFoundError, PermissionError: If the folder of the file is missing or not accessible.
    """
    target = check_folder(name, path)
    _clear(target)
    if os.path.lexists(target):
        path_text = validation.path_text(path)
        if not overwrite:
            raise FileExistsError(
                f"{name} must not exist yet; got {path_text}; allow overwriting, or take another name"
            )
        if target.is_dir():
            raise FileExistsError(f"{name} must not replace a folder; got {path_text}; take another name")
    return target


def check_folder(name: str, path: str | Path) -> Path:
    """Check that a new file or folder can have this path, and return the path.

    Raises:
        FileNotFoundError, PermissionError: If the folder of the path is missing or not accessible, or if the path is a
            link to itself.
    """
    target, path_text = validation.validate_path(name, path), validation.path_text(path)
    folder = target.absolute().parent
    if not target.name:
        raise FileNotFoundError(f"{name} must name a file; got {str(path)!r}")
    if not folder.is_dir():
        file = next(
            (ancestor for ancestor in (folder, *folder.parents) if ancestor.exists() and not ancestor.is_dir()), None
        )
        blocking = validation.path_text(folder if file is None else file)
        advice = f"make {blocking} first" if file is None else f"{blocking} is no folder, take another place"
        raise FileNotFoundError(f"{name} must lie in a folder that exists; got {path_text}; {advice}")
    if os.path.islink(os.path.realpath(target)):
        raise FileNotFoundError(f"{name} must not be a link that leads to itself; got {path_text}; take another name")
    try:
        # A temporary file leaves no name. Permission bits are not sufficient: root has every permission, and no file
        # can be made in /proc.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise PermissionError(f"{name} must lie in a folder that can be written; got {path_text} ({reason})") from None
    return target


# --- changes of the disk ---------------------------------------------------------------------------------------------


def create(file: Path, content: bytes) -> None:
    """Write a file under a name that no other process uses; a power cut before `flush` may lose all or part of it."""
    file.write_bytes(content)


def make_folder(folder: Path) -> None:
    """Make a folder; another process may have made it."""
    with suppress(FileExistsError):
        os.mkdir(folder)


def make_folders(within: Path, paths: Iterable[Path]) -> list[Path]:
    """Make the missing folders of files within a folder; return the folders that were missing."""
    above = (within / folder for path in paths for folder in reversed(path.relative_to(within).parents) if folder.name)
    missing = [folder for folder in dict.fromkeys(above) if not folder.is_dir()]
    for folder in missing:
        make_folder(folder)
    return missing


def flush(paths: Iterable[Path]) -> None:
    """Flush the contents of files, and the names in folders, to disk; they survive a power cut when this returns."""
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
    except PermissionError:  # a folder with write but no read permission
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(descriptor)


def rename(source: Path, target: Path) -> None:
    """Rename a file, which replaces an existing one, or a folder, which replaces only an empty one."""
    os.rename(source, target)


def exchange(first: Path, second: Path) -> bool:
    """Exchange two names in one step; return False if the system or the file system does not support it."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if call is None:
        return False
    here, names = ctypes.c_int(_AT_WORKING_FOLDER), [ctypes.c_char_p(os.fsencode(path)) for path in (first, second)]
    # renameat2 of Linux: atomic, so that at any time both names exist.
    if call(here, names[0], here, names[1], ctypes.c_uint(_EXCHANGE)) == 0:
        return True
    if (number := ctypes.get_errno()) in _UNSUPPORTED:
        return False
    raise OSError(number, os.strerror(number), str(second))


def remove(path: Path) -> None:
    """Remove a file, a link (not its target), or an empty folder."""
    if stat.S_ISDIR(os.lstat(path).st_mode):
        os.rmdir(path)
    else:
        os.unlink(path)


# --- parts -----------------------------------------------------------------------------------------------------------


def part_of(path: Path) -> Path:
    """Return a new random name for a part: the hidden file or folder that is written before it replaces `path`."""
    return path.with_name(f".{path.stem}.{secrets.token_hex(8)}.part{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """Return the existing parts of a file or folder, of running writers and of killed ones."""
    if not os.access(path.parent, os.R_OK):
        return []
    name = re.compile(rf"\.{re.escape(path.stem)}\.{TOKEN}\.part{re.escape(path.suffix)}")
    return sorted(file for file in path.parent.iterdir() if name.fullmatch(file.name))


@contextmanager
def locked(file: Path) -> Iterator[bool]:
    """Lock a file while the block runs, and create it if it is missing; yield False if another process has locked it.

    On a file system without locks nothing is locked; the yielded value is then True only if this call created the file.
    """
    new = False
    with suppress(FileExistsError):
        # O_EXCL: exactly one process creates the file and obtains `new`.
        os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666))
        new = True
    try:
        # Neither follow a link nor block on a pipe.
        descriptor = os.open(file, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:  # the process that had locked the file has removed it in the meantime
        yield False
        return
    try:
        # Another process may have removed the file between open and lock; the lock then has no effect.
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
def _locked_part(path: Path) -> Iterator[Path]:
    """Yield a new empty file beside a path, locked; it is removed at the end unless it was renamed."""
    with ExitStack() as stack:
        part = part_of(path)
        while not stack.enter_context(locked(part)):  # another process removed it as a leftover before it was locked
            part = part_of(path)
        try:
            yield part
        finally:
            with suppress(FileNotFoundError):
                remove(part)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a part to write; if the block succeeds, the part replaces the file at `path`, else the part is removed."""
    with _locked_part(path) as part:
        yield part
        # Flush the content before the name: after a power cut the file is the old or the new one, never a mixture.
        flush([part])
        rename(part, path)
        flush([path.parent])


def replace_files(*stages: Mapping[Path, bytes], within: Path | None = None) -> None:
    """Write files, each completely or not at all; all are on disk when this returns.

    Args:
        stages: Contents by path. The files of a stage get their names once the files of all earlier stages are on disk.
        within: Folder that contains all files; missing folders inside it are made. None if all folders exist.
    """
    with ExitStack() as stack:
        paths = [path for files in stages for path in files]
        made = [] if within is None else make_folders(within, paths)
        parts = {path: stack.enter_context(_locked_part(path)) for path in paths}
        for files in stages:
            for path, content in files.items():
                create(parts[path], content)
        # All contents and new folders are on disk before the first rename.
        flush([*parts.values(), *(folder.parent for folder in made)])
        for files in stages:
            for path in files:
                # A stage's names are on disk before the next stage starts.
                rename(parts[path], path)
            flush(path.parent for path in files)


def _clear(path: Path) -> None:
    """Remove the parts that killed runs left of a file, with a warning for each."""
    for part in parts_of(path):
        if remove_part(part):
            _LOG.warning("removed %s, left by a killed run", validation.path_text(part.name))


def remove_part(part: Path) -> bool:
    """Remove a part if its writer has ended; return True if it was removed."""
    try:
        if not stat.S_ISREG(os.lstat(part).st_mode):
            return False
        with locked(part) as is_locked:
            if is_locked:
                remove(part)
            return is_locked
    except OSError:  # a leftover that cannot be removed does no harm
        return False


# --- JSON ------------------------------------------------------------------------------------------------------------


def json_bytes(report: Any) -> bytes:
    """Encode nested dicts, sequences, arrays and numbers as strict JSON; numbers that are not finite become null."""
    return (json.dumps(_plain(report), indent=1, allow_nan=False) + "\n").encode()


def write_json(report: Any, path: Path) -> None:
    """Write a report as `json_bytes` encodes it, completely or not at all."""
    replace_files({path: json_bytes(report)})


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "__array__"):
        # Arrays and scalars of NumPy and JAX.
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
