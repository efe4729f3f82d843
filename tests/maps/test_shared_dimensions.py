"""Axes that share a named dimension are combined element by element: a list of devices is a sweep."""

import numpy as np
import pytest
import xarray as xr

import vijax
from tests.helpers import stand_in
from vijax.maps import orbit_diagram as diagram
from vijax.maps import sweep
from vijax.simulation import simulate

TRAVEL, FREQUENCY = [0.01, 0.02, 0.015], [90.0, 120.0, 200.0]


def along(values, labels=None, dim="device"):
    return xr.DataArray(values, dims=dim, coords={} if labels is None else {dim: labels})


def devices(**labels):
    return {"s": along(TRAVEL, **labels), "omega0": along(FREQUENCY, **labels)}


@pytest.fixture
def no_engine(monkeypatch):
    """Replace the engine by a stand-in, so that sweeps simulate no cell."""
    monkeypatch.setattr(simulate, "summarise", stand_in)


def test_a_list_of_devices_is_a_sweep():
    result = vijax.sweep(**devices(labels=["a", "b", "c"]), omega=20.0, A=[1.0, 3.0], periods=20, outputs=["P"])
    assert result.P.dims == ("device", "A")
    assert result.sizes == {"device": 3, "A": 2}
    for index, (s, omega0) in enumerate(zip(TRAVEL, FREQUENCY, strict=True)):
        single = vijax.sweep(s=s, omega0=omega0, omega=20.0, A=[1.0, 3.0], periods=20, outputs=["P"])
        np.testing.assert_allclose(result.P[index], single.P, rtol=1e-12)
        assert float(result.sel(device="abc"[index]).kappa) == float(single.kappa)


@pytest.mark.parametrize("labels", [None, [3, 5, 8]])
def test_store_of_devices_equals_the_map_in_memory(no_engine, tmp_path, labels):
    axes = devices(labels=labels) | {"r": [0.4, 0.5]}
    expected, path = vijax.sweep(**axes), tmp_path / "map.zarr"
    for _ in range(2):  # the second call resumes the store of the first
        vijax.sweep(**axes, out=path)
    xr.testing.assert_identical(vijax.load(path).drop_attrs(), expected.drop_attrs())
    assert expected.device.values.tolist() == (labels or [0, 1, 2])


def test_path_through_a_plane_is_an_axis_with_another_along_it(no_engine):
    result = vijax.sweep(omega0=FREQUENCY, s=along(TRAVEL, dim="omega0"))
    assert result.P.dims == ("omega0",)
    np.testing.assert_array_equal(result.s, TRAVEL)
    chains = diagram.plan("omega0", FREQUENCY, {"s": along(TRAVEL, dim="omega0")})
    assert chains.plan.cells.quantities["d"].dims == ("omega0",)


def test_units_are_converted_on_a_named_dimension(no_engine):
    import pint

    units = pint.UnitRegistry()
    result = sweep.plan({"s": xr.DataArray(units.Quantity([1.0, 2.0], "cm"), dims="device")})
    np.testing.assert_allclose(result.cells.axes["s"], [0.01, 0.02], rtol=1e-15)


def test_devices_are_plotted_by_number(no_engine):
    result = vijax.sweep(**devices(labels=["a", "b", "c"]), A=[1.0, 2.0])
    for figure in (
        vijax.plots.power_map(result),
        vijax.plots.label_map(result),
        vijax.plots.power_map(result.isel(A=0)),
    ):
        assert figure.axes[0].get_xlabel() == "$device$"


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (
            {"s": along(TRAVEL), "omega0": along(FREQUENCY[:2])},
            "s and omega0 must be of one length, as both have the dimension device; got 3 and 2",
        ),
        (
            {"s": along(TRAVEL, [1, 2, 3]), "omega0": along(FREQUENCY, [1, 2, 4])},
            "s and omega0 must have the same coordinates along device",
        ),
        ({"s": along(TRAVEL, dim="omega0")}, "s must not have the dimension omega0, an axis that is not given"),
        (
            {"s": along(TRAVEL, [1, 2, 3], dim="omega0"), "omega0": FREQUENCY},
            "s must have the values of omega0 along it",
        ),
        ({"s": along(TRAVEL, dim="status")}, "dimension status must not have the name of a variable of the map"),
        ({"s": along([TRAVEL], dim=("x", "y"))}, "s must be a number or a 1-D array"),
        ({"s": along(TRAVEL, np.array(["2001", "2002", "2003"], "M8[ns]"))}, "s must have numbers or texts along"),
        (devices() | {"refine": 1}, "refine must be left out where axes share a dimension, here device"),
        (devices(labels=["a", "b", "c"]) | {"out": "map.zarr"}, "out must be left out where device has texts"),
    ],
)
def test_incompatible_axes_are_rejected(axes, message):
    with pytest.raises(ValueError, match=message):
        vijax.sweep(**axes)
