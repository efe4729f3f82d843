"""Pictures of a motion: the curve agrees with the motion, and impacts lie on the walls."""

import dataclasses

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


def test_drawn_motion_reaches_the_walls_at_its_impacts(path, tmp_path):
    figure = vijax.plots.trajectory(PAIR, path)
    over_time, plane = figure.axes
    count = int(path.filled)
    onset = (2 * np.asarray(path.impacts.n) + np.asarray(path.impacts.t))[:count]
    side = np.asarray(path.impacts.side)[:count]
    np.testing.assert_array_equal(points(over_time, "tab:red"), np.stack([onset, 0.1 * side], axis=1))
    np.testing.assert_array_equal(points(plane, "tab:red")[:, 1], np.asarray(path.impacts.v_in)[:count])
    # The curve passes through all onsets, and through the states at phase 0 up to the spacing of its points.
    line = points(over_time, "black")
    at_onset = np.interp(onset, *line[np.isfinite(line).all(axis=1)].T)
    np.testing.assert_allclose(at_onset, 0.1 * side, atol=1e-12)
    strobes = points(plane, "tab:blue")
    inside = np.arange(1, 7) * 2.0
    visible = (inside > onset[0]) & (inside < onset[-1])
    drawn = np.interp(inside[visible], *line[np.isfinite(line).all(axis=1)].T)
    np.testing.assert_allclose(drawn, strobes[visible, 0], atol=1e-3)
    vijax.plots.save(figure, tmp_path / "motion.png")
    assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")


def test_invalid_paths_raise(path):
    with pytest.raises(ValueError, match=r"path must be of a single start; got impacts of shape \(2, "):
        vijax.plots.trajectory(PAIR, vijax.trajectory(PAIR, np.array([0.02, 0.03]), 0.3, periods=6))
    wide = vijax.impact_pair(3.0, 40.0, 0.5)
    with pytest.raises(ValueError, match="path must hold an impact; got none"):
        vijax.plots.trajectory(wide, vijax.trajectory(wide, 0.0, 0.0, periods=2))
    with pytest.raises(ValueError, match="path must be"):
        vijax.plots.trajectory(PAIR, path.impacts)
    with pytest.raises(ValueError, match="pair must have r, a number, for the contacts to be drawn"):
        vijax.plots.trajectory(dataclasses.replace(PAIR, r=None), path)


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_energies_over_time_agree_with_the_impacts(wall):
    """On the attractor the points belong to the orbit; a sweep computes its power independently."""
    device = vijax.Harvester(s=0.3, omega0=40.0, A=2.0, omega=4.0)
    pair, starts = device.pair(wall), vijax.sweep(device=device, wall=wall)
    settled = vijax.trajectory(pair, 0.02, 0.3, periods=300).states
    path = vijax.trajectory(pair, settled.u[-1], settled.v[-1], periods=4)
    upper, lower = vijax.plots.energies(pair, path, device).axes
    count = int(path.filled)
    assert count == 8
    absorbed, harvested = points(lower, "tab:orange"), points(lower, "tab:green")
    assert absorbed.shape == harvested.shape == (count, 2)
    onset = (2 * np.asarray(path.impacts.n) + np.asarray(path.impacts.t))[:count]
    np.testing.assert_array_equal(harvested[:, 0], onset)
    np.testing.assert_allclose(harvested[:, 1].sum() / 8, float(starts.P), rtol=1e-9)
    np.testing.assert_allclose((harvested[:, 1] / absorbed[:, 1]).max(), float(starts.energy_ratio), rtol=1e-9)
    # At an onset the curve equals the kinetic energy of the ball.
    line = points(upper, "black")
    speed = np.asarray(path.impacts.v_in)[:count] * float(device.speed_unit)
    at_onset = [line[np.flatnonzero(line[:, 0] == time)[-2 if wall == "rigid" else 0], 1] for time in onset[1:-1]]
    np.testing.assert_allclose(at_onset, 0.5 * device.m_b * speed[1:-1] ** 2, rtol=1e-6)


def test_inadmissible_impacts_are_crossed_out():
    path = vijax.trajectory(PAIR, 0.02, 0.3, periods=6)
    count = int(path.filled)
    for device, crossed in (
        (vijax.Harvester(penetration_limit=np.inf), 0),
        (vijax.Harvester(penetration_limit=1e-9), count),
        (vijax.Harvester(penetration_limit=np.inf, V=1e5), count),
    ):
        lower = vijax.plots.energies(PAIR, path, device).axes[1]
        assert sum(len(line.get_xdata()) for line in lower.lines if line.get_marker() == "x") == crossed
    elastic = vijax.impact_pair(0.2, 40.0, 1.0)
    lower = vijax.plots.energies(elastic, vijax.trajectory(elastic, 0.02, 0.3, periods=6)).axes[1]
    assert len(points(lower, "tab:orange")) == 0  # an elastic membrane absorbs no energy
