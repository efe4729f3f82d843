"""Branches as one `xarray.Dataset`: what every orbit is, and what was met."""

from typing import TYPE_CHECKING

import numpy as np

from vijax.engine.forcing import told_harmonics
from vijax.model.device import Harvester, depth_unit, one_device, with_constants
from vijax.model.membrane import told
from vijax.model.pair import quantities
from vijax.model.quantities import AXES, MEASURED
from vijax.model.sides import at
from vijax.orbits import orbit_properties
from vijax.orbits.continuation import Branch
from vijax.orbits.parameter import MOVED, of_pair
from vijax.runtime import checks, tiles
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr


@door
def dataset(branches: list[Branch], device: Harvester | None = None) -> "xr.Dataset":
    """Make one dataset of branches: what every orbit is, and what was met, padded with NaN.

    Args:
        branches: Along one parameter.
        device: Gives A, omega (unless one is the parameter) and the electrical constants; Tables I and II by default.

    Returns:
        Over (branch, point) the parameter, `multiplier` (largest modulus), `stable`, `P` [J], the `label` and its
        `period`, `impacts_left`, `impacts_right`, `status`; over (branch, point, impact) `v_in`, `side`, `phase`,
        `duration`, `depth` [m]; over (branch, event_number) `event`, its `event_value`, `event_point`, the point
        nearest to it, and `event_onward`, how the branch goes on through a graze; over branch `end_first`, `end_last`.
    """
    import xarray as xr  # here, as importing vijax must not load it

    if not checks.sequence("branches", branches, Branch, "branches, as continuation.follow returns them"):
        raise ValueError("branches must hold at least one; got none")
    device = one_device(device)
    along = branches[0].along
    columns = [_columns(branch, device) for branch in branches]
    found = {name: padded([column[name] for column in columns]) for name in columns[0]}
    dims = ("branch", "point", "impact")
    variables = {name: (dims[: values.ndim], values, _ABOUT[name]) for name, values in found.items() if name != along}
    events = [[point.kind for point in branch.points] for branch in branches]
    onward = [[point.onward for point in branch.points] for branch in branches]
    labels = [list(map(str, orbit_properties.labels(branch.orbit))) for branch in branches]
    values = padded([np.array([point.value for point in branch.points]) for branch in branches])
    places = padded([_places(branch) for branch in branches])
    return xr.Dataset(
        variables
        | {"label": (dims[:2], words(labels), {"long_name": "left:right impacts per forcing periods"})}
        | {"event": (("branch", "event_number"), words(events)), "event_value": (("branch", "event_number"), values)}
        | {"event_point": (("branch", "event_number"), places)}
        | {"event_onward": (("branch", "event_number"), words(onward))}
        | {f"end_{name}": ("branch", words([[b.ends[i]] for b in branches])[:, 0]) for i, name in _ENDS},
        coords={along: (("branch", "point"), found[along], AXES[along].attributes)} | _constants(branches[0]),
        attrs={
            "title": "Branches of periodic orbits of a vibro-impact pair",
            "along": along,
            "wall": branches[0].orbit.pair.walls,
        }
        | told(branches[0].orbit.pair)
        | told_harmonics(branches[0].orbit.pair),
    )


def _constants(branch: Branch) -> "dict[str, tuple]":
    """Name the parameters that do not move."""
    pair = quantities(branch.orbit.pair)
    still = {name: values for name, values in pair.items() if name not in MOVED[branch.along]}
    return {name: ((), float(values[0]), AXES[name].attributes) for name, values in still.items()}


_ENDS = ((0, "first"), (1, "last"))
_ABOUT = {
    **{name: MEASURED[name].attributes for name in ("multiplier", "P", "v_in", "side", "phase", "duration", "depth")},
    "stable": {"units": "1", "long_name": "whether the orbit attracts: 1 or 0"},
    "period": {"units": "1", "long_name": "forcing periods"},
    "impacts_left": {"units": "1", "long_name": "left impacts in that time"},
    "impacts_right": {"units": "1", "long_name": "right impacts in that time"},
    "status": {"units": "1", "long_name": "0: verified by the impact map"},
}


def _columns(branch: Branch, device: Harvester) -> dict[str, np.ndarray]:
    """Lay out what the dataset holds of a branch, a row a point."""
    if not of_pair(branch.along):
        device = with_constants(device, **{branch.along: tiles.arrays(branch.values[:, None])})
    hits, label = orbit_properties.impacts(branch.orbit), orbit_properties.counts(branch.orbit)
    length = at(depth_unit(device, branch.orbit.pair), hits.side)
    columns = {
        branch.along: branch.values,
        "multiplier": np.abs(np.asarray(branch.orbit.multipliers)).max(axis=1),
        "stable": branch.stable.astype(float),
        "P": orbit_properties.power(branch.orbit, device),
        "period": label.period,
        "impacts_left": label.left,
        "impacts_right": label.right,
        "status": branch.orbit.status,
        "v_in": hits.v_in,
        "side": hits.side,
        "phase": hits.t,
        "duration": hits.duration,
        "depth": np.asarray(hits.depth) * np.asarray(length),
    }
    return {name: np.asarray(values, float) for name, values in columns.items()}


def _places(branch: Branch) -> np.ndarray:
    """Find the orbit nearest to each thing met: on the right sheet, where a fold has made several."""
    passed = np.column_stack([np.asarray(orbit_properties.marks(branch.orbit)), branch.values])
    met = [np.append(np.asarray(orbit_properties.marks(point.orbit))[0], point.value) for point in branch.points]
    return np.array([np.abs(passed - traits).sum(axis=1).argmin() for traits in met], dtype=float)


def words(rows: list[list[str]]) -> np.ndarray:
    """Make a table of words of rows of several lengths, "" beyond each."""
    most = max(map(len, rows))
    table = [row + [""] * (most - len(row)) for row in rows]
    return np.array(table, dtype=np.dtypes.StringDType()).reshape(len(rows), most)


def padded(rows: list[np.ndarray]) -> np.ndarray:
    """Stack arrays of several shapes, NaN beyond each."""
    shape = np.max([row.shape for row in rows], axis=0)
    table = np.full((len(rows), *shape), np.nan)
    for index, row in enumerate(rows):
        table[index][tuple(slice(size) for size in row.shape)] = row
    return table
