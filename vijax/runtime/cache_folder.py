"""Where traced and compiled programs are kept between processes: a folder of the user's cache, bounded in size.

JAX's own settings win: a folder named by `jax_compilation_cache_dir` (or JAX_COMPILATION_CACHE_DIR) is used as it is,
and with `jax_enable_compilation_cache` off nothing is kept.
"""

import os
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

MOST_BYTES = 2 * 1024**3  # a plane's program takes some two megabytes, with its traced form
_OTHERS_WRITE = 0o022


@cache
def keep_programs() -> None:
    """Keep programs in the user's folder from now on, unless JAX was told of another, or to keep none.

    JAX knows one folder: other programs of this process are kept there too. Where the folder cannot be made, or where
    somebody else could put programs into it, none are kept. The folder is cut to `MOST_BYTES` here, once a process.
    """
    asked = jax.config.values
    if asked["jax_compilation_cache_dir"] or not asked["jax_enable_compilation_cache"]:
        return
    folder = _folder()
    if folder is None or not _private(folder):
        return
    trim(folder, MOST_BYTES)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By itself JAX keeps what took a second; of the many small programs of an orbit or a flight none does.
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # A program may have compiled before, and JAX have found that there is no folder.
    compilation_cache.reset_cache()


def kept() -> Path | None:
    """Name the folder in which JAX keeps compiled programs, if it does, on a disk."""
    asked = jax.config.values
    folder = asked["jax_compilation_cache_dir"] if asked["jax_enable_compilation_cache"] else None
    return Path(folder) if folder and "://" not in folder else None


def trim(folder: Path, most: int) -> None:
    """Delete the files of a folder that were used longest ago, until so many bytes are left at most."""
    used = []
    for path in folder.iterdir():
        try:
            about = path.stat()
        except OSError:  # another process has deleted it
            continue
        # Some disks do not note when a file was read.
        used.append((max(about.st_atime, about.st_mtime), about.st_size, path))
    left = sum(size for _, size, _ in used)
    for _, size, path in sorted(used):
        if left <= most:
            return
        with suppress(OSError):  # it is gone, or may not go
            path.unlink()
        left -= size


def _folder() -> Path | None:
    """Name the folder for this user; None where the user has no home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vijax"
    except RuntimeError:
        return None


def _private(folder: Path) -> bool:
    """Make the folder at need, and say whether its files can be trusted: programs that are read there are run."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
    except OSError:
        return False
    return about.st_uid == os.getuid() and not about.st_mode & _OTHERS_WRITE
