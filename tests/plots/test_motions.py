"""The picture of one motion: what is drawn lies on the motion, and the impacts on the walls."""

import numpy as np
import pytest

import vijax

PAIR = vijax.impact_pair(0.2, 40.0, 0.5)


@pytest.fixture(scope="module")
def path() -> vijax.Trajectory:
    return vijax.trajectory(PAIR, 0.02, 0.3, periods=6)


def points(axes, colour) -> np.ndarray:
    (line,) = [line for line in axes.lines if line.get_color() == colour]
    return line.get_xydata()


def test_the_ball_meets_the_walls_where_the_impacts_are(path, tmp_path):
    figure = vijax.plots.trajectory(PAIR, path)
    over_time, plane = figure.axes
    count = int(path.filled)
    onset = (2 * np.asarray(path.impacts.n) + np.asarray(path.impacts.t))[:count]
    side = np.asarray(path.impacts.side)[:count]
    np.testing.assert_array_equal(points(over_time, "tab:red"), np.stack([onset, 0.1 * side], axis=1))
    np.testing.assert_array_equal(points(plane, "tab:red")[:, 1], np.asarray(path.impacts.v_in)[:count])
    # The ball is drawn through every onset, and through the states at phase 0 but for its curve's own spacing.
    line = points(over_time, "black")
    at_onset = np.interp(onset, *line[np.isfinite(line).all(axis=1)].T)
    np.testing.assert_allclose(at_onset, 0.1 * side, atol=1e-12)
    strobes = points(plane, "tab:blue")
    inside = np.arange(1, 7) * 2.0
    shown = (inside > onset[0]) & (inside < onset[-1])
    drawn = np.interp(inside[shown], *line[np.isfinite(line).all(axis=1)].T)
    np.testing.assert_allclose(drawn, strobes[shown, 0], atol=1e-3)
    vijax.plots.save(figure, tmp_path / "motion.png")
    assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_drawn_is_said(path):
    with pytest.raises(ValueError, match=r"path must be of a single start; got impacts of shape \(2, "):
        vijax.plots.trajectory(PAIR, vijax.trajectory(PAIR, np.array([0.02, 0.03]), 0.3, periods=6))
    wide = vijax.impact_pair(3.0, 40.0, 0.5)
    with pytest.raises(ValueError, match="path must hold an impact; got none"):
        vijax.plots.trajectory(wide, vijax.trajectory(wide, 0.0, 0.0, periods=2))
    with pytest.raises(ValueError, match="path must be"):
        vijax.plots.trajectory(PAIR, path.impacts)
