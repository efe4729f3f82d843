"""What a store of tiles holds besides them, metadata and coordinates: made, mended, compared with a plan."""

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.model.records import Status
from vijax.planes import inventory, store
from vijax.planes.dataset import SweepPlan, asked, coordinates, provenance, specimen
from vijax.runtime.files import replacing
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

# What is asked only where it is not as usual: where a store has it, a plan without it asks something else.
_OFTEN_LEFT_OUT = "excitation", "starts"
_SHOWN = 3  # Settings that differ which an error names; of others it says how many.


def write(planned: SweepPlan, tile: Mapping[str, int], birth: str, path: Path) -> None:
    """Write the store of a plan, every variable void: its metadata do not change with its tiles.

    Args:
        planned: What it will hold.
        tile: Lengths of a tile along the dimensions that the dynamics see.
        birth: Of the store: no other has the same.
        path: Folder to make.
    """
    sizes, axes = planned.cells.sizes, coordinates(planned.cells)
    arrays = {
        name: store.array(axis, axis.shape, axis.shape, np.nan if axis.dtype.kind == "f" else 0)
        for name, axis in axes.items()
    }
    for name, variable in specimen(planned).data_vars.items():
        shape = tuple(sizes[str(dim)] for dim in variable.dims)
        chunks = tuple({**sizes, **tile}[str(dim)] for dim in variable.dims)
        arrays[str(name)] = store.array(variable.variable, shape, chunks, void(str(name), variable.dtype))
    # Arrays named as their only dimension pass for coordinates; by this xarray knows the others, as CF has it.
    others = " ".join(sorted(name for name, axis in axes.items() if axis.dims != (name,)))
    store.write_blank(path, provenance(planned) | {"coordinates": others}, arrays)
    for name, axis in axes.items():
        file = store.chunk(path, name, [0] * axis.ndim)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(store.encoded(axis.values))
    inventory.write(path, birth=birth, tile=dict(tile))


def void(name: str, dtype: np.dtype) -> Any:
    """Give what a variable holds where nothing was run."""
    if name == "status":
        return int(Status.NOT_RUN)
    return {"f": np.nan, "i": -1, "b": False}[dtype.kind]


# --- damage ----------------------------------------------------------------------------------------------------------


def mend(planned: SweepPlan, tile: Mapping[str, int], birth: str, path: Path, say: Callable[[str], None]) -> None:
    """Write again what is damaged: metadata by their copies, coordinates by the plan if it has the same as was there.

    Args:
        planned: What the store should hold.
        tile, birth: As in `write`, for a store that has lost the list of its files.
        path: Of the store; one of an earlier version, which never had such a list, stays as it is.
        say: Takes a line for every file.

    Raises:
        FileExistsError: If the plan has something else there, or nothing tells what was there.
    """
    listed = inventory.read(path)
    if listed is None:
        _mend_list(planned, tile, birth, path, say)
        return
    faults = dict(inventory.faults(path, listed["files"]))
    for name in [name for name in faults if name in listed["metadata"]]:
        _put(name, faults.pop(name), listed["metadata"][name].encode(), path, say)
    if not faults:
        return
    with _fresh(planned, listed["tile"], listed["birth"]) as fresh:
        for name, reason in faults.items():
            if inventory.fault(fresh / name, listed["files"][name]):
                raise FileExistsError(
                    see(
                        "studies",
                        f"out must be whole or what this plane can mend; got {path}, where {name} {reason}, "
                        "and this plane has something else there; allow overwriting, or take another name",
                    )
                )
            _put(name, reason, (fresh / name).read_bytes(), path, say)


def _mend_list(planned: SweepPlan, tile: Mapping[str, int], birth: str, path: Path, say: Callable[[str], None]) -> None:
    """Write the list of a store again that has lost it, and what metadata of arrays differ from those of the store."""
    reason = inventory.fault(path / inventory.LIST, None)
    if reason == "is missing" and not inventory.had_list(path):
        return
    with _fresh(planned, tile, birth) as fresh:
        faults = dict(inventory.faults(path, (inventory.read(fresh) or {})["files"]))
        if any("/zarr.json" not in name for name in faults):
            raise FileExistsError(
                see(
                    "studies",
                    f"out must be whole or what this plane can mend; got {path}, where {inventory.LIST} {reason}, "
                    f"which would tell whether {next(iter(faults))} is what was written; allow overwriting, "
                    "or take another name",
                )
            )
        for name, fault in [*faults.items(), (inventory.LIST, reason)]:
            _put(name, fault, (fresh / name).read_bytes(), path, say)


@contextmanager
def _fresh(planned: SweepPlan, tile: Mapping[str, int], birth: str) -> Iterator[Path]:
    """Make the store of a plan as it would be made now, for a while."""
    with tempfile.TemporaryDirectory() as folder:
        write(planned, tile, birth, Path(folder, "fresh"))
        yield Path(folder, "fresh")


def _put(name: str, reason: str, content: bytes, path: Path, say: Callable[[str], None]) -> None:
    """Write a file of a store again."""
    target = path / name
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as part:
        part.write_bytes(content)
    say(f"{name} of {path} is written again: it {reason}")


# --- which plane -----------------------------------------------------------------------------------------------------


def check_same(planned: SweepPlan, path: Path) -> None:
    """Raise FileExistsError unless a store holds the plane of a plan, or part of it."""
    with store.view(path) as written:
        found = list(_differences(planned, written))
    if found:
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise FileExistsError(
            see(
                "studies",
                f"out must be new or hold the same plane; got {path}, where {'; '.join(found[:_SHOWN])}{more}; "
                "allow overwriting, or take another name",
            )
        )


def _differences(planned: SweepPlan, written: "xr.Dataset") -> Iterator[str]:
    """Find what was asked otherwise than the store has it, a phrase each."""
    told = json.loads(json.dumps(asked(planned)))
    for name in dict.fromkeys([*told, *_OFTEN_LEFT_OUT]):
        here, there = told.get(name, "left out"), written.attrs.get(name, "left out")
        if here != there:
            yield f"{name} is {there}, and not {here}"
    axes = coordinates(planned.cells)
    for name in dict.fromkeys([*axes, *map(str, written.coords)]):
        here, there = axes.get(name), written.coords.get(name)
        if here is None or there is None or here.dims != there.dims or not _equal(here.values, there.values):
            yield f"{name} is {_words(there)}, and not {_words(here)}"
    yield from (f"{name} is left out" for name in planned.outputs if name not in written)


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def _words(values: "xr.Variable | xr.DataArray | None") -> str:
    """Write a coordinate in a few words."""
    if values is None:
        return "left out"
    if values.ndim == 0:
        return f"{float(values)}"
    first, last = (float(values.values.flat[at]) for at in (0, -1))
    return f"{values.size} values over {', '.join(map(str, values.dims))} from {first} to {last}"
