"""Curves of bifurcations by hand: nothing is followed, and where they lie is known."""

import numpy as np
import xarray as xr

FOLD_AT, GRAZING_AT = 0.272, 80.0  # gap of a fold at every stiffness, and stiffness of a grazing at every gap


def drawn_curves(label: str = "1:1", **constants: float) -> xr.Dataset:
    """Make a fold up the map of d and kappa, a grazing of unstable orbits across it, and a cusp where they meet."""
    words, dims = np.dtypes.StringDType(), ("curve", "point")
    d = np.array([[FOLD_AT, FOLD_AT, FOLD_AT], [0.1, 0.25, 0.4]])
    kappa = np.array([[3.0, GRAZING_AT, 4000.0], [GRAZING_AT] * 3])
    one = np.ones((2, 3))
    return xr.Dataset(
        {
            "kind": ("curve", np.array(["fold", "grazing"], words)),
            "label": ("curve", np.array([label, "1:2"], words)),
            "end_first": ("curve", np.array(["low", "low"], words)),
            "end_last": ("curve", np.array(["high", "high"], words)),
            "multiplier": (dims, one),
            "stable": (dims, one * [[1], [0]]),
            "event": (("curve", "event_number"), np.array([["cusp"], [""]], words)),
            "event_d": (("curve", "event_number"), [[FOLD_AT], [np.nan]]),
            "event_kappa": (("curve", "event_number"), [[GRAZING_AT], [np.nan]]),
        },
        coords={"d": (dims, d), "kappa": (dims, kappa)} | {"r": 0.5, "gamma": 0.0} | constants,
        attrs={"along": "d kappa", "wall": "soft"},
    )
