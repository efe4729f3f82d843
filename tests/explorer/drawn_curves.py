"""Artificial bifurcation curves at known places, made without continuation."""

import numpy as np
import xarray as xr

FOLD_AT, GRAZING_AT = 0.272, 80.0  # gap of the fold at all stiffnesses; stiffness of the grazing at all gaps


def drawn_curves(label: str = "1:1", **constants: float) -> xr.Dataset:
    """Return a fold along kappa, a grazing of unstable orbits along d, and a cusp at their intersection."""
    words, dims = np.dtypes.StringDType(), ("curve", "point")
    d = np.array([[FOLD_AT, FOLD_AT, FOLD_AT], [0.1, 0.25, 0.4]])
    kappa = np.array([[3.0, GRAZING_AT, 4000.0], [GRAZING_AT] * 3])
    ones = np.ones((2, 3))
    return xr.Dataset(
        {
            "kind": ("curve", np.array(["fold", "grazing"], words)),
            "label": ("curve", np.array([label, "1:2"], words)),
            "end_first": ("curve", np.array(["low", "low"], words)),
            "end_last": ("curve", np.array(["high", "high"], words)),
            "multiplier": (dims, ones),
            "stable": (dims, ones * [[1], [0]]),
            "event": (("curve", "event_number"), np.array([["cusp"], [""]], words)),
            "event_d": (("curve", "event_number"), [[FOLD_AT], [np.nan]]),
            "event_kappa": (("curve", "event_number"), [[GRAZING_AT], [np.nan]]),
        },
        coords={"d": (dims, d), "kappa": (dims, kappa)} | {"r": 0.5, "gamma": 0.0} | constants,
        attrs={"along": "d kappa", "wall": "soft"},
    )
