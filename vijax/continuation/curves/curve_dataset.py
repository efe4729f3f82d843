"""Curves of bifurcations as one `xarray.Dataset`: the properties of their orbits, and their points of codimension 2."""

from typing import TYPE_CHECKING

import numpy as np

from vijax.continuation.branch_dataset import stack_padded
from vijax.continuation.curves.curves import BifurcationCurve
from vijax.continuation.from_map.map_curves import MapCurves
from vijax.impact.forcing import excitation_attributes
from vijax.model.label import label
from vijax.model.pair import pair_quantities
from vijax.model.quantities import AXES, RESULT_QUANTITIES
from vijax.model.walls.membrane import law_attributes
from vijax.orbits import orbit_properties
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

_ATTRIBUTES = {
    "multiplier": RESULT_QUANTITIES["multiplier"].attributes,
    "multiplier_product": {"units": "1", "long_name": "product of both Floquet multipliers"},
    "residual": {"units": "1", "long_name": "largest violation of the equations of the orbit"},
    "status": {"units": "1", "long_name": "0: verified by the impact map"},
    "stable": {"units": "1", "long_name": "whether stable orbits border on the curve there: 1 or 0"},
}


@public_api
def curve_dataset(curves: list[BifurcationCurve] | MapCurves) -> "xr.Dataset":
    """Return curves in a plane as one dataset, with their orbits and points of codimension 2, padded with NaN.

    Args:
        curves: Curves of one plane, or the result of `vijax.bifurcation_curves` for a map.

    Returns:
        A dataset. Over (curve, point) both parameters, `multiplier` (largest modulus), `multiplier_product`,
        `residual`, `status`, `stable`; over curve `kind`, the `label` of its orbits, `end_first`, `end_last`; over
        (curve, event_number) the points of codimension 2: `event`, the grazing test function as `event_test`, how the
        curve continues there as `event_onward`, the parameters as `event_` followed by their names, and
        `event_residual`. For a map also, over border, the borders that no curve explains: their parameters as `left_`
        followed by the names, and `left_basins` (1 if the motion of either side attracts on both sides); and the
        attributes `borders`, `explained` and `ended` of `MapCurves`.

    Raises:
        ValueError: No curves, or curves of several planes.
    """
    import xarray as xr  # here, because `import vijax` must not load it

    map_result = curves if isinstance(curves, MapCurves) else None
    curves = curves.curves if isinstance(curves, MapCurves) else curves
    curve_list = validation.validate_records(
        "curves", curves, BifurcationCurve, "curves, as curves.follow_curves returns them"
    )
    if not curve_list:
        raise ValueError("curves must hold at least one; got none")
    along = curve_list[0].along
    if any(curve.along != along for curve in curve_list):
        raise ValueError(f"curves must be of one plane; got {sorted({curve.along for curve in curve_list})}")
    columns = [_columns(curve) for curve in curve_list]
    stacked = {name: stack_padded([column[name] for column in columns]) for name in columns[0]}
    dims = ("curve", "point")
    curve_texts = {
        "kind": [curve.kind for curve in curve_list],
        "label": [_label(curve) for curve in curve_list],
        "end_first": [curve.ends[0] for curve in curve_list],
        "end_last": [curve.ends[1] for curve in curve_list],
    }
    result = xr.Dataset(
        {name: (dims, stacked[name], about) for name, about in _ATTRIBUTES.items()}
        | {name: ("curve", _text_array(texts)) for name, texts in curve_texts.items()}
        | _events(curve_list),
        coords={name: (dims, stacked[name], AXES[name].attributes) for name in along}
        | _constant_coordinates(curve_list[0]),
        attrs={
            "title": "Curves of bifurcations of a vibro-impact pair",
            "along": " ".join(along),
            "wall": curve_list[0].orbit.pair.walls,
        }
        | law_attributes(curve_list[0].orbit.pair)
        | excitation_attributes(curve_list[0].orbit.pair),
    )
    return result if map_result is None else _with_borders(result, map_result)


def _events(curve_list: list[BifurcationCurve]) -> dict[str, tuple]:
    """Return the variables of the points of codimension 2."""
    dims, width = ("curve", "event_number"), max(len(curve.points) for curve in curve_list)
    kinds = [[point.kind for point in curve.points] for curve in curve_list]
    tests = [[point.test for point in curve.points] for curve in curve_list]
    # Empty where a curve does not continue through the point.
    switch_texts = [[point.impact_change_text for point in curve.points] for curve in curve_list]
    # Curves without events have an empty table of the same two columns.
    parameters = stack_padded(
        [np.array([point.values for point in curve.points]).reshape(-1, 2) for curve in curve_list]
    )
    residuals = stack_padded(
        [np.array([float(point.orbit.residual[0]) for point in curve.points]) for curve in curve_list]
    )
    variables = {
        "event": (dims, _text_table(kinds, width)),
        "event_test": (dims, _text_table(tests, width)),
        "event_onward": (dims, _text_table(switch_texts, width)),
        "event_residual": (dims, residuals, _ATTRIBUTES["residual"]),
    }
    indexed_names = enumerate(curve_list[0].along)
    return variables | {
        f"event_{name}": (dims, parameters[..., index], AXES[name].attributes) for index, name in indexed_names
    }


def _constant_coordinates(curve: BifurcationCurve) -> dict[str, tuple]:
    """Return the parameters that are the same at all points of a curve, as coordinates."""
    pair = {name: x for name, x in pair_quantities(curve.orbit.pair).items() if name not in curve.along}
    # Constant here means exactly equal at all points.
    constant = {name: np.asarray(x) for name, x in pair.items() if np.ptp(np.asarray(x)) == 0}
    return {name: ((), float(x[0]), AXES[name].attributes) for name, x in constant.items()}


def _with_borders(dataset: "xr.Dataset", map_result: MapCurves) -> "xr.Dataset":
    """Add the borders of the map that no curve explains, and the result of the search."""
    names = dataset.attrs["along"].split()
    variables = {
        f"left_{name}": ("border", map_result.unexplained[:, index], AXES[name].attributes)
        for index, name in enumerate(names)
    }
    attributes = {"units": "1", "long_name": "whether the motions of both sides attract on either side: 1 or 0"}
    variables["left_basins"] = "border", map_result.separates_basins.astype(np.int8), attributes
    return dataset.assign(variables).assign_attrs(
        borders=map_result.borders, explained=map_result.explained, ended=map_result.ended
    )


def _columns(curve: BifurcationCurve) -> dict[str, np.ndarray]:
    """Return the variables of a curve, one row per point."""
    multipliers = np.asarray(curve.orbit.multipliers)
    columns = {
        curve.along[0]: curve.values[:, 0],
        curve.along[1]: curve.values[:, 1],
        "multiplier": np.abs(multipliers).max(axis=1),
        "multiplier_product": multipliers.prod(axis=1).real,
        "residual": curve.orbit.residual,
        "status": curve.orbit.status,
        "stable": curve.stable,
    }
    return {name: np.asarray(values, float) for name, values in columns.items()}


def _label(curve: BifurcationCurve) -> str:
    """Return the label of the orbits of a curve, the same for mirror images."""
    # The orbit in the middle, because at its ends a curve may have orbits of a curve that it meets.
    middle = len(curve.values) // 2
    orbit = curve.orbit[middle : middle + 1]
    counts = orbit_properties.counts(orbit)
    # Mirror images have one label only if the walls are equal and gravity is zero.
    merge = np.asarray(orbit.pair.symmetric)
    return str(label(counts.period, counts.left, counts.right, merge_mirrors=merge)[0])


def _text_array(texts: list[str]) -> np.ndarray:
    return np.array(texts, dtype=np.dtypes.StringDType())


def _text_table(rows: list[list[str]], width: int) -> np.ndarray:
    """Return a table of texts from rows of several lengths."""
    return _text_array([word for row in rows for word in row + [""] * (width - len(row))]).reshape(len(rows), width)
