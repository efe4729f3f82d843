"""What a store of tiles holds besides them, metadata and coordinates: made, mended, compared with a plan."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vijax.planes import inventory, store, store_names
from vijax.planes.dataset import SweepPlan, asked, coordinates, provenance, specimen
from vijax.planes.store_names import LIST, METADATA
from vijax.runtime import checks
from vijax.runtime.files import replace_files
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

# What is asked only where it is not as usual: where a store has it, a plan without it asks something else.
_OFTEN_LEFT_OUT = "excitation", "starts"
_SHOWN = 3  # Settings that differ which an error names; of others it says how many.


def contents(planned: SweepPlan, tile: Mapping[str, int], birth: str) -> dict[str, bytes]:
    """Make the files of the store of a plan, every variable void: its metadata do not change with its tiles.

    Args:
        planned: What it will hold.
        tile: Lengths of a tile along the dimensions that the dynamics see.
        birth: Of the store: no other has the same.

    Returns:
        Contents by name, the list of the files among them.
    """
    sizes, axes = planned.cells.sizes, coordinates(planned.cells)
    arrays = {
        name: store.array(axis, axis.shape, axis.shape, np.nan if axis.dtype.kind == "f" else 0)
        for name, axis in axes.items()
    }
    for name, variable in specimen(planned).data_vars.items():
        shape = tuple(sizes[str(dim)] for dim in variable.dims)
        chunks = tuple({**sizes, **tile}[str(dim)] for dim in variable.dims)
        arrays[str(name)] = store.array(variable.variable, shape, chunks, store.void(str(name), variable.dtype))
    # Arrays named as their only dimension pass for coordinates; by this xarray knows the others, as CF has it.
    others = " ".join(sorted(name for name, axis in axes.items() if axis.dims != (name,)))
    files = store.metadata_files(provenance(planned) | {"coordinates": others}, arrays)
    files |= {store.chunk(name, [0] * axis.ndim): store.encoded(axis.values) for name, axis in axes.items()}
    listed = inventory.FileList()
    for name, content in files.items():
        listed.add(name, content)
    return {**files, LIST: listed.content(birth=birth, tile=dict(tile))}


# --- damage ----------------------------------------------------------------------------------------------------------


def mend(planned: SweepPlan, tile: Mapping[str, int], birth: str, path: Path, say: Callable[[str], None]) -> None:
    """Write again what is damaged: metadata by their copies, coordinates by the plan if it has the same as was there.

    No file is written that the store of the plan would not have.

    Args:
        planned: What the store should hold.
        tile, birth: As in `contents`, for a store that has lost the list of its files.
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
    if not faults:
        return
    alike = set(listed.get("tile", ())) == set(tile)
    fresh = contents(planned, listed["tile"], listed["birth"]) if alike else {}
    copies = {name: text.encode() for name, text in listed["metadata"].items()}
    mended = {name: copies.get(name, fresh[name]) for name in faults if name in fresh}
    for name, reason in faults.items():
        if name not in mended or inventory.fingerprint(mended[name]) != listed["files"][name]:
            raise FileExistsError(
                see(
                    "studies",
                    f"out must be whole or what this plane can mend; got {checks.shown_path(path)}, where "
                    f"{checks.shown_path(name)} {reason}, and this plane has something else there; allow overwriting, "
                    "or take another name",
                )
            )
    _put(mended, faults, path, say)


def _mend_list(planned: SweepPlan, tile: Mapping[str, int], birth: str, path: Path, say: Callable[[str], None]) -> None:
    """Write the list of a store again that has lost it, and what metadata of arrays differ from those of the store."""
    reason = inventory.fault(path, LIST, None)
    if reason == "is missing" and not inventory.had_list(path):
        return
    fresh = contents(planned, tile, birth)
    expected = {name: inventory.fingerprint(content) for name, content in fresh.items() if name != LIST}
    faults = dict(inventory.faults(path, expected))
    if unknown := [name for name in faults if not name.endswith(f"/{METADATA}")]:
        raise FileExistsError(
            see(
                "studies",
                f"out must be whole or what this plane can mend; got {checks.shown_path(path)}, where {LIST} {reason}, "
                f"which would tell whether {unknown[0]} is what was written; allow overwriting, or take another name",
            )
        )
    _put(fresh, faults | {LIST: reason}, path, say)


def _put(mended: Mapping[str, bytes], faults: Mapping[str, str], path: Path, say: Callable[[str], None]) -> None:
    """Write files of a store again, those that have faults."""
    replace_files({path / name: mended[name] for name in faults}, within=path)
    for name, reason in faults.items():
        say(f"{name} of {checks.shown_path(path)} is written again: it {reason}")


# --- which plane -----------------------------------------------------------------------------------------------------


def check_same(planned: SweepPlan, path: Path) -> None:
    """Raise FileExistsError unless a store holds the plane of a plan, or part of it."""
    with store.view(path) as written:
        found = [*_differences(planned, written), *_other_tiles(planned, path)]
    if found:
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise FileExistsError(
            see(
                "studies",
                f"out must be new or hold the same plane; got {checks.shown_path(path)}, where "
                f"{'; '.join(found[:_SHOWN])}{more}; "
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


def _other_tiles(planned: SweepPlan, path: Path) -> Iterator[str]:
    """Find variables whose chunks are not the tiles of the store, a phrase each."""
    arrays = {name: grid for name, grid in store_names.layouts(path).items() if name in planned.outputs}
    status, listed = arrays.get("status"), inventory.read(path)
    tile = dict(zip(status.dims, status.chunk, strict=True)) if status else {}
    if tuple(tile) != planned.cells.dynamic or (listed and listed.get("tile") != tile):
        yield "status has chunks that are not its tiles"
        return
    for name, grid in arrays.items():
        chunk = {dim: tile.get(dim, size) for dim, size in planned.cells.sizes.items()}
        if grid is None or grid.chunk != tuple(chunk.get(dim) for dim in grid.dims):
            yield f"{name} has chunks that are not its tiles"


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
