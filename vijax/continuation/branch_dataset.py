"""Branches as one `xarray.Dataset`: the properties of their orbits, and the events on them."""

from typing import TYPE_CHECKING

import numpy as np

from vijax.continuation.branch_continuation import Branch
from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS, is_pair_parameter
from vijax.impact.forcing import excitation_attributes
from vijax.model.device import Harvester, depth_unit, scalar_device, with_constants
from vijax.model.pair import pair_quantities
from vijax.model.quantities import AXES, RESULT_QUANTITIES
from vijax.model.walls.membrane import law_attributes
from vijax.model.walls.sides import at_wall
from vijax.orbits import orbit_properties
from vijax.runtime import tiles, validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr


@public_api
def branch_dataset(branches: list[Branch], device: Harvester | None = None) -> "xr.Dataset":
    """Return branches as one dataset, with the properties of their orbits and the events on them, padded with NaN.

    Args:
        branches: Branches along one parameter.
        device: Specifies A, omega (unless one of them is the parameter) and the electrical constants; by default the
            device of Tables I and II of the paper.

    Returns:
        Over (branch, point) the parameter, `multiplier` (largest modulus), `stable`, `P` [J], the `label` and its
        `period`, `impacts_left`, `impacts_right`, `status`; over (branch, point, impact) `v_in`, `side`, `phase`,
        `duration`, `depth` [m]; over (branch, event_number) `event`, its `event_value`, `event_point` (index of the
        nearest point), and `event_onward` (how the branch continues through a graze); over branch `end_first`,
        `end_last`.
    """
    import xarray as xr  # here, because `import vijax` must not load it

    if not validation.validate_records(
        "branches", branches, Branch, "branches, as continuation.follow_orbits returns them"
    ):
        raise ValueError("branches must hold at least one; got none")
    device = scalar_device(device)
    along = branches[0].along
    columns = [_columns(branch, device) for branch in branches]
    stacked = {name: stack_padded([column[name] for column in columns]) for name in columns[0]}
    dims = ("branch", "point", "impact")
    # A column has the first one, two or three of these dimensions.
    variables = {
        name: (dims[: values.ndim], values, _ATTRIBUTES[name]) for name, values in stacked.items() if name != along
    }
    events = [[point.kind for point in branch.points] for branch in branches]
    switch_texts = [[point.impact_change_text for point in branch.points] for branch in branches]
    labels = [list(map(str, orbit_properties.orbit_labels(branch.orbit))) for branch in branches]
    values = stack_padded([np.array([point.value for point in branch.points]) for branch in branches])
    nearest = stack_padded([_nearest_orbits(branch) for branch in branches])
    return xr.Dataset(
        variables
        | {"label": (dims[:2], text_table(labels), {"long_name": "left:right impacts per forcing periods"})}
        | {
            "event": (("branch", "event_number"), text_table(events)),
            "event_value": (("branch", "event_number"), values),
        }
        | {"event_point": (("branch", "event_number"), nearest)}
        | {"event_onward": (("branch", "event_number"), text_table(switch_texts))}
        | {f"end_{name}": ("branch", text_table([[b.ends[i]] for b in branches])[:, 0]) for i, name in _ENDS},
        coords={along: (("branch", "point"), stacked[along], AXES[along].attributes)}
        | _constant_coordinates(branches[0]),
        attrs={
            "title": "Branches of periodic orbits of a vibro-impact pair",
            "along": along,
            "wall": branches[0].orbit.pair.walls,
        }
        | law_attributes(branches[0].orbit.pair)
        | excitation_attributes(branches[0].orbit.pair),
    )


def _constant_coordinates(branch: Branch) -> "dict[str, tuple]":
    """Return the parameters that do not change along a branch, as coordinates."""
    pair = pair_quantities(branch.orbit.pair)
    constant = {name: values for name, values in pair.items() if name not in AFFECTED_CONSTANTS[branch.along]}
    return {name: ((), float(values[0]), AXES[name].attributes) for name, values in constant.items()}


# The two ends of a branch: index in `Branch.ends`, and suffix of the variable.
_ENDS = ((0, "first"), (1, "last"))
_ATTRIBUTES = {
    **{
        name: RESULT_QUANTITIES[name].attributes
        for name in ("multiplier", "P", "v_in", "side", "phase", "duration", "depth")
    },
    "stable": {"units": "1", "long_name": "whether the orbit attracts: 1 or 0"},
    "period": {"units": "1", "long_name": "forcing periods"},
    "impacts_left": {"units": "1", "long_name": "left impacts in that time"},
    "impacts_right": {"units": "1", "long_name": "right impacts in that time"},
    "status": {"units": "1", "long_name": "0: verified by the impact map"},
}


def _columns(branch: Branch, device: Harvester) -> dict[str, np.ndarray]:
    """Return the variables of a branch, one row per point."""
    # A quantity of the device differs from point to point. It has the shape [point, 1] to broadcast over the impacts.
    if not is_pair_parameter(branch.along):
        device = with_constants(device, **{branch.along: tiles.arrays(branch.values[:, None])})
    impacts, counts = orbit_properties.orbit_impacts(branch.orbit), orbit_properties.counts(branch.orbit)
    # This factor converts nondimensional depths to metres; it may differ between the walls.
    length_unit = at_wall(depth_unit(device, branch.orbit.pair), impacts.side)
    columns = {
        branch.along: branch.values,
        "multiplier": np.abs(np.asarray(branch.orbit.multipliers)).max(axis=1),
        "stable": branch.stable.astype(float),
        "P": orbit_properties.orbit_power(branch.orbit, device),
        "period": counts.period,
        "impacts_left": counts.left,
        "impacts_right": counts.right,
        "status": branch.orbit.status,
        "v_in": impacts.v_in,
        "side": impacts.side,
        "phase": impacts.t,
        "duration": impacts.duration,
        "depth": np.asarray(impacts.depth) * np.asarray(length_unit),
    }
    return {name: np.asarray(values, float) for name, values in columns.items()}


def _nearest_orbits(branch: Branch) -> np.ndarray:
    """Return the index of the orbit nearest to each event.

    The distance includes the signature of the orbit, because a branch with folds has several orbits at one parameter.
    """
    # The value of the parameter is one more coordinate of the distance.
    signatures = np.column_stack([np.asarray(orbit_properties.orbit_signature(branch.orbit)), branch.values])
    event_signatures = [
        np.append(np.asarray(orbit_properties.orbit_signature(point.orbit))[0], point.value) for point in branch.points
    ]
    return np.array(
        [np.abs(signatures - signature).sum(axis=1).argmin() for signature in event_signatures], dtype=float
    )


def text_table(rows: list[list[str]]) -> np.ndarray:
    """Return a table of texts from rows of several lengths, with "" beyond the end of each row."""
    width = max(map(len, rows))
    # StringDType stores texts of any length.
    table = [row + [""] * (width - len(row)) for row in rows]
    return np.array(table, dtype=np.dtypes.StringDType()).reshape(len(rows), width)


def stack_padded(rows: list[np.ndarray]) -> np.ndarray:
    """Stack arrays of different shapes, each padded with NaN to the largest size along every axis."""
    shape = np.max([row.shape for row in rows], axis=0)
    table = np.full((len(rows), *shape), np.nan)
    for index, row in enumerate(rows):
        table[index][tuple(slice(size) for size in row.shape)] = row
    return table
