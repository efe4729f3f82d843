"""Where a store may be written, how it takes its place in one step, who is alone with one, what a killed run left.

A new store is written in a working folder beside its place, a part (`files.part_of`) that holds

    lock    locked as long as its writer lives
    new     the new store; once it has taken its place, the one that was there
    old     where the disk cannot exchange two names: the store that was there, for a moment

The new store is flushed to disk, then the two exchange their names, then the folder around them is flushed; the old
store is removed last. So there is a whole store at any time, and of two writers the last one wins.
"""

import errno
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from vijax.planes import inventory, store_names
from vijax.planes.store_names import LIST, METADATA, TILES
from vijax.runtime import checks
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
from vijax.runtime.pages import see

_LOG = logging.getLogger(__name__)
_LOCK, _NEW, _OLD = "lock", "new", "old"


def check_store(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Check that a new store can be written, and return its path; `name` is the argument that an error speaks of.

    Raises:
        ValueError: If it has another ending than stores have.
        FileExistsError: If it exists, and may not be replaced; what vijax did not write is never replaced.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = check_place(name, path)
    _check_free(name, target, overwrite)
    return target


def check_place(name: str, path: str | Path) -> Path:
    """Check that a store can have this name, and return its path; what a killed run left there is put right.

    Raises:
        ValueError, FileNotFoundError, PermissionError: As `check_store`.
    """
    check_ending(name, path, ".zarr")
    target = check_folder(name, path)
    recover(target)
    return target


def _check_free(name: str, target: Path, overwrite: bool) -> None:
    """Raise FileExistsError unless nothing is there, or a store that may be replaced and holds nothing foreign."""
    if not os.path.lexists(target):
        return
    if overwrite and target.is_dir() and (foreign := store_names.foreign(target, inventory.names(target))):
        raise FileExistsError(
            see(
                "studies",
                f"{name} must not replace what vijax did not write; got {checks.shown_path(target)}, which holds "
                f"{checks.shown_path(foreign)}; move it elsewhere, or take another name",
            )
        )
    _check_replaceable(name, target, overwrite)


def _check_replaceable(name: str, target: Path, overwrite: bool) -> None:
    """Raise FileExistsError unless a store may take the place of another."""
    shown = checks.shown_path(target)
    if not overwrite:
        raise FileExistsError(
            see("studies", f"{name} must not exist yet; got {shown}; allow overwriting, or take another name")
        )
    if not inventory.is_store(target):
        raise FileExistsError(
            see("studies", f"{name} must not replace what is no store of vijax; got {shown}; take another name")
        )


# --- who may write ---------------------------------------------------------------------------------------------------


def lock(path: Path) -> Path:
    """Name the file that the writer of a study locks; in it stands the birth of the store."""
    return path / TILES / "lock"


@contextmanager
def exclusive_writer(name: str, path: Path) -> Iterator[None]:
    """Be the only writer of a study; the lock ends with its process, however that ends. What is no study has no writer.

    Raises:
        BlockingIOError: If another run writes there.
        PermissionError: If it cannot be written.
        FileExistsError: If a folder of somebody else, or a link, stands in the way of the lock.
    """
    from filelock import FileLock, Timeout  # here, as importing vijax would take a twentieth longer

    if not inventory.is_study(path):
        yield
        return
    file, shown = lock(path), checks.shown_path(path)
    odd = inventory.fault(path, file.relative_to(path).as_posix(), None) in ("is missing", "is no regular file")
    try:
        if odd:
            file.unlink(missing_ok=True)
            file.parent.mkdir(parents=True, exist_ok=True)
        # No file that merely exists may stand in for the lock where the disk knows none: a killed run would leave it.
        own = FileLock(file, fallback_to_soft=False).acquire(blocking=False)
    except Timeout:
        raise BlockingIOError(
            see("studies", f"{name} must not be in use; got {shown}, which another run is writing")
        ) from None
    except OSError as error:
        raise PermissionError(f"{name} must be a store that can be written; got {shown} ({error.strerror})") from None
    with own:
        yield


# --- how it takes its place ------------------------------------------------------------------------------------------


@contextmanager
def replacing_store(name: str, path: Path, overwrite: bool) -> Iterator[Path]:
    """Give a path to write a new store to; when the block succeeds it is on disk, and then at its place.

    Args:
        name: Of the argument that an error speaks of.
        path: Where the store will be. A link goes on pointing where it does.
        overwrite: Whether it may take the place of another store, which is removed then.

    Raises:
        FileExistsError: If the place is taken when the new store is written.
    """
    target = Path(os.path.realpath(path))
    with ExitStack() as stack:
        folder = _working_folder(target, stack)
        try:
            yield folder / _NEW
            written = (folder / _NEW / one for one, _ in store_names.entries(folder / _NEW))
            # The working folder, too: a store that is put aside in it must be found again.
            flush([*written, folder / _NEW, folder, target.parent])
            _take_place(name, folder, target, overwrite)
        except BaseException:  # Ctrl-C too
            _clear(folder, target)
            raise
        # Where this fails the old store stays in the working folder, which the next call removes.
        flush([target.parent, folder])
        if foreign := _clear(folder, target):
            _LOG.warning("%s holds %s, which vijax did not write, and stays", checks.shown_path(folder), foreign)


def _working_folder(target: Path, stack: ExitStack) -> Path:
    """Make the folder in which a new store is written, locked until the stack ends."""
    while True:
        folder = part_of(target)
        make_folder(folder)
        with suppress(FileNotFoundError):
            if stack.enter_context(locked(folder / _LOCK)):
                return folder
        # Another process took it for a leftover before it was locked.


def _take_place(name: str, folder: Path, target: Path, overwrite: bool) -> None:
    """Give a new store its name; the store that has that name goes to the working folder."""
    new, old = folder / _NEW, folder / _OLD
    while True:
        with suppress(FileNotFoundError):  # another process has put the store there aside meanwhile
            if os.path.lexists(target):
                _check_replaceable(name, target, overwrite)
                if exchange(new, target):
                    return
                _remove(old)
                rename(target, old)
        try:
            rename(new, target)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # another process was faster
                raise


def flush_names(path: Path) -> None:
    """Flush the names of a store and of its files: an earlier run may have been killed before it did so.

    Contents need no flush, because files have their names only once their contents are on disk.
    """
    target = Path(os.path.realpath(path))
    folders = (target / name for name, entry in store_names.entries(target) if entry.is_dir(follow_symlinks=False))
    flush([target.parent, target, *folders])


def recover(path: Path) -> None:
    """Put back the store that a killed run had put aside and not replaced, and remove what it left; log both.

    What a living run writes stays, on whatever machine it runs, and so does what vijax did not write.
    """
    target = Path(os.path.realpath(path))
    for folder in parts_of(target):
        with suppress(OSError):  # another process puts it right, or may do so
            _recover(folder, target)


def _recover(folder: Path, target: Path) -> None:
    if not stat.S_ISDIR(os.lstat(folder).st_mode) or _foreign_file(folder):
        return
    with locked(folder / _LOCK) as own:
        if not own:
            return
        # The killed run may not have flushed the names that it changed. If a power cut took that change after what is
        # left was removed, no store would be there.
        flush([target.parent, folder])
        # An empty one is that of a living run, which makes or removes it.
        empty = not any(os.path.lexists(folder / one) for one in (_NEW, _OLD))
        missing = not os.path.lexists(target)
        _clear(folder, target)
    if missing and os.path.lexists(target):
        _LOG.warning("%s, which a killed run had put aside, is back", checks.shown_path(target.name))
    elif not empty:
        _LOG.warning("%s, which a killed run had left, is removed", checks.shown_path(folder.name))


def _clear(folder: Path, target: Path) -> str | None:
    """Remove a working folder, and put back what was put aside; return what is foreign, where that keeps it."""
    if (folder / _OLD).is_dir() and not os.path.lexists(target):
        rename(folder / _OLD, target)
        flush([target.parent, folder])
    if (foreign := _foreign_file(folder)) is None:
        for one in (_NEW, _OLD):
            _remove(folder / one)
        for path in (folder / _LOCK, folder):
            with suppress(OSError):
                remove(path)
    return foreign


def _foreign_file(folder: Path) -> str | None:
    """Find a file in a working folder that vijax did not write."""
    known = {one: inventory.names(folder / one) for one in (_NEW, _OLD)}
    for name, entry in store_names.entries(folder):
        if name == _LOCK or entry.is_dir(follow_symlinks=False):
            continue
        store, _, within = name.partition("/")
        if store not in known or not known[store].holds(within, entry):
            return name
    return None


def _remove(store: Path) -> None:
    """Remove a store that holds nothing foreign; its metadata last, by which the rest is known as a store's."""
    if not store.is_dir():
        return
    found = list(store_names.entries(store))
    folders = [name for name, entry in found if entry.is_dir(follow_symlinks=False)]
    files = [name for name, entry in found if not entry.is_dir(follow_symlinks=False)]
    files.sort(key=lambda name: (name == LIST, name.rpartition("/")[2] == METADATA))
    for name in (*files, *reversed(folders), ""):
        remove(store / name)
