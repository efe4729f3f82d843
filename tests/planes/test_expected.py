"""Maps of many starts: P expected of them, and the attractors that share them, as `basin_fractions` finds these."""

import threading
from concurrent.futures import CancelledError

import numpy as np
import pytest

import vijax
from vijax import plots
from vijax.explorer.plane import explored
from vijax.model.records import Status
from vijax.planes import dispatch, sweep
from vijax.planes.expected import NEEDS, ManyStarts
from vijax.planes.sweep_settings import SweepSettings
from vijax.runtime.tiles import places

PLANE = {"d": np.array([0.1, 0.19, 0.2, 0.28]), "kappa": np.array([3.2, 12.0, 60.0]), "r": 0.5}


@pytest.fixture(scope="module")
def level():
    return vijax.sweep(**PLANE, starts=24)


def assert_agrees(expected, table):
    """Compare a map with the table of the same starts, whose undecided and failed ones are no attractors."""
    share = table.fraction.isel(attractor=table.P.fillna(-1.0).argmax("attractor"))
    asked = {
        "P": (table.fraction * table.P).sum("attractor"),
        "P_greatest": table.P.max("attractor"),
        "P_least": table.P.min("attractor"),
        "attractors": table.attractors,
        "best_share": share,
        "best_share_stderr": np.sqrt(share * (1 - share) / expected.attrs["starts"]),
    }
    for name, values in asked.items():
        np.testing.assert_allclose(expected[name], values.transpose(*expected[name].dims), rtol=1e-12, atol=0)


def test_level_cells_are_those_of_the_table_with_mirror_images_merged(level):
    table = vijax.basin_fractions(**PLANE, starts=24, merge_mirrors=True)
    assert_agrees(level, table)
    assert int(level.attractors.max()) > 1
    assert level.P.attrs["units"] == "J"
    assert "u0" not in level.coords
    np.testing.assert_array_equal(level.expected_over_best, level.P / level.P_greatest)


@pytest.mark.long
def test_inclined_cells_and_variants_are_those_of_the_table():
    axes = {**PLANE, "gamma": 0.05, "A": [1.0, 2.0]}
    assert_agrees(vijax.sweep(**axes, starts=12), vijax.basin_fractions(**axes, starts=12))


def test_where_all_starts_harvest_alike_there_is_no_error(level):
    alone = level.isel(d=-1, kappa=-1)
    assert int(alone.attractors) == 1
    assert float(alone.P_stderr / alone.P) < 1e-10
    assert float(abs(alone.expected_over_best - 1)) < 1e-10


def test_a_store_holds_the_same(level, tmp_path):
    kept = vijax.sweep(**PLANE, starts=24, out=tmp_path / "expected.zarr")
    for name in level:
        np.testing.assert_array_equal(kept[name], level[name])
    again = vijax.sweep(**PLANE, starts=24, out=tmp_path / "expected.zarr")  # All of it is there.
    assert again.attrs["starts"] == 24
    with pytest.raises(FileExistsError):
        vijax.sweep(**PLANE, starts=25, out=tmp_path / "expected.zarr")


def start(power, period, left, right, status=Status.OK):
    """Give the fields of one start of two cells that share an attractor but for P."""
    alike = {name: np.full(2, 0.5) for name in NEEDS}
    whole = {name: np.full(2, value) for name, value in zip(("period", "impacts_left"), (period, left), strict=True)}
    energies = {"P": np.array([[power], [2 * power]]), "energy_ratio": np.full((2, 1), power)}
    return alike | whole | {"impacts_right": np.full(2, right), "status": np.full(2, int(status))} | energies


def test_what_starts_add_up_to():
    """Two on one orbit, its mirror image, one that is chaotic, one without a verdict: level in the first cell alone."""
    folded = ManyStarts(np.array([True, False]))
    rows = [(1.0, 1, 1, 2), (1.0, 1, 1, 2), (1.0, 1, 2, 1), (4.0, 0, -1, -1), (3.0, -1, -1, -1, Status.SLOW)]
    for row in rows:
        folded.add(start(*row))
    found = folded.fields()
    np.testing.assert_allclose(found["P"][:, 0], [2.0, 4.0])
    np.testing.assert_allclose(found["P_stderr"][0, 0], np.std([1, 1, 1, 4, 3], ddof=1) / 5**0.5)
    assert found["attractors"].tolist() == [2, 3]
    assert found["undecided"].tolist() == [0.2, 0.2]
    assert found["best_share"][:, 0].tolist() == [0.2, 0.2]
    assert (found["P_least"][0, 0], found["P_greatest"][0, 0]) == (1.0, 4.0)
    assert found["energy_ratio"][0, 0] == 4.0
    assert found["status"].tolist() == [Status.OK] * 2
    folded.add(start(np.nan, -1, -1, -1, Status.EVENT_BUDGET))
    failed = folded.fields()
    assert np.isnan(failed["P"]).all()
    assert failed["status"].tolist() == [Status.EVENT_BUDGET] * 2


def test_a_run_stops_between_two_starts():
    planned, stopped = sweep.plan({"d": 0.2, "kappa": 40.0, "r": 0.5}, starts=1000), threading.Event()
    stopped.set()
    with pytest.raises(CancelledError):
        dispatch.perform(dispatch.Call(planned, np.arange(1), 8, 0), places()[0], stopped)


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
def test_bad_input_is_told(change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        vijax.sweep(**{**PLANE, "starts": 4, **change})


@pytest.mark.long
def test_settings_that_are_read_change_the_map():
    axes = {"d": 0.1, "kappa": 60.0, "r": 0.5, "starts": 4}
    soft, short = vijax.sweep(**axes), vijax.sweep(**axes, periods=SweepSettings.periods // 40)
    rigid = vijax.sweep(**axes, wall="rigid")
    assert len({float(one.P) for one in (soft, short, rigid)}) == 3


def test_what_runs_cells_from_one_start_wants_a_map_of_one(level):
    with pytest.raises(ValueError, match="dataset must have one start in every cell"):
        explored(level)
    with pytest.raises(ValueError, match="dataset must hold period"):
        vijax.bifurcation_curves(level)


def test_pictures_tell_where_there_are_several_attractors(level):
    for figure in (plots.power_map(level), plots.variable_map(level, "best_share")):
        texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert "border of several attractors" in texts
