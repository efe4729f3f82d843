"""Curves of bifurcations: at their known places, with the multipliers that make them, ended where orbits end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import vijax
from vijax.model.device import Harvester
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import curves, orbit_search, periodic, shooting, switching
from vijax.orbits.shooting import Sequence

PLANE = {"d": (0.05, 0.35), "r": (0.02, 0.98)}


@pytest.fixture(scope="module")
def met():
    """What the symmetric period-1 orbits of rigid walls meet, closed half way, and those that bifurcate from them."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    return [point for branch in switching.family(start, "d", (0.1, 0.3)) for point in branch.points]


@pytest.fixture(scope="module")
def found(met):
    listed = curves.follow_curves(met, "d", PLANE)
    # Five points of three kinds: the two of a mirror pair lie on one curve.
    assert len(listed) == 3
    return {curve.kind: curve for curve in listed}


def pitchfork(r):
    """Give the gap at which the symmetric orbit of rigid walls breaks, in closed form (physics.md, 1:1 at gamma 0)."""
    q = (1 + r) / (np.pi * (1 - r))
    return (1 - 4 / np.pi**2) * q / np.sqrt(1 + 4 * q * q)


def test_every_curve_is_found_once(met, found):
    assert sorted(point.kind for point in met) == ["flip"] * 2 + ["grazing flight"] * 2 + ["pitchfork"]
    assert sorted(found) == ["flip", "grazing", "pitchfork"]


def test_the_pitchfork_is_where_it_is_known_to_be(found):
    d, r = found["pitchfork"].values.T
    np.testing.assert_allclose(d, pitchfork(r), rtol=0, atol=1e-13)
    assert found["pitchfork"].ends == ("r high", "pitchfork-graze")
    assert r.max() == pytest.approx(0.98, abs=1e-14)


def test_every_point_is_an_orbit_with_the_multiplier_that_makes_it_one(found):
    for kind, curve in found.items():
        assert (np.asarray(curve.orbit.residual) < 1e-12).all()
        assert (np.asarray(curve.orbit.status)[1:-1] == Status.OK).all()
        if kind == "grazing":
            continue
        largest = np.asarray(curve.orbit.multipliers)[:, 0]
        assert np.abs(largest - (-1 if kind == "flip" else 1)).max() < 1e-9
        counted = np.asarray(curve.orbit.count) * (2 if kind == "pitchfork" else 1)
        product = np.asarray(curve.orbit.multipliers).prod(axis=1).real
        np.testing.assert_allclose(product, curve.values[:, 1] ** (2 * counted), rtol=0, atol=1e-10)


def test_a_flip_meets_the_graze_of_its_orbit_where_the_graze_meets_the_flip(found):
    (end,) = found["flip"].points
    assert (end.kind, end.test) == ("flip-graze", "flight")
    (passed, last) = found["grazing"].points
    assert (passed.kind, last.kind) == ("flip-graze", "double graze")
    np.testing.assert_allclose(passed.values, end.values, rtol=0, atol=1e-9)


def test_the_stable_side_of_a_graze_is_told_by_the_orbit_that_touches(found):
    graze = found["grazing"]
    border = next(point.values[1] for point in graze.points if point.kind == "flip-graze")
    np.testing.assert_array_equal(graze.stable, graze.values[:, 1] < border)
    assert found["flip"].stable.all()


@pytest.fixture(scope="module")
def tilted():
    """Curves of the same orbit under gravity, where the symmetry of the walls is gone."""
    orbit = orbit_search.search(impact_pair(0.2, None, 0.5, 0.01), "RL", guesses=64)
    (branch,) = (one for one in switching.family(orbit, "d", (0.1, 0.35), max_switches=0) if len(one.points) == 3)
    points = [point for point in branch.points if point.kind in ("fold", "grazing flight")]
    return curves.follow_curves(points, "d", {"d": (0.05, 0.35), "gamma": (-0.2, 0.2)})


def test_gravity_unfolds_the_pitchfork_to_a_cusp(tilted):
    (fold,) = (curve for curve in tilted if curve.kind == "fold")
    (cusp,) = (point for point in fold.points if point.kind == "cusp")
    assert cusp.values[0] == pytest.approx(pitchfork(0.5), abs=1e-12)
    assert cusp.values[1] == pytest.approx(0, abs=1e-12)
    d, gamma = fold.values.T
    near = (np.abs(gamma) > 1e-6) & (np.abs(gamma) < 1e-3)
    power = np.polyfit(np.log(cusp.values[0] - d[near]), np.log(np.abs(gamma[near])), 1)[0]
    assert power == pytest.approx(1.5, abs=0.01)


def test_folds_end_at_their_graze_and_the_graze_goes_on(tilted):
    fold, graze = sorted(tilted, key=lambda curve: curve.kind)
    assert fold.ends == ("fold-graze", "fold-graze")
    (passed,) = (point for point in graze.points if point.kind == "fold-graze")
    assert min(np.abs(np.subtract(end.values, passed.values)).max() for end in fold.points) < 1e-9


def test_conditions_are_those_of_the_monodromy_matrix(met):
    for point in met:
        orbit = point.orbit
        pair, sequence, knots = (
            jax.tree.map(lambda x: x[0], leaf) for leaf in (orbit.pair, orbit.sequence, orbit.knots)
        )
        around = np.asarray(shooting.monodromy(pair, sequence, knots))
        both = shooting.multiplier_conditions(pair, sequence, knots)
        speed = np.asarray(knots)[:, 1]
        weight = np.prod(speed / (speed + 0.1))
        for sign, found in zip((-1, 1), both, strict=True):
            assert float(found) == pytest.approx(weight * np.linalg.det(around + sign * np.eye(2)), abs=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": []}, "points must hold at least one"),
        ({"points": ["fold"]}, "points must be a list of points of branches"),
        ({"within": {"d": (0.05, 0.3)}}, "within must give two parameters their bounds"),
        ({"within": {"d": (0.05, 0.3), "s": (0.1, 0.2)}}, "within must name two parameters; got d and s"),
        ({"within": {"d": (0.05, 0.3), "kappa": (3, 400)}}, "a rigid wall has no kappa"),
        ({"within": {"d": (0.3, 0.05), "r": (0.1, 0.9)}}, "within must be two finite bounds"),
        ({"within": {"d": (0.05, 0.1), "r": (0.1, 0.9)}}, "within must hold the points"),
        ({"within": {"omega": (1, 5), "r": (0.1, 0.9)}}, "along must be in the plane of omega and r"),
        ({"max_points": 1}, "max_points must be a whole number"),
    ],
)
def test_bad_input_is_told(met, change, message):
    with pytest.raises(ValueError, match=message):
        curves.follow_curves(**{"points": met, "along": "d", "within": PLANE} | change)


def test_a_curve_of_the_device_moves_what_the_device_does(met):
    """Along omega and s the pitchfork is where d is: d = s omega^2 / (A pi^2)."""
    device = Harvester(s=0.2)
    orbit = orbit_search.search(device.pair("rigid"), "RL", guesses=32)
    branches = switching.family(orbit, "omega", (3.0, 4.0), device=device, max_switches=0)
    points = [point for one in branches for point in one.points if point.kind == "pitchfork"]
    (curve,) = curves.follow_curves(points, "omega", {"omega": (3.0, 4.5), "s": (0.15, 0.3)}, device=device)
    np.testing.assert_allclose(curve.values[:, 1] * curve.values[:, 0] ** 2 / np.pi**2, pitchfork(0.5), rtol=1e-12)


def test_the_dataset_has_what_the_curves_have(found, tmp_path):
    listed = list(found.values())
    table = vijax.curve_dataset(listed)
    assert table.attrs["along"] == "d r"
    for index, curve in enumerate(listed):
        one = table.isel(curve=index)
        assert (one["kind"].item(), one["end_first"].item(), one["end_last"].item()) == (curve.kind, *curve.ends)
        assert one["label"].item() == "1:1"
        size = len(curve.values)
        np.testing.assert_array_equal(one["d"][:size], curve.values[:, 0])
        assert np.isnan(one["d"][size:]).all()
        assert [kind for kind in one["event"].values if kind] == [point.kind for point in curve.points]
        if curve.points:
            assert float(one["event_r"][0]) == curve.points[0].values[1]
    vijax.save(table, tmp_path / "curves.zarr")
    assert vijax.load(tmp_path / "curves.zarr")["kind"].values.tolist() == list(found)


def test_a_picture_has_a_line_a_kind_and_a_mark_a_point(found):
    table = vijax.curve_dataset(list(found.values()))
    figure = vijax.plots.curves(table, unstable=True)
    drawn = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert len({line.get_color() for line in drawn}) == 3
    marks = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 1]
    # The flip's end and the point of the graze there are one place.
    assert len(marks) == len({point.kind + f"{point.values[0]:.4g}" for c in found.values() for point in c.points})


def made_map(label=lambda d, r: d < pitchfork(r)):
    """Make a map of rigid walls whose labels, "1:2" and "1:1", border on the pitchfork."""
    d, r = np.linspace(0.2, 0.3, 9), np.linspace(0.3, 0.6, 7)
    below = label(d[:, None], r[None])
    one = np.ones(below.shape, int)
    variables = {"period": one, "impacts_left": one, "impacts_right": one + below, "status": 0 * one}
    # A map of rigid walls has a kappa too, for its energies.
    still = {"gamma": 0.0, "v0": -0.3, "u0": 0.05, "kappa": 400.0}
    found = {name: (("d", "r"), x) for name, x in variables.items()}
    return xr.Dataset(found, coords={"d": d, "r": r, **still}, attrs={"wall": "rigid"})


def test_a_map_is_explained_by_the_curve_on_its_border():
    dataset = made_map()
    found = vijax.bifurcation_curves(dataset, max_rounds=1, round_borders=4)
    assert found.borders > 0
    assert found.explained == found.borders
    curve = max((one for one in found.curves if one.kind == "pitchfork"), key=lambda one: len(one.values))
    np.testing.assert_allclose(curve.values[:, 0], pitchfork(curve.values[:, 1]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.sort(curve.values[[0, -1], 1]), [0.3, 0.6], rtol=1e-12)


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        (made_map().drop_vars("period"), "dataset must hold period"),
        (made_map().isel(d=0), "dataset must be a map over two parameters; got one over r"),
        (made_map().isel(d=[0]), "dataset must have at least two values along each axis; got 1 and 7"),
        (made_map().assign(period=0 * made_map()["period"]), "dataset must have periodic cells with impacts"),
        (5, "dataset must be a dataset"),
    ],
)
def test_a_map_without_labels_is_told(dataset, message):
    with pytest.raises(ValueError, match=message):
        vijax.bifurcation_curves(dataset)
