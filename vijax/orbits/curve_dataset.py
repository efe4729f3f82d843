"""Curves of bifurcations as one `xarray.Dataset`: what every orbit on them is, and what of codimension 2 was met."""

from typing import TYPE_CHECKING

import numpy as np

from vijax.engine.forcing import told_harmonics
from vijax.model.label import label
from vijax.model.membrane import told
from vijax.model.pair import quantities
from vijax.model.quantities import AXES, MEASURED
from vijax.orbits import orbit_properties
from vijax.orbits.branch_dataset import padded
from vijax.orbits.curves import BifurcationCurve
from vijax.orbits.map_curves import MapCurves
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

_ABOUT = {
    "multiplier": MEASURED["multiplier"].attributes,
    "multiplier_product": {"units": "1", "long_name": "product of both Floquet multipliers"},
    "residual": {"units": "1", "long_name": "largest violation of the equations of the orbit"},
    "status": {"units": "1", "long_name": "0: verified by the impact map"},
    "stable": {"units": "1", "long_name": "whether stable orbits border on the curve there: 1 or 0"},
}


@door
def curve_dataset(curves: list[BifurcationCurve] | MapCurves) -> "xr.Dataset":
    """Make one dataset of curves in a plane: what every orbit is, and what was met, padded with NaN.

    Args:
        curves: Of one plane, or what `vijax.bifurcation_curves` found of a map.

    Returns:
        Over (curve, point) both parameters, `multiplier` (largest modulus), `multiplier_product`, `residual`, `status`,
        `stable`; over curve `kind`, the `label` of its orbits, `end_first`, `end_last`; over (curve, event) what of
        codimension 2 was met: `event`, what grazes besides as `event_test`, how the curve goes on then as
        `event_onward`, both parameters as `event_` and their name, and the `event_residual` there. Of a map, over
        border, where those are that no curve explains, as `left_` and the parameters' names, and as `left_basins`
        whether both motions attract on either side; and as attributes `borders`, `explained` and `ended`.

    Raises:
        ValueError: No curves, or curves of several planes.
    """
    import xarray as xr  # here, as importing vijax must not load it

    of_map = curves if isinstance(curves, MapCurves) else None
    curves = curves.curves if isinstance(curves, MapCurves) else curves
    listed = checks.sequence("curves", curves, BifurcationCurve, "curves, as curves.follow_curves returns them")
    if not listed:
        raise ValueError("curves must hold at least one; got none")
    along = listed[0].along
    if any(curve.along != along for curve in listed):
        raise ValueError(f"curves must be of one plane; got {sorted({curve.along for curve in listed})}")
    columns = [_columns(curve) for curve in listed]
    found = {name: padded([column[name] for column in columns]) for name in columns[0]}
    dims = ("curve", "point")
    words = {
        "kind": [curve.kind for curve in listed],
        "label": [_label(curve) for curve in listed],
        "end_first": [curve.ends[0] for curve in listed],
        "end_last": [curve.ends[1] for curve in listed],
    }
    made = xr.Dataset(
        {name: (dims, found[name], about) for name, about in _ABOUT.items()}
        | {name: ("curve", _texts(texts)) for name, texts in words.items()}
        | _events(listed),
        coords={name: (dims, found[name], AXES[name].attributes) for name in along} | _constants(listed[0]),
        attrs={
            "title": "Curves of bifurcations of a vibro-impact pair",
            "along": " ".join(along),
            "wall": listed[0].orbit.pair.walls,
        }
        | told(listed[0].orbit.pair)
        | told_harmonics(listed[0].orbit.pair),
    )
    return made if of_map is None else _with_borders(made, of_map)


def _events(listed: list[BifurcationCurve]) -> dict[str, tuple]:
    """Lay out what of codimension 2 the curves met."""
    dims, most = ("curve", "event_number"), max(len(curve.points) for curve in listed)
    kinds = [[point.kind for point in curve.points] for curve in listed]
    tests = [[point.test for point in curve.points] for curve in listed]
    onward = [[point.onward for point in curve.points] for curve in listed]
    places = padded([np.array([point.values for point in curve.points]).reshape(-1, 2) for curve in listed])
    residuals = padded([np.array([float(point.orbit.residual[0]) for point in curve.points]) for curve in listed])
    found = {
        "event": (dims, _table(kinds, most)),
        "event_test": (dims, _table(tests, most)),
        "event_onward": (dims, _table(onward, most)),
        "event_residual": (dims, residuals, _ABOUT["residual"]),
    }
    named = enumerate(listed[0].along)
    return found | {f"event_{name}": (dims, places[..., index], AXES[name].attributes) for index, name in named}


def _constants(curve: BifurcationCurve) -> dict[str, tuple]:
    """Name the parameters that are the same all along a curve."""
    pair = {name: x for name, x in quantities(curve.orbit.pair).items() if name not in curve.along}
    still = {name: np.asarray(x) for name, x in pair.items() if np.ptp(np.asarray(x)) == 0}
    return {name: ((), float(x[0]), AXES[name].attributes) for name, x in still.items()}


def _with_borders(dataset: "xr.Dataset", of: MapCurves) -> "xr.Dataset":
    """Add what the curves explain of their map."""
    names = dataset.attrs["along"].split()
    places = {f"left_{name}": ("border", of.left[:, index], AXES[name].attributes) for index, name in enumerate(names)}
    about = {"units": "1", "long_name": "whether the motions of both sides attract on either side: 1 or 0"}
    places["left_basins"] = "border", of.basins.astype(np.int8), about
    return dataset.assign(places).assign_attrs(borders=of.borders, explained=of.explained, ended=of.ended)


def _columns(curve: BifurcationCurve) -> dict[str, np.ndarray]:
    """Lay out what the dataset holds of a curve, a row a point."""
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
    """Name the orbits of a curve, mirror images alike; where a curve ends they may be those of another."""
    middle = len(curve.values) // 2
    orbit = curve.orbit[middle : middle + 1]
    counts = orbit_properties.counts(orbit)
    merge = np.asarray(orbit.pair.symmetric)
    return str(label(counts.period, counts.left, counts.right, merge_mirrors=merge)[0])


def _texts(words: list[str]) -> np.ndarray:
    return np.array(words, dtype=np.dtypes.StringDType())


def _table(rows: list[list[str]], width: int) -> np.ndarray:
    """Make a table of words of rows of several lengths."""
    return _texts([word for row in rows for word in row + [""] * (width - len(row))]).reshape(len(rows), width)
