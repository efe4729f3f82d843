"""The folder that keeps traced and compiled programs between processes, and the conditions to trust it.

Settings of JAX take precedence: a folder specified by `jax_compilation_cache_dir` (or JAX_COMPILATION_CACHE_DIR)
replaces the folder in the user's cache; with `jax_enable_compilation_cache` off no program is kept.

A program that is read is executed. Therefore a folder or file is trusted only if this user or root owns it and nobody
else can write to it.
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

MOST_BYTES = 2 * 1024**3  # a plane's program takes about two megabytes, including its traced form
TRACED = "traced-"
# Files of JAX are MODULE-DIGEST-cache and MODULE-DIGEST-atime. A traced program is traced-DIGEST, with a leading dot
# and a suffix while it is written.
_PROGRAM = re.compile(rf".+-[0-9a-f]{{64}}-(cache|atime)|\.?{TRACED}[0-9a-f]{{64}}(\..+)?")
# Permission bits: write, and enter, for the group and for others.
_OTHERS_WRITE = 0o022
_OTHERS_ENTER = 0o011


@cache
def keep_programs() -> None:
    """Keep programs in the user's folder, unless a setting of JAX specifies another folder, or disables it.

    JAX has one folder per process: other programs of this process are kept there too. No programs are kept if the
    folder cannot be made or is not trusted. The folder is trimmed to `MOST_BYTES` here, once per process.
    """
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] or not settings["jax_enable_compilation_cache"]:
        return
    folder = _folder()
    if folder is None or not is_trusted(folder):
        return
    programs = _programs(folder)
    # JAX would run every file of the folder: one that is not trusted excludes the whole folder.
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
    # By default JAX keeps programs that took a second to compile; the many small programs of an orbit or a trajectory
    # take less.
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # If a program has compiled before, JAX has cached that there is no folder.
    compilation_cache.reset_cache()


def program_folder() -> Path | None:
    """Return JAX's folder of compiled programs; None if JAX keeps none, or if it is not on a disk or not trusted."""
    settings = jax.config.values
    folder = settings["jax_compilation_cache_dir"] if settings["jax_enable_compilation_cache"] else None
    return Path(folder) if folder and "://" not in folder and _is_usable(folder) else None


@lru_cache(maxsize=32)
def _is_usable(folder: str) -> bool:
    """Return True if a folder is trusted; warn once if it exists and is not trusted."""
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
    """Create a folder for this user alone if it is missing; return True if nobody else can put files there."""
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
    """Delete the least recently used programs of a folder until at most `most` bytes are left.

    Other files are neither counted nor deleted. If the folder is a link, nothing is deleted: its target may have
    another purpose.
    """
    if folder.is_symlink():
        return
    # Some file systems do not record access times.
    used = [
        (max(about.st_atime, about.st_mtime), about.st_size, path)
        for path, about in _programs(folder)
        if stat.S_ISREG(about.st_mode)
    ]
    total = sum(size for _, size, _ in used)
    # Oldest use first.
    for _, size, path in sorted(used):
        if total <= most:
            return
        with suppress(OSError):  # another process has deleted it, or it may not be deleted
            path.unlink()
        total -= size


def content(folder: Path) -> tuple[int, int]:
    """Return the number of program files in a folder, and their total size in bytes."""
    sizes = [about.st_size for _, about in _programs(folder)]
    return len(sizes), sum(sizes)


def _programs(folder: Path) -> list[tuple[Path, os.stat_result]]:
    """Return the paths of program files in a folder, each with its status (of a link itself, not of the target)."""
    programs = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _PROGRAM.fullmatch(entry.name):
                with suppress(OSError):  # another process has deleted it
                    programs.append((Path(entry.path), entry.stat(follow_symlinks=False)))
    return programs


def _is_ours(about: os.stat_result) -> bool:
    return about.st_uid in (os.getuid(), 0)


def _is_trusted_file(about: os.stat_result, folder: Path) -> bool:
    """Return True if a file is regular, this user or root owns it, and nobody else can write to it.

    JAX creates files with group write permission if the user's mask allows it; if only the user can enter the folder,
    no other member of the group can reach them.
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
