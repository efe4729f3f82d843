"""Place of a store: validation, atomic replacement, the lock of its writer, and recovery after a killed run.

A new store is written in a working folder next to its final path, a part (`files.part_of`) that contains

    lock    locked as long as its writer lives
    new     the new store; after it has taken its place, the previous one
    old     if the disk cannot exchange two names: the previous store, for a moment

The new store is flushed to disk, then it exchanges names with the previous store, then the parent folder is flushed;
the previous store is removed last. So there is a complete store at any time, and of two writers the last one wins.
"""

import errno
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from vijax.maps.storage import store_inventory, store_names
from vijax.maps.storage.store_names import LIST, METADATA, TILES
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import (
    check_ending,
    check_folder,
    exchange,
    flush,
    locked,
    make_folder,
    part_of,
    parts_of,
    remove,
    rename,
)

_LOG = logging.getLogger(__name__)
_LOCK, _NEW, _OLD = "lock", "new", "old"


def validate_new_store_path(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Return the path of a new store after a check that it can be written; `name` is the argument that errors name.

    Raises:
        ValueError: If it does not end in .zarr.
        FileExistsError: If it exists and may not be replaced; files that vijax did not write are never replaced.
        FileNotFoundError, PermissionError: If its parent folder is missing or not writable.
    """
    target = validate_store_path(name, path)
    _check_free(name, target, overwrite)
    return target


def validate_store_path(name: str, path: str | Path) -> Path:
    """Return the path of a store after a check of its name and parent folder, and recovery after a killed run.

    Raises:
        ValueError, FileNotFoundError, PermissionError: As `validate_new_store_path`.
    """
    check_ending(name, path, ".zarr")
    target = check_folder(name, path)
    recover(target)
    return target


def _check_free(name: str, target: Path, overwrite: bool) -> None:
    """Raise FileExistsError unless the path is free, or holds a replaceable store without foreign files."""
    if not os.path.lexists(target):
        return
    if overwrite and target.is_dir() and (foreign := store_names.foreign(target, store_inventory.names(target))):
        raise FileExistsError(
            see(
                "studies",
                f"{name} must not replace what vijax did not write; got {validation.path_text(target)}, which holds "
                f"{validation.path_text(foreign)}; move it elsewhere, or take another name",
            )
        )
    _check_replaceable(name, target, overwrite)


def _check_replaceable(name: str, target: Path, overwrite: bool) -> None:
    """Raise FileExistsError unless the existing path is a store, and may be overwritten."""
    path_text = validation.path_text(target)
    if not overwrite:
        raise FileExistsError(
            see("studies", f"{name} must not exist yet; got {path_text}; allow overwriting, or take another name")
        )
    if not store_inventory.is_store(target):
        raise FileExistsError(
            see("studies", f"{name} must not replace what is no store of vijax; got {path_text}; take another name")
        )


# --- who may write ---------------------------------------------------------------------------------------------------


def lock(path: Path) -> Path:
    """Return the path of the file that the writer of a study locks; its content is the id of the store."""
    return path / TILES / "lock"


@contextmanager
def exclusive_writer(name: str, path: Path) -> Iterator[None]:
    """Lock a study for this process alone; the lock also ends if the process is killed.

    A store that is no study (not written tile by tile) is complete and is not locked.

    Raises:
        BlockingIOError: If another run is writing the store.
        PermissionError: If it cannot be written.
        FileExistsError: If a foreign folder, or a link, blocks the path of the lock.
    """
    from filelock import FileLock, Timeout  # here, as importing vijax would take a twentieth longer

    if not store_inventory.is_study(path):
        yield
        return
    file, path_text = lock(path), validation.path_text(path)
    unusable = store_inventory.integrity_error(path, file.relative_to(path).as_posix(), None) in (
        "is missing",
        "is no regular file",
    )
    try:
        if unusable:
            # If the lock file is missing or is no regular file, it is created anew. Its content, the id of the store,
            # is restored later from the list of files, `vijax.json`.
            file.unlink(missing_ok=True)
            file.parent.mkdir(parents=True, exist_ok=True)
        # fallback_to_soft=False, because on a disk without file locks the mere existence of the file would count as the
        # lock, and would remain after a killed run.
        file_lock = FileLock(file, fallback_to_soft=False).acquire(blocking=False)
    except Timeout:
        raise BlockingIOError(
            see("studies", f"{name} must not be in use; got {path_text}, which another run is writing")
        ) from None
    except OSError as error:
        raise PermissionError(
            f"{name} must be a store that can be written; got {path_text} ({error.strerror})"
        ) from None
    with file_lock:
        yield


# --- atomic replacement ----------------------------------------------------------------------------------------------


@contextmanager
def replacing_store(name: str, path: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a path to write a new store to; if the block succeeds, the store is flushed and moved to its place.

    Args:
        name: Argument that errors name.
        path: Final path of the store. If it is a link, the link stays, and the store that it points to is replaced.
        overwrite: Whether to replace another store, which is then removed.

    Raises:
        FileExistsError: If, once the new store is written, the path holds something that may not be replaced.
    """
    target = Path(os.path.realpath(path))
    # The lock of the working folder ends with the stack, after the folder is removed.
    with ExitStack() as stack:
        folder = _working_folder(target, stack)
        try:
            yield folder / _NEW
            written = (folder / _NEW / file_name for file_name, _ in store_names.entries(folder / _NEW))
            # The working folder is flushed too: recovery must find a store that was moved into it.
            flush([*written, folder / _NEW, folder, target.parent])
            _take_place(name, folder, target, overwrite)
        except BaseException:  # also on Ctrl-C
            _clear(folder, target)
            raise
        # If this flush fails, the previous store stays in the working folder, and the next call removes it.
        flush([target.parent, folder])
        if foreign := _clear(folder, target):
            _LOG.warning("%s holds %s, which vijax did not write, and stays", validation.path_text(folder), foreign)


def _working_folder(target: Path, stack: ExitStack) -> Path:
    """Return a new working folder for a store, locked until the stack ends."""
    while True:
        folder = part_of(target)
        make_folder(folder)
        with suppress(FileNotFoundError):
            if stack.enter_context(locked(folder / _LOCK)):
                return folder
        # Another process removed it as a remnant before it was locked: try again.


def _take_place(name: str, folder: Path, target: Path, overwrite: bool) -> None:
    """Move a new store to its place; an existing store moves to the working folder."""
    new, old = folder / _NEW, folder / _OLD
    while True:
        with suppress(FileNotFoundError):  # another process moved the store away meanwhile
            if os.path.lexists(target):
                _check_replaceable(name, target, overwrite)
                # One atomic step where the system and the disk support it; otherwise two renames. If the run is killed
                # between them, `recover` restores the previous store.
                if exchange(new, target):
                    return
                _remove(old)
                rename(target, old)
        try:
            rename(new, target)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # another process took the place first: try again
                raise


def flush_names(path: Path) -> None:
    """Flush the names of a store and of its files, because an earlier run may have been killed before it flushed.

    Contents need no flush: files get their names only after their contents are on disk.
    """
    target = Path(os.path.realpath(path))
    folders = (target / name for name, entry in store_names.entries(target) if entry.is_dir(follow_symlinks=False))
    flush([target.parent, target, *folders])


def recover(path: Path) -> None:
    """Restore a store that a killed run moved away and did not replace; remove the files that the run left; log both.

    Files of a running writer, on any machine, and files that vijax did not write are left alone.
    """
    target = Path(os.path.realpath(path))
    for folder in parts_of(target):
        with suppress(OSError):  # another process recovers it, or can do so
            _recover(folder, target)


def _recover(folder: Path, target: Path) -> None:
    """Recover the store `target` from one working folder, unless its writer lives or it holds foreign files."""
    if not stat.S_ISDIR(os.lstat(folder).st_mode) or _foreign_file(folder):
        return
    # A working folder with a living writer is locked, also by a writer on another machine.
    with locked(folder / _LOCK) as locked_here:
        if not locked_here:
            return
        # The killed run may have renamed stores without flushing the new names. If the remains were removed before that
        # flush and a power cut undid the renames, no store would be left.
        flush([target.parent, folder])
        # An empty folder belongs to a running writer that is about to fill or remove it.
        empty = not any(os.path.lexists(folder / name) for name in (_NEW, _OLD))
        missing = not os.path.lexists(target)
        _clear(folder, target)
    if missing and os.path.lexists(target):
        _LOG.warning("restored %s, which a killed run had moved away", validation.path_text(target.name))
    elif not empty:
        _LOG.warning("removed %s, left by a killed run", validation.path_text(folder.name))


def _clear(folder: Path, target: Path) -> str | None:
    """Restore a store that was moved away; remove the working folder, or return a foreign file that prevents this."""
    # If the target is missing, the run was killed between two renames, and `old` is the only complete store.
    if (folder / _OLD).is_dir() and not os.path.lexists(target):
        rename(folder / _OLD, target)
        flush([target.parent, folder])
    if (foreign := _foreign_file(folder)) is None:
        for name in (_NEW, _OLD):
            _remove(folder / name)
        for path in (folder / _LOCK, folder):
            with suppress(OSError):
                remove(path)
    return foreign


def _foreign_file(folder: Path) -> str | None:
    """Return the name of a file in a working folder that vijax did not write; None without one."""
    names_of = {folder_name: store_inventory.names(folder / folder_name) for folder_name in (_NEW, _OLD)}
    for name, entry in store_names.entries(folder):
        if name == _LOCK or entry.is_dir(follow_symlinks=False):
            continue
        store, _, within = name.partition("/")
        if store not in names_of or not names_of[store].holds(within, entry):
            return name
    return None


def _remove(store: Path) -> None:
    """Remove a store without foreign files, its metadata last, because they identify the remaining files as a store."""
    if not store.is_dir():
        return
    entries = list(store_names.entries(store))
    folders = [name for name, entry in entries if entry.is_dir(follow_symlinks=False)]
    files = [name for name, entry in entries if not entry.is_dir(follow_symlinks=False)]
    files.sort(key=lambda name: (name == LIST, name.rpartition("/")[2] == METADATA))
    # Files first, then folders from the innermost to the store itself, which has the empty name.
    for name in (*files, *reversed(folders), ""):
        remove(store / name)
