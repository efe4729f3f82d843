"""Maps on disk: zarr stores that are whole or absent, each chunk with a checksum; reports as strict JSON."""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax import checks

if TYPE_CHECKING:
    import xarray as xr

_LEVEL = 1  # of compression; 3 takes twice as long to save a thousandth


def check_output(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """The path, if something can be written there; `name` is the argument that an error speaks of.

    Raises:
        ValueError: If it is no path.
        FileExistsError: If it is taken, and not ours to overwrite.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = checks.path(name, path)
    folder = target.absolute().parent
    if not target.name:
        raise FileNotFoundError(f"{name} must name a file; got {str(path)!r}")
    if not folder.is_dir():
        raise FileNotFoundError(f"{name} must lie in a folder that exists; got {path}; make {folder} first")
    try:
        # Leaves no name behind. To ask for permission is not enough: all is allowed to root, and nothing in /proc.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise PermissionError(f"{name} must lie in a folder that can be written; got {path} ({reason})") from None
    if target.is_symlink() or target.exists():
        if not overwrite:
            raise FileExistsError(f"{name} must not exist yet; got {path}; allow overwriting, or take another name")
        # A slip of the hand must not delete a folder of other things.
        if target.is_dir() and not (target / "zarr.json").is_file():
            raise FileExistsError(f"{name} must not replace a folder that is no zarr store; got {path}")
    return target


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary sibling to write, renamed to `path` when the block succeeds and removed when it does not."""
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    old = path.with_name(f".{path.stem}.{os.getpid()}.old{path.suffix}")
    try:
        yield part
        if path.is_dir():  # a folder cannot be renamed onto another
            path.rename(old)
        part.replace(path)
    except BaseException:  # Ctrl-C too
        if old.exists() and not path.exists():
            old.rename(path)
        raise
    finally:
        for leftover in (part, old):
            if leftover.is_dir():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)


def save(dataset: "xr.Dataset", path: str | Path, *, overwrite: bool = False) -> None:
    """Write a map as a zarr store (format 3, zstd, CRC-32C); a write that fails or is stopped leaves nothing behind.

    Args:
        dataset: What `sweep` returned, or any part of it.
        path: Folder to make.
        overwrite: Replace a store that is there.

    Raises:
        FileExistsError, FileNotFoundError, PermissionError: As `check_output`.
    """
    checks.variables("dataset", dataset, (), "sweep")
    target = check_output("path", path, checks.flag("overwrite", overwrite))
    with replacing(target) as part:
        write(dataset, part)


def write(dataset: "xr.Dataset", path: Path) -> None:
    """Write a new store."""
    encoding = {name: {"compressors": compressors()} for name in dataset.variables}
    dataset.to_zarr(path, mode="w-", zarr_format=3, consolidated=False, encoding=encoding)


def compressors() -> tuple[Any, ...]:
    """Of every chunk, its checksum last."""
    from zarr.codecs import Crc32cCodec, ZstdCodec  # here, as importing vijax must not load it

    return ZstdCodec(level=_LEVEL), Crc32cCodec()


def encoded(chunk: np.ndarray) -> bytes:
    """The file of a chunk in the format of `compressors`, as zarr writes it at three times the cost."""
    from numcodecs import Zstd
    from numcodecs.checksum32 import CRC32C

    ordered = np.ascontiguousarray(chunk, chunk.dtype.newbyteorder("<"))
    return bytes(CRC32C(location="end").encode(Zstd(level=_LEVEL).encode(ordered)))


def load(path: str | Path) -> "xr.Dataset":
    """The map that `save` wrote, equal to the one that was saved, or what there is of a study.

    Raises:
        FileNotFoundError: If there is no store.
        ValueError: If a checksum does not match.
    """
    with view(checks.path("path", path)) as dataset:
        return dataset.load()


def view(path: str | Path) -> "xr.Dataset":
    """As `load`, but nothing is read before it is looked at."""
    import xarray as xr  # here, as importing vijax must not load it

    if not (Path(path) / "zarr.json").is_file():
        raise FileNotFoundError(f"path must name a zarr store written by vijax; got {path}")
    return xr.open_zarr(path, consolidated=False, chunks=None)


def write_json(report: Any, path: Path) -> None:
    """Write nested dicts, sequences, arrays and numbers as strict JSON, whole or not at all; not finite is null."""
    text = json.dumps(_plain(report), indent=1, allow_nan=False)
    with replacing(path) as part:
        part.write_text(text + "\n", encoding="utf-8")


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
