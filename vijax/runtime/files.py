"""Files that are whole or absent: where one may be written, how it takes its place, what a killed run left; JSON."""

import json
import logging
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from vijax.runtime import checks

_LOG = logging.getLogger(__name__)
_WRITING: set[Path] = set()  # what this process has under way


def check_ending(name: str, path: str | Path, ending: str) -> None:
    """Raise ValueError unless a path ends so; `name` is the argument that an error speaks of."""
    if checks.path(name, path).suffix != ending:
        raise ValueError(f"{name} must end in {ending}; got {checks.shown(str(path))}")


def check_output(name: str, path: str | Path, overwrite: bool = False) -> Path:
    """Check that a file can be written, and give its path; `name` is the argument that an error speaks of.

    What a killed run left beside it is put back or cleared away.

    Raises:
        FileExistsError: If it is taken, and may not be replaced: a folder never.
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = check_folder(name, path)
    recover(target)
    if os.path.lexists(target):
        if not overwrite:
            raise FileExistsError(f"{name} must not exist yet; got {path}; allow overwriting, or take another name")
        if target.is_dir():
            raise FileExistsError(f"{name} must not replace a folder; got {path}; take another name")
    return target


def check_folder(name: str, path: str | Path) -> Path:
    """Check that a name can be given to something new, and give its path.

    Raises:
        FileNotFoundError, PermissionError: If its folder is missing or closed.
    """
    target = checks.path(name, path)
    folder = target.absolute().parent
    if not target.name:
        raise FileNotFoundError(f"{name} must name a file; got {str(path)!r}")
    if not folder.is_dir():
        file = next((one for one in (folder, *folder.parents) if one.exists() and not one.is_dir()), None)
        advice = f"make {folder} first" if file is None else f"{file} is no folder, take another place"
        raise FileNotFoundError(f"{name} must lie in a folder that exists; got {path}; {advice}")
    try:
        # Leaves no name behind. To ask for permission is not enough: all is allowed to root, and nothing in /proc.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise PermissionError(f"{name} must lie in a folder that can be written; got {path} ({reason})") from None
    return target


def beside(path: Path, kind: str) -> Path:
    """Name a sibling for what is being written, of kind "part", or for what is being replaced, of kind "old"."""
    return path.with_name(f".{path.stem}.{os.getpid()}.{kind}{path.suffix}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a sibling to write, which becomes the file when the block succeeds and is removed when it does not."""
    part = beside(path, "part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Do as `replacing` for a folder: what was there is put aside, and back if the new one cannot take its place."""
    path = path.resolve()  # a link goes on pointing where it does
    part, old = beside(path, "part"), beside(path, "old")
    _WRITING.update((part, old))
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
            shutil.rmtree(leftover, ignore_errors=True)
        _WRITING.difference_update((part, old))


def recover(path: Path) -> None:
    """Put back what a killed run had put aside and not replaced, and clear away what it left half-written; said both.

    What a process has under way that is alive on this machine stays as it is.
    """
    path = path.resolve()
    if not os.access(path.parent, os.R_OK):
        return
    left = re.compile(rf"\.{re.escape(path.stem)}\.(\d+)\.(part|old){re.escape(path.suffix)}")
    for file in list(path.parent.iterdir()):
        match = left.fullmatch(file.name)
        if match is None or file in _WRITING or _is_other(int(match[1])):
            continue
        if match[2] == "old" and not path.exists():
            file.rename(path)
            _LOG.warning("%s, which a killed run had put aside as %s, is back", path.name, file.name)
        else:
            shutil.rmtree(file) if file.is_dir() else file.unlink()
            _LOG.warning("%s, which a killed run had left, is removed", file.name)


def _is_other(process: int) -> bool:
    """Say whether another process of this number lives."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return process != os.getpid()


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
