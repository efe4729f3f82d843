"""Maps of many starts: expected P and attractors, against the tables of `basin_fractions`."""

import threading
from concurrent.futures import CancelledError

import numpy as np
import pytest

import vijax
from vijax import plots
from vijax.explorer.plane import explored
from vijax.maps import sweep
from vijax.maps.execution import dispatch
from vijax.maps.start_statistics import SUMMARY_FIELDS, StartStatistics
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.records import Status
from vijax.runtime.tiles import tile_devices

PLANE = {"d": np.array([0.1, 0.19, 0.2, 0.28]), "kappa": np.array([3.2, 12.0, 60.0]), "r": 0.5}


@pytest.fixture(scope="module")
def level():
    return vijax.sweep(**PLANE, starts=24)


def assert_agrees(expected, table):
    """Compare a map with the table of the same starts; undecided and failed starts are not attractors."""
    share = table.fraction.isel(attractor=table.P.fillna(-1.0).argmax("attractor"))
    quantities = {
        "P": (table.fraction * table.P).sum("attractor"),
        "P_greatest": table.P.max("attractor"),
        "P_least": table.P.min("attractor"),
        "attractors": table.attractors,
        "best_share": share,
        "best_share_stderr": np.sqrt(share * (1 - share) / expected.attrs["starts"]),
    }
    for name, values in quantities.items():
        np.testing.assert_allclose(expected[name], values.transpose(*expected[name].dims), rtol=1e-12, atol=0)


def test_level_cells_agree_with_the_table_with_merged_mirror_images(level):
    table = vijax.basin_fractions(**PLANE, starts=24, merge_mirrors=True)
    assert_agrees(level, table)
    assert int(level.attractors.max()) > 1
    assert level.P.attrs["units"] == "J"
    assert "u0" not in level.coords
    np.testing.assert_array_equal(level.expected_over_best, level.P / level.P_greatest)


@pytest.mark.long
def test_inclined_cells_and_variants_agree_with_the_table():
    axes = {**PLANE, "gamma": 0.05, "A": [1.0, 2.0]}
    assert_agrees(vijax.sweep(**axes, starts=12), vijax.basin_fractions(**axes, starts=12))


def test_equal_power_of_all_starts_has_no_standard_error(level):
    cell = level.isel(d=-1, kappa=-1)
    assert int(cell.attractors) == 1
    assert float(cell.P_stderr / cell.P) < 1e-10
    assert float(abs(cell.expected_over_best - 1)) < 1e-10


def test_store_equals_the_map_in_memory(level, tmp_path):
    stored = vijax.sweep(**PLANE, starts=24, out=tmp_path / "expected.zarr")
    for name in level:
        np.testing.assert_array_equal(stored[name], level[name])
    again = vijax.sweep(**PLANE, starts=24, out=tmp_path / "expected.zarr")  # The store is complete.
    assert again.attrs["starts"] == 24
    with pytest.raises(FileExistsError):
        vijax.sweep(**PLANE, starts=25, out=tmp_path / "expected.zarr")


def start(power, period, left, right, status=Status.OK):
    """Return the fields of one start for two cells on the same attractor with different P."""
    common = {name: np.full(2, 0.5) for name in SUMMARY_FIELDS}
    integers = {name: np.full(2, value) for name, value in zip(("period", "impacts_left"), (period, left), strict=True)}
    energies = {"P": np.array([[power], [2 * power]]), "energy_ratio": np.full((2, 1), power)}
    return common | integers | {"impacts_right": np.full(2, right), "status": np.full(2, int(status))} | energies


def test_statistics_of_five_starts():
    """Two starts on one orbit, one on its mirror image, one chaotic, one undecided; only the first cell is level."""
    statistics = StartStatistics(np.array([True, False]))
    rows = [(1.0, 1, 1, 2), (1.0, 1, 1, 2), (1.0, 1, 2, 1), (4.0, 0, -1, -1), (3.0, -1, -1, -1, Status.SLOW)]
    for row in rows:
        statistics.add(start(*row))
    result = statistics.fields()
    np.testing.assert_allclose(result["P"][:, 0], [2.0, 4.0])
    np.testing.assert_allclose(result["P_stderr"][0, 0], np.std([1, 1, 1, 4, 3], ddof=1) / 5**0.5)
    assert result["attractors"].tolist() == [2, 3]
    assert result["undecided"].tolist() == [0.2, 0.2]
    assert result["best_share"][:, 0].tolist() == [0.2, 0.2]
    assert (result["P_least"][0, 0], result["P_greatest"][0, 0]) == (1.0, 4.0)
    assert result["energy_ratio"][0, 0] == 4.0
    assert result["status"].tolist() == [Status.OK] * 2
    statistics.add(start(np.nan, -1, -1, -1, Status.EVENT_BUDGET))
    failed = statistics.fields()
    assert np.isnan(failed["P"]).all()
    assert failed["status"].tolist() == [Status.EVENT_BUDGET] * 2


def test_a_run_stops_between_two_starts():
    planned, stopped = sweep.plan({"d": 0.2, "kappa": 40.0, "r": 0.5}, starts=1000), threading.Event()
    stopped.set()
    with pytest.raises(CancelledError):
        dispatch.run_call(dispatch.Call(planned, np.arange(1), 8, 0), tile_devices()[0], stopped)


RECORD = vijax.Record(np.arange(0.0, 9.0, 0.5), np.ones(18))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"v0": 0.1}, "v0 must be left out where cells have several starts; got 0.1"),
        ({"refine": 1}, "refine must be left out where cells have several starts; got 1"),
        ({"starts": 0}, "starts must be"),
        ({"starts": 2.5}, "starts must be"),
        ({"until": "window"}, "until must be left out of a map of several starts; got 'window'"),
        ({"dtype": "float32"}, "dtype must be left out of a map of several starts"),
        ({"outputs": ["period"]}, "outputs must"),
        (
            {"excitation": RECORD},
            "excitation must be left out of a map of several starts; got record .*; vijax.response",
        ),
        ({"excitation": RECORD, "until": "window"}, "excitation must be left out of a map of several starts"),
    ],
)
def test_invalid_arguments_are_rejected(change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        vijax.sweep(**{**PLANE, "starts": 4, **change})


@pytest.mark.long
def test_settings_change_the_map():
    axes = {"d": 0.1, "kappa": 60.0, "r": 0.5, "starts": 4}
    soft, short = vijax.sweep(**axes), vijax.sweep(**axes, periods=SweepSettings.periods // 40)
    rigid = vijax.sweep(**axes, wall="rigid")
    assert len({float(dataset.P) for dataset in (soft, short, rigid)}) == 3


def test_explorer_and_curves_require_a_map_of_a_single_start(level):
    with pytest.raises(ValueError, match="dataset must have one start in every cell"):
        explored(level)
    with pytest.raises(ValueError, match="dataset must hold period"):
        vijax.bifurcation_curves(level)


def test_plots_mark_cells_with_several_attractors(level):
    for figure in (plots.power_map(level), plots.variable_map(level, "best_share")):
        texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert "border of several attractors" in texts
