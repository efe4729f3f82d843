"""Small multiples: places of panels, walls, reference lines, legend and caption."""

import numpy as np
import pytest

from scripts.paper.portrait import Layer, Panel, _wrapped, phase_plane, small_multiples, time_series
from vijax.orbits.motion import Curve

CIRCLE = np.linspace(0, 2 * np.pi, 50)
PLANE = phase_plane("$d = 0.2$", [Layer(np.cos(CIRCLE), np.sin(CIRCLE), "black", "line", "first")], 0.2)
SWEEP = Panel("", "$d$", "speed", [Layer([0.1, 0.2], [[1.0, np.nan], [2.0, 3.0]][0], "tab:blue", "dots", "soft")])


def test_panels_are_drawn_in_their_places(tmp_path):
    file = tmp_path / "figure.png"
    figure = small_multiples({"a": SWEEP, "b": PLANE}, ("aab",), "Fig. 0. Two panels.", file)
    assert file.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]
    sweep, plane = figure.axes
    assert sweep.get_title(loc="left") == "(a) "
    assert plane.get_title(loc="left") == "(b) $d = 0.2$"
    assert sweep.get_position().x0 < plane.get_position().x0
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["soft", "first"]
    assert legend.get_title().get_text() == "Fig. 0. Two panels."


def test_walls_are_drawn_at_half_the_gap():
    plane = small_multiples({"a": PLANE}, ("a",)).axes[0]
    walls = [line.get_xdata()[0] for line in plane.lines if line.get_color() == "firebrick"]
    assert sorted(walls) == [-0.1, 0.1]


def test_reference_lines_and_scales():
    panel = SWEEP._replace(upright=(0.12, 0.2), level=[(1.5, "tab:blue")], log="x", span=(0.05, 0.3))
    axes = small_multiples({"a": panel}, ("a",)).axes[0]
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_xlim()) == ("log", "linear", (0.05, 0.3))
    assert [line.get_xdata()[0] for line in axes.lines if line.get_color() == "red"] == [0.12, 0.2]
    assert [line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == "--"][-1] == 1.5


def test_a_continued_panel_has_no_letter():
    figure = small_multiples({"a": PLANE, "A": PLANE}, ("a", "A"))
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["(a) $d = 0.2$", "$d = 0.2$"]


def test_ball_at_rest_in_the_frame_of_the_ground_is_a_straight_line():
    t = np.linspace(0.0, 4.0, 81)
    curve = Curve(t, -np.cos(np.pi * t) / np.pi**2, np.sin(np.pi * t) / np.pi)
    panel = time_series("", curve, ([1.0], [0.1]), 0.2)
    *walls, ball, rings = panel.layers
    np.testing.assert_allclose(ball.y, 0.0, atol=1e-15)
    assert [float(wall.y[0]) for wall in walls] == pytest.approx([0.1 + np.pi**-2, -0.1 + np.pi**-2])
    assert float(rings.y[0]) == pytest.approx(0.1 - np.pi**-2)
    assert [height for height, _ in panel.level] == [0.1, -0.1]


def test_captions_break_between_words_and_not_in_formulas():
    lines = _wrapped("one two three $a = b$ four five", 12).split("\n")
    assert lines == ["one two", "three $a = b$", "four five"]


def test_layout_and_panels_must_agree():
    with pytest.raises(ValueError, match=r"layout must name the panels \['a'\]; got \['b'\]"):
        small_multiples({"a": PLANE}, ("b",))
