"""Curves over the map of a page: validation, selection, curves through a cell, and recipes."""

from dataclasses import replace

import numpy as np
import pytest

import vijax
from tests.explorer.drawn_curves import drawn_curves
from tests.helpers import no_cell_runs
from vijax.explorer import explore, overlay, view
from vijax.explorer.analyses import recipes, results
from vijax.explorer.plane import explored
from vijax.explorer.source import Source
from vijax.plots.curve_lines import KINDS

AXES = {"d": np.linspace(0.2, 0.3, 3), "kappa": np.geomspace(20.0, 320.0, 3)}  # edges at 0.225, 0.275 and 40, 160


@pytest.fixture(scope="module", autouse=True)
def _without_cell_runs():
    """Make maps without cell runs; curves do not depend on cell results."""
    with no_cell_runs():
        yield


@pytest.fixture(scope="module")
def power():
    return vijax.sweep(**AXES)


@pytest.fixture(scope="module")
def plane(power):
    return explored(power)


def selected(plane, how, dataset=None):
    curves = overlay.read_curves(drawn_curves() if dataset is None else dataset)
    return overlay.select_curves(curves, plane, plane.sliced({}), how)


def test_option_selects_stable_all_or_no_curves(plane):
    drawn = {how: [(piece.kind, piece.stable) for piece in selected(plane, how).pieces] for how in overlay.CURVES}
    assert drawn["shown"] == [("fold", True)]
    assert drawn["unstable"] == [("fold", True), ("grazing", False)]
    assert drawn["hidden"] == []


def test_legend_counts_kinds_of_curves_and_points_are_listed(plane):
    selection = selected(plane, "unstable")
    assert results.curves_legend(selection) == [
        ["#d62728", (), "fold", 1],
        ["#2ca02c", KINDS["grazing"]["dashes"], "grazing", 1],
    ]
    twice = drawn_curves()
    twice["stable"][0, 0] = 0  # a curve with stable and unstable parts counts once
    assert [row[2:] for row in results.curves_legend(selected(plane, "unstable", twice))] == [
        ["fold", 1],
        ["grazing", 1],
    ]
    assert results.curves_points(selection, plane)[1:] == [["1", "cusp", "0.272", "80"]]


def test_curves_through_a_cell_are_listed(plane):
    selection = selected(plane, "unstable")
    through = [[overlay.through(selection, plane, (column, row)) for column in range(3)] for row in range(3)]
    assert through == [
        [[], ["fold of 1:1"], []],
        [["grazing of 1:2"], ["fold of 1:1", "grazing of 1:2"], ["grazing of 1:2"]],
        [[], ["fold of 1:1"], []],
    ]
    assert results.curves_row(selection, plane, (0, 0)) == [["curves here", "none"]]


@pytest.mark.parametrize(
    ("change", "must"),
    [
        (
            lambda dataset: dataset.rename(kappa="A").assign_attrs(along="d A"),
            "the axes of the map, d and kappa; got d and A",
        ),
        (lambda dataset: dataset.assign_coords(r=0.6), r"the r of the map, 0\.5; got 0\.6"),
        (lambda dataset: dataset.assign_attrs(wall="rigid"), "the wall of the map, soft; got rigid"),
    ],
)
def test_curves_of_another_pair_raise_with_advice(power, tmp_path, monkeypatch, change, must):
    monkeypatch.setattr(explore, "run", lambda *_: None)  # a started server would not return
    vijax.save(power, tmp_path / "plane.zarr")
    for source, advice in (
        (power, "vijax.bifurcation_curves"),
        (tmp_path / "plane.zarr", "vijax curves --map .*plane.zarr"),
    ):
        with pytest.raises(ValueError, match=f"curves must have {must}; compute them with {advice}"):
            vijax.explore(source, curves=change(drawn_curves()), browser=False)


@pytest.mark.parametrize(
    ("curves", "must"),
    [
        (3, "curves must be a dataset"),
        (drawn_curves().drop_vars("stable"), "curves must hold kind"),
        (drawn_curves().assign_attrs(along="d"), "curves must have the attribute along with two axes"),
        (drawn_curves().assign(kind=("curve", ["fold", "bend"])), "curves must be among fold, .*; got 'bend'"),
    ],
)
def test_invalid_curves_raise_before_the_map_is_read(curves, must):
    with pytest.raises(ValueError, match=must):
        Source("nowhere.zarr", curves)


def test_table_of_curves_raises_and_requests_the_store(tmp_path):
    (tmp_path / "curves.csv").write_text("kind\n")
    with pytest.raises(OSError, match=r"curves: .*curves\.csv; give the store"):
        Source(None, tmp_path / "curves.csv")


def test_curves_of_another_value_are_removed_with_a_note(power):
    several = explored(vijax.sweep(**AXES, r=[0.5, 0.6]))
    curves = overlay.read_curves(drawn_curves())
    overlay.check(curves, several, None)
    assert overlay.select_curves(curves, several, several.sliced({}), "shown").pieces
    selection = overlay.select_curves(curves, several, several.sliced({"r": 0.6}), "shown")
    assert selection.pieces == ()
    assert selection.note == "The curves are not drawn: their r is 0.5, here it is 0.6."


@pytest.mark.parametrize("curves", ["shown", "unstable", "hidden"])
@pytest.mark.parametrize("stored", [False, True])
def test_recipe_draws_the_map_with_its_curves(power, tmp_path, monkeypatch, curves, stored):
    monkeypatch.chdir(tmp_path)
    vijax.save(power, "plane.zarr")
    vijax.save(drawn_curves(), "curves.zarr")
    source = Source("plane.zarr", "curves.zarr") if stored else Source(power, "curves.zarr")
    plane = source.plane()
    map_view = replace(view.first_view(plane), variable="label", curves=curves)
    recipe = recipes.of_map(source, plane, map_view, False, curves != "hidden")
    namespace: dict = {}
    exec(recipe.python, namespace)
    assert (tmp_path / "map.png").stat().st_size > 10_000
    assert (namespace["dataset"]["period"].values == power["period"].values).all()
    assert ("curves" in namespace) == (curves != "hidden")
    page = "sweep" if curves == "hidden" else "curves"
    assert recipe.command.startswith(f"vijax {page} ")
    assert ("--unstable" in recipe.command) == ("unstable=True" in recipe.python) == (curves == "unstable")
    assert ("--map plane.zarr" in recipe.command) == (stored and curves != "hidden")
