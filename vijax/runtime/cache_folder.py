"""The folder in which traced and compiled programs are kept between processes, and what makes it trusted.

Settings of JAX win: a folder given by `jax_compilation_cache_dir` (or JAX_COMPILATION_CACHE_DIR) replaces the folder in
the user's cache, and with `jax_enable_compilation_cache` off nothing is kept.

A program that is read is run. A folder or a file is therefore trusted only if this user or root owns it and nobody else
can write to it.
"""

import logging
import os
import re
import stat
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

_LOG = logging.getLogger(__name__)

MOST_BYTES = 2 * 1024**3  # a plane's program takes some two megabytes, with its traced form
TRACED = "traced-"
# Files of JAX are MODULE-DIGEST-cache and MODULE-DIGEST-atime; a traced program is traced-DIGEST, with a dot and more
# while it is written.
_PROGRAM = re.compile(rf".+-[0-9a-f]{{64}}-(cache|atime)|\.?{TRACED}[0-9a-f]{{64}}(\..+)?")
_OTHERS_WRITE = 0o022
_OTHERS_ENTER = 0o011


@cache
def keep_programs() -> None:
    """Keep programs in the user's folder from now on, unless a setting of JAX names a folder, or keeps none.

    JAX knows one folder: other programs of this process are kept there too. None are kept if the folder cannot be made
    or is not trusted. The folder is cut to `MOST_BYTES` here, once a process.
    """
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] or not settings["jax_enable_compilation_cache"]:
        return
    folder = _folder()
    if folder is None or not is_trusted(folder):
        return
    programs = _programs(folder)
    distrusted = next((path for path, about in programs if not _is_trusted_file(about, folder)), None)
    if distrusted is not None:
        _LOG.warning(
            "%s must hold regular files that this user owns and nobody else can write; got %s; no programs are kept: "
            "remove it",
            folder,
            distrusted.name,
        )
        return
    trim(folder, MOST_BYTES)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By itself JAX keeps what took a second; of the many small programs of an orbit or a flight none does.
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # A program may have compiled before, and JAX have found that there is no folder.
    compilation_cache.reset_cache()


def kept() -> Path | None:
    """Return the folder in which JAX keeps compiled programs; None if it keeps none, not on a disk, or not trusted."""
    settings = jax.config.values
    folder = settings["jax_compilation_cache_dir"] if settings["jax_enable_compilation_cache"] else None
    return Path(folder) if folder and "://" not in folder and _is_usable(folder) else None


@lru_cache(maxsize=32)
def _is_usable(folder: str) -> bool:
    """Return True if a folder is trusted; warn once if it is there and is not."""
    path = Path(folder)
    trusted = is_trusted(path)
    if not trusted and path.is_dir():
        _LOG.warning(
            "%s must be a folder that this user owns and nobody else can write, so vijax neither reads nor keeps "
            "traced programs there, and JAX still runs compiled programs from there; chmod go-w it, or set "
            "JAX_COMPILATION_CACHE_DIR to another",
            path,
        )
    return trusted


def is_trusted(folder: Path) -> bool:
    """Make a folder if it is missing, for this user alone, and return True if nobody else can put files there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        link, target = folder.lstat(), folder.stat()
    except OSError:
        return False
    return _is_ours(link) and _is_ours(target) and not target.st_mode & _OTHERS_WRITE


def read(path: Path) -> bytes | None:
    """Return the content of a file of the folder; None if it cannot be read or is not trusted.

    A link is not followed, and a pipe does not block.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            return file.read() if _is_trusted_file(os.fstat(descriptor), path.parent) else None
    except OSError:
        return None


def trim(folder: Path, most: int) -> None:
    """Delete the programs of a folder that were used longest ago, until so many bytes are left at most.

    Other files are neither counted nor deleted. If the folder is a link, nothing is deleted: the folder that it points
    to may have another purpose.
    """
    if folder.is_symlink():
        return
    # Some disks do not note when a file was read.
    used = [
        (max(about.st_atime, about.st_mtime), about.st_size, path)
        for path, about in _programs(folder)
        if stat.S_ISREG(about.st_mode)
    ]
    left = sum(size for _, size, _ in used)
    for _, size, path in sorted(used):
        if left <= most:
            return
        with suppress(OSError):  # another process has deleted it, or it may not be deleted
            path.unlink()
        left -= size


def content(folder: Path) -> tuple[int, int]:
    """Return how many files of programs a folder holds, and how many bytes they have together."""
    sizes = [about.st_size for _, about in _programs(folder)]
    return len(sizes), sum(sizes)


def _programs(folder: Path) -> list[tuple[Path, os.stat_result]]:
    """List the entries of a folder that have names of programs, with what the disk says of each, links as links."""
    found = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _PROGRAM.fullmatch(entry.name):
                with suppress(OSError):  # another process has deleted it
                    found.append((Path(entry.path), entry.stat(follow_symlinks=False)))
    return found


def _is_ours(about: os.stat_result) -> bool:
    return about.st_uid in (os.getuid(), 0)


def _is_trusted_file(about: os.stat_result, folder: Path) -> bool:
    """Return True if a file is regular, this user or root owns it, and nobody else can write to it.

    JAX makes files that a group may write if the user's mask allows it; where only the user can enter the folder, no
    other member of the group reaches them.
    """
    if not stat.S_ISREG(about.st_mode) or not _is_ours(about):
        return False
    return not about.st_mode & _OTHERS_WRITE or not _others_enter(folder)


def _others_enter(folder: Path) -> bool:
    try:
        return bool(folder.stat().st_mode & _OTHERS_ENTER)
    except OSError:
        return True


def _folder() -> Path | None:
    """Return the folder of this user; None if the user has no home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vijax"
    except RuntimeError:
        return None
