"""Metadata and coordinates of a tiled store: creation from a plan, repair, and comparison with a plan."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vijax.maps.map_dataset import SweepPlan, blank_map, coordinates, provenance, request_attributes
from vijax.maps.storage import store, store_inventory, store_names
from vijax.maps.storage.store_names import LIST, METADATA
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.files import replace_files

if TYPE_CHECKING:
    import xarray as xr

# Attributes that a store has only if they differ from the default. They are always compared, because a store with such
# an attribute differs from a plan without it.
_OPTIONAL_ATTRIBUTES = "excitation", "starts"
_MAX_LISTED = 3  # maximum number of differing settings that an error lists


def contents(plan: SweepPlan, tile: Mapping[str, int], store_id: str) -> dict[str, bytes]:
    """Return the files of a new store for a plan, without any tile; later tiles do not change these files.

    Args:
        plan: Plan of the store.
        tile: Lengths of a tile along the dynamic dimensions.
        store_id: Unique id of the store.

    Returns:
        Contents of the files by name, including the list of the files.
    """
    sizes, axes = plan.cells.sizes, coordinates(plan.cells)
    arrays = {
        name: store.array_metadata(axis, axis.shape, axis.shape, np.nan if axis.dtype.kind == "f" else 0)
        for name, axis in axes.items()
    }
    # The blank map has one cell: its shapes are replaced by the shapes of the plane, its chunks by tiles.
    for name, variable in blank_map(plan).data_vars.items():
        shape = tuple(sizes[str(dim)] for dim in variable.dims)
        chunks = tuple({**sizes, **tile}[str(dim)] for dim in variable.dims)
        arrays[str(name)] = store.array_metadata(
            variable.variable, shape, chunks, store.void_value(str(name), variable.dtype)
        )
    # An array named like its only dimension is a coordinate by itself; xarray recognises the others by this CF
    # attribute.
    others = " ".join(sorted(name for name, axis in axes.items() if axis.dims != (name,)))
    files = store.metadata_files(provenance(plan) | {"coordinates": others}, arrays)
    files |= {store.chunk(name, [0] * axis.ndim): store.encode_chunk(axis.values) for name, axis in axes.items()}
    listed = store_inventory.FileList()
    for name, content in files.items():
        listed.add(name, content)
    return {**files, LIST: listed.content(store_id=store_id, tile=dict(tile))}


# --- damage ----------------------------------------------------------------------------------------------------------


def repair(plan: SweepPlan, tile: Mapping[str, int], store_id: str, path: Path, notify: Callable[[str], None]) -> None:
    """Write damaged files again: metadata from their copies, coordinates from the plan if they match the fingerprints.

    No file is written that the store of the plan would not have.

    Args:
        plan: Plan that the store should hold.
        tile, store_id: As in `contents`, for a store that has lost the list of its files.
        path: Path of the store. A store of an earlier version, which never had such a list, is left unchanged.
        notify: Called with one line per file.

    Raises:
        FileExistsError: If the plan gives a damaged file other content than was recorded, or no content was recorded.
    """
    listed = store_inventory.read(path)
    if listed is None:
        _repair_list(plan, tile, store_id, path, notify)
        return
    errors = dict(store_inventory.integrity_errors(path, listed["files"]))
    if not errors:
        return
    # A plan with other dynamic dimensions cannot reproduce the coordinates of the store.
    same_dims = set(listed.get("tile", ())) == set(tile)
    plan_files = contents(plan, listed["tile"], listed["store_id"]) if same_dims else {}
    copies = {name: text.encode() for name, text in listed["metadata"].items()}
    repaired = {name: copies.get(name, plan_files[name]) for name in errors if name in plan_files}
    for name, reason in errors.items():
        if name not in repaired or store_inventory.fingerprint(repaired[name]) != listed["files"][name]:
            raise FileExistsError(
                see(
                    "studies",
                    "out must be a complete store or one that this plane can repair; got "
                    f"{validation.path_text(path)}, where "
                    f"{validation.path_text(name)} {reason}, and this plane has other content there; allow "
                    "overwriting, or take another name",
                )
            )
    _write_repaired(repaired, errors, path, notify)


def _repair_list(
    plan: SweepPlan, tile: Mapping[str, int], store_id: str, path: Path, notify: Callable[[str], None]
) -> None:
    """Write a lost list of a store again, and metadata of arrays that differ from the ones of the plan."""
    reason = store_inventory.integrity_error(path, LIST, None)
    # A store of an earlier version never had a list.
    if reason == "is missing" and not store_inventory.had_list(path):
        return
    plan_files = contents(plan, tile, store_id)
    # Without the list only the plan determines the expected content. Metadata of arrays are replaced; any other
    # difference may mean that the store holds another plane.
    expected = {name: store_inventory.fingerprint(content) for name, content in plan_files.items() if name != LIST}
    errors = dict(store_inventory.integrity_errors(path, expected))
    if unlisted := [name for name in errors if not name.endswith(f"/{METADATA}")]:
        raise FileExistsError(
            see(
                "studies",
                "out must be a complete store or one that this plane can repair; got "
                f"{validation.path_text(path)}, where {LIST} {reason}, "
                f"without which {unlisted[0]} cannot be verified; allow overwriting, or take another name",
            )
        )
    _write_repaired(plan_files, errors | {LIST: reason}, path, notify)


def _write_repaired(
    repaired: Mapping[str, bytes], errors: Mapping[str, str], path: Path, notify: Callable[[str], None]
) -> None:
    """Write the files with integrity errors again, and report each one."""
    replace_files({path / name: repaired[name] for name in errors}, within=path)
    for name, reason in errors.items():
        notify(f"{name} of {validation.path_text(path)} is written again: it {reason}")


# --- comparison with a plan ------------------------------------------------------------------------------------------


def check_same(plan: SweepPlan, path: Path) -> None:
    """Raise FileExistsError unless a store holds the plane of a plan, or part of it."""
    with store.open_store(path) as written:
        differences = [*_differences(plan, written), *_other_tiles(plan, path)]
    if differences:
        more = f"; and {len(differences) - _MAX_LISTED} more" if len(differences) > _MAX_LISTED else ""
        raise FileExistsError(
            see(
                "studies",
                f"out must be new or hold the same plane; got {validation.path_text(path)}, where "
                f"{'; '.join(differences[:_MAX_LISTED])}{more}; "
                "allow overwriting, or take another name",
            )
        )


def _differences(plan: SweepPlan, written: "xr.Dataset") -> Iterator[str]:
    """Yield a phrase for every setting, coordinate and output of a plan that the store does not have."""
    # Converted through JSON like the attributes of the store, which turns tuples into lists.
    requested = json.loads(json.dumps(request_attributes(plan)))
    for name in dict.fromkeys([*requested, *_OPTIONAL_ATTRIBUTES]):
        here, there = requested.get(name, "left out"), written.attrs.get(name, "left out")
        if here != there:
            yield f"{name} is {there}, and not {here}"
    axes = coordinates(plan.cells)
    for name in dict.fromkeys([*axes, *map(str, written.coords)]):
        here, there = axes.get(name), written.coords.get(name)
        if here is None or there is None or here.dims != there.dims or not _equal(here.values, there.values):
            yield f"{name} is {_describe(there)}, and not {_describe(here)}"
    yield from (f"{name} is left out" for name in plan.outputs if name not in written)


def _other_tiles(plan: SweepPlan, path: Path) -> Iterator[str]:
    """Yield a phrase for every variable with chunks that are not the tiles of the store."""
    arrays = {name: grid for name, grid in store_names.layouts(path).items() if name in plan.outputs}
    status, listed = arrays.get("status"), store_inventory.read(path)
    tile = dict(zip(status.dims, status.chunk, strict=True)) if status else {}
    if tuple(tile) != plan.cells.dynamic or (listed and listed.get("tile") != tile):
        yield "status has chunks that are not its tiles"
        return
    for name, grid in arrays.items():
        chunk = {dim: tile.get(dim, size) for dim, size in plan.cells.sizes.items()}
        if grid is None or grid.chunk != tuple(chunk.get(dim) for dim in grid.dims):
            yield f"{name} has chunks that are not its tiles"


def _equal(first: np.ndarray, second: np.ndarray) -> bool:
    """Return True if two arrays are equal; NaN equals NaN."""
    return np.array_equal(first, second, equal_nan=True)


def _describe(values: "xr.Variable | xr.DataArray | None") -> str:
    """Return a short description of a coordinate."""
    if values is None:
        return "left out"
    if values.ndim == 0:
        return f"{float(values)}"
    # The ends and the number of values identify an axis well enough for a message.
    first, last = (float(values.values.flat[index]) for index in (0, -1))
    return f"{values.size} values over {', '.join(map(str, values.dims))} from {first} to {last}"
