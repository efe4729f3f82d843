"""Curves over the map of a page: which are of it, what is drawn of them, which enter a cell, how they are had again."""

from dataclasses import replace

import numpy as np
import pytest

import vijax
from tests.explorer.drawn_curves import drawn_curves
from tests.helpers import no_cell_runs
from vijax.explorer import answers, door, overlay, recipes, view
from vijax.explorer.plane import explored
from vijax.explorer.source import Source
from vijax.plots.curve_lines import KINDS

AXES = {"d": np.linspace(0.2, 0.3, 3), "kappa": np.geomspace(20.0, 320.0, 3)}  # edges at 0.225, 0.275 and 40, 160


@pytest.fixture(scope="module", autouse=True)
def _at_once():
    """Curves lie over a map whatever its cells do, so that no cell has to run."""
    with no_cell_runs():
        yield


@pytest.fixture(scope="module")
def power():
    return vijax.sweep(**AXES)


@pytest.fixture(scope="module")
def plane(power):
    return explored(power)


def laid(plane, how, dataset=None):
    curves = overlay.taken(drawn_curves() if dataset is None else dataset)
    return overlay.laid(curves, plane, plane.sliced({}), how)


def test_curves_of_unstable_orbits_are_drawn_on_request_and_none_where_they_are_hidden(plane):
    drawn = {how: [(one.kind, one.stable) for one in laid(plane, how).pieces] for how in overlay.CURVES}
    assert drawn["shown"] == [("fold", True)]
    assert drawn["unstable"] == [("fold", True), ("grazing", False)]
    assert drawn["hidden"] == []


def test_the_legend_counts_kinds_in_the_colours_of_the_pictures_and_points_are_listed(plane):
    found = laid(plane, "unstable")
    assert answers.curves_legend(found) == [
        ["#d62728", (), "fold", 1],
        ["#2ca02c", KINDS["grazing"]["dashes"], "grazing", 1],
    ]
    twice = drawn_curves()
    twice["stable"][0, 0] = 0  # a curve of both is one curve
    assert [row[2:] for row in answers.curves_legend(laid(plane, "unstable", twice))] == [["fold", 1], ["grazing", 1]]
    assert answers.curves_points(found, plane)[1:] == [["1", "cusp", "0.272", "80"]]


def test_a_cell_tells_the_curves_that_enter_it(plane):
    found = laid(plane, "unstable")
    through = [[overlay.through(found, plane, (column, row)) for column in range(3)] for row in range(3)]
    assert through == [
        [[], ["fold of 1:1"], []],
        [["grazing of 1:2"], ["fold of 1:1", "grazing of 1:2"], ["grazing of 1:2"]],
        [[], ["fold of 1:1"], []],
    ]
    assert answers.curves_row(found, plane, (0, 0)) == [["curves here", "none"]]


@pytest.mark.parametrize(
    ("change", "must"),
    [
        (lambda one: one.rename(kappa="A").assign_attrs(along="d A"), "the axes of the map, d and kappa; got d and A"),
        (lambda one: one.assign_coords(r=0.6), r"the r of the map, 0\.5; got 0\.6"),
        (lambda one: one.assign_attrs(wall="rigid"), "the wall of the map, soft; got rigid"),
    ],
)
def test_curves_of_another_pair_are_refused_at_the_door_with_what_to_do(power, tmp_path, monkeypatch, change, must):
    monkeypatch.setattr(door, "run", lambda *_: None)  # a server that is made would not end
    vijax.save(power, tmp_path / "plane.zarr")
    for source, advice in (
        (power, "vijax.bifurcation_curves"),
        (tmp_path / "plane.zarr", "vijax curves --map .*plane.zarr"),
    ):
        with pytest.raises(ValueError, match=f"curves must have {must}; its own are found by {advice}"):
            vijax.explore(source, curves=change(drawn_curves()), browser=False)


@pytest.mark.parametrize(
    ("given", "must"),
    [
        (3, "curves must be a dataset"),
        (drawn_curves().drop_vars("stable"), "curves must hold kind"),
        (drawn_curves().assign_attrs(along="d"), "curves must say along which two axes"),
        (drawn_curves().assign(kind=("curve", ["fold", "bend"])), "curves must be among fold, .*; got 'bend'"),
    ],
)
def test_what_are_no_curves_is_said_before_the_map_is_read(given, must):
    with pytest.raises(ValueError, match=must):
        Source("nowhere.zarr", given)


def test_a_table_of_rows_names_the_store_that_is_wanted(tmp_path):
    (tmp_path / "curves.csv").write_text("kind\n")
    with pytest.raises(OSError, match=r"curves: .*curves\.csv; give the store"):
        Source(None, tmp_path / "curves.csv")


def test_where_the_map_moves_to_another_value_its_curves_are_taken_off_with_a_word(power):
    several = explored(vijax.sweep(**AXES, r=[0.5, 0.6]))
    curves = overlay.taken(drawn_curves())
    overlay.check(curves, several, None)
    assert overlay.laid(curves, several, several.sliced({}), "shown").pieces
    found = overlay.laid(curves, several, several.sliced({"r": 0.6}), "shown")
    assert found.pieces == ()
    assert found.said == "The curves are not drawn: their r is 0.5, here it is 0.6."


@pytest.mark.parametrize("curves", ["shown", "unstable", "hidden"])
@pytest.mark.parametrize("stored", [False, True])
def test_the_lines_to_copy_draw_the_map_with_its_curves(power, tmp_path, monkeypatch, curves, stored):
    monkeypatch.chdir(tmp_path)
    vijax.save(power, "plane.zarr")
    vijax.save(drawn_curves(), "curves.zarr")
    source = Source("plane.zarr", "curves.zarr") if stored else Source(power, "curves.zarr")
    plane = source.plane()
    shown = replace(view.first_view(plane), variable="label", curves=curves)
    recipe = recipes.of_map(source, plane, shown, False, curves != "hidden")
    made: dict = {}
    exec(recipe.python, made)
    assert (tmp_path / "map.png").stat().st_size > 10_000
    assert (made["dataset"]["period"].values == power["period"].values).all()
    assert ("curves" in made) == (curves != "hidden")
    page = "sweep" if curves == "hidden" else "curves"
    assert recipe.command.startswith(f"vijax {page} ")
    assert ("--unstable" in recipe.command) == ("unstable=True" in recipe.python) == (curves == "unstable")
    assert ("--map plane.zarr" in recipe.command) == (stored and curves != "hidden")
