"""The paper's figures: the panels and parameters of every figure match its caption."""

import numpy as np
import pytest

from scripts.paper import captions
from scripts.paper.captions import FIGURES

NUMBERS = range(3, 17)


def runs(number: int) -> list[captions.Run]:
    return [source.run for view in FIGURES[number].views for source in view.sources]


def fixed_axes(run: captions.Run) -> dict:
    return dict(run.axes)


def test_all_figures_are_described():
    assert list(FIGURES) == list(NUMBERS)


@pytest.mark.parametrize(
    ("number", "letters"),
    [
        (3, "abcdefgh"),
        (4, "ab"),
        (5, "abcdefghij"),
        (6, "abcd"),
        (7, "abc"),
        *((number, "abcd") for number in (8, 9, 10, 11, 16)),
        (12, "abcdefghij"),
        *((number, "abcdef") for number in (13, 14, 15)),
    ],
)
def test_panels_match_the_caption(number, letters):
    figure = FIGURES[number]
    panel_letters = {view.letter for view in figure.views}
    assert "".join(sorted(letter for letter in panel_letters if letter.islower())) == letters
    assert panel_letters == set("".join(figure.layout)) - {"."}
    assert len({len(row) for row in figure.layout}) == 1


@pytest.mark.parametrize("number", NUMBERS)
def test_values_of_single_points_are_points_of_the_sweep(number):
    for view in FIGURES[number].views:
        for source in view.sources:
            axes = fixed_axes(source.run) | {source.run.along: source.run.values}
            for name, value in source.where.items():
                assert np.min(np.abs(np.atleast_1d(axes[name]) - value)) < 1e-12, (view.letter, name)


@pytest.mark.parametrize(("number", "r"), [(8, 0.5), (9, 0.1), (10, 0.95)])
def test_sweeps_over_the_gap(number, r):
    for run in runs(number):
        assert (run.along, run.direction, run.wall, run.periods, run.recorded_periods) == ("d", "down", "soft", 400, 25)
        assert fixed_axes(run) == {"r": r, "kappa": (400.0, 126.5, 40.0, 12.65, 4.0)}
        assert (max(run.values), min(run.values), len(run.values)) == (0.3, 0.05, 126)


@pytest.mark.parametrize(("number", "r"), [(13, 0.5), (14, 0.1), (15, 0.95)])
def test_sweeps_over_the_frequency(number, r):
    for run in runs(number):
        assert (run.along, run.direction, run.wall) == ("omega", "up", "soft")
        assert fixed_axes(run) == {"s": 0.2, "r": r, "k": (560.0, 56.0, 5.6, 0.56, 0.056)}
        assert (min(run.values), max(run.values)) == (0.5, 14.99)
    assert "0.5 to 15" in FIGURES[number].chosen


def test_rigid_start_of_fig_3_is_also_used_in_fig_5():
    starts = {(fixed_axes(run)["u0"], fixed_axes(run)["v0"]) for run in runs(3) if "u0" in fixed_axes(run)}
    assert starts == {(0.13746, 0.61685)}
    overlay = {run for run in runs(5) if run.wall == "rigid" and run.along == "d" and "u0" in fixed_axes(run)}
    assert {(fixed_axes(run)["u0"], fixed_axes(run)["v0"]) for run in overlay} == {(0.13746, 0.61685)}
    assert {fixed_axes(run)["kappa"] for run in runs(5) if run.wall == "soft"} == {400.0}


def test_fig_6_sweeps_kappa_400_over_n_both_ways_at_0_2_alone():
    np.testing.assert_allclose(400 / np.array(runs(6)[0].values), np.arange(1, 134), rtol=1e-14)
    ways = {view.letter: {source.run.direction for source in view.sources} for view in FIGURES[6].views}
    assert ways == {"a": {"down", "up"}, "b": {"down"}, "c": {"down"}, "d": {"down"}}
    assert [view.sources[0].where["d"] for view in FIGURES[6].views] == [0.2, 0.18, 0.16, 0.12]


def test_phase_planes_are_at_the_values_of_the_captions():
    points = {
        (number, view.letter): view.sources[0].where
        for number in (3, 5, 11, 12)
        for view in FIGURES[number].views
        if view.shows in ("phase plane", "section", "chaos")
    }
    assert {points[number, letter]["d"] for number in (3, 5) for letter in "cdef"} == {0.12, 0.16, 0.18, 0.2}
    assert points[11, "b"] == {"d": 0.12, "kappa": 12.65}
    assert [points[12, letter]["omega"] for letter in "cdef"] == [np.pi / 3, np.pi, 7.79, 10.99]
    springs = [(source.where["k"], source.where["omega"]) for source in FIGURES[16].views[1].sources]
    assert springs == [(560.0, 10.0), (56.0, 10.0), (5.6, 10.5)]
    restitutions = [{fixed_axes(source.run)["r"] for source in view.sources} for view in FIGURES[16].views]
    assert restitutions == [{0.5}, {0.5}, {0.1}, {0.95}]


def test_colour_of_a_stiffness_is_the_same_in_all_figures():
    colours = {}
    for number in (8, 9, 10, 11):
        for view in FIGURES[number].views:
            for source in view.sources:
                if "kappa" in source.where:
                    colours.setdefault(source.where["kappa"], set()).add(source.colour)
    assert all(len(names) == 1 for names in colours.values())
    assert len(colours) == 5


def test_errors_of_the_captions_are_stated():
    assert "corrupt" in FIGURES[16].chosen
    for number in (3, 5, 12, 13, 14, 15):
        assert "mJ cannot be meant" in FIGURES[number].chosen
