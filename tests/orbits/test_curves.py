"""Curves of bifurcations: at their known places, with the multipliers that make them, ended where orbits end."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

import vijax
from vijax.model.device import Harvester
from vijax.model.energy import rigid_penetration
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import (
    continuation,
    curve_rows,
    curves,
    limits,
    map_borders,
    map_curves,
    map_motions,
    multipliers,
    orbit_search,
    periodic,
    switching,
)
from vijax.orbits.curve_equations import Touch
from vijax.orbits.curve_starts import curve_start, with_touch
from vijax.orbits.events import Point
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
    passed, _, last = sorted(found["grazing"].points, key=lambda point: -point.values[1])
    # Where the mirror pair comes back to the symmetric orbit both of its impacts touch.
    assert (passed.kind, last.kind) == ("flip-graze", "pitchfork-graze")
    (broken,) = found["pitchfork"].points
    np.testing.assert_allclose(last.values, broken.values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(passed.values, end.values, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def grown(found):
    """The graze of the mirror pair, and the curves that begin at the points of codimension 2 which it meets."""
    graze = found["grazing"]
    place = int(np.abs(graze.values[:, 1] - 0.29).argmin())
    start = Point("grazing flight", float(graze.values[place, 0]), graze.orbit[place : place + 1])
    return curves.follow_curves([start], "d", {"d": (0.05, 0.35), "r": (0.2, 0.55)}, max_switches=1)


@pytest.mark.long
def test_curves_begin_where_others_meet_points_of_codimension_2(grown):
    told = sorted((one.kind, int(one.orbit.count[0]), int(one.orbit.sequence.span[0])) for one in grown)
    # At the flip-graze the flip and the graze of the doubled orbit, at the resonant graze orbits with an impact more.
    assert told == [("flip", 2, 2), ("flip", 3, 2), ("fold", 3, 2), ("grazing", 2, 2), ("grazing", 4, 4)]
    for curve in grown:
        assert (np.asarray(curve.orbit.residual) < 1e-12).all()
        # A curve may begin within rounding of its end, where rounding says whether its orbits are real.
        off = np.abs(curve.values - curve.values[[0, -1], None]).max(axis=2).min(axis=0)
        assert (off[2:-2] > 1e-12).all()
        assert (np.asarray(curve.orbit.status)[off > 1e-12] == Status.OK).all()


@pytest.mark.long
def test_a_fold_and_a_flip_touch_their_graze_at_its_resonance(grown):
    """Their distance grows as the square of the way along it (Simpson, Ghosh, arXiv 2602.22797)."""
    graze = next(one for one in grown if (one.kind, one.points[0].test) == ("grazing", "") and one.orbit.count[0] == 2)
    (resonant,) = (point.values for point in graze.points if point.kind == "resonant graze")
    along = graze.values[np.argsort(graze.values[:, 1])]
    beyond = [curve for curve in grown if curve.orbit.count[0] == 3]
    assert len(beyond) == 2
    for curve in beyond:
        (end,) = (point for point in curve.points if point.test == "impact")
        np.testing.assert_allclose(end.values, resonant, rtol=0, atol=1e-12)
        d, r = curve.values[np.abs(curve.values[:, 1] - resonant[1]) < 0.05].T
        away = np.abs(r - resonant[1])
        off = np.abs(d - CubicSpline(along[:, 1], along[:, 0])(r))[away > 5e-3]
        power = np.polyfit(np.log(away[away > 5e-3]), np.log(off), 1)[0]
        assert power == pytest.approx(2, abs=0.1)


def test_a_touch_is_proven_whether_the_ball_meets_the_wall_or_flies_by(found):
    """Rounding decides which, along the curve of a graze now the one and now the other."""
    graze = found["grazing"].orbit[1:-1]
    begun = [curve_start(Point("grazing flight", 0.0, graze[i : i + 1]), (0.0, 0.0), 1e-4) for i in range(len(graze))]
    starts = [start for start in begun if not isinstance(start, str)]
    impact, wall, wait = (np.array([getattr(start, name) for start in starts]) for name in ("impact", "wall", "wait"))
    assert len(np.unique(impact)) == 1
    hit = with_touch(graze.pair, graze.knots, graze.sequence, Touch(impact[0], wall), wait)
    assert (np.asarray(hit.status) == Status.OK).all()
    depth = np.asarray(hit.depth)[:, impact[0] + 1]
    assert 0 < (depth == 0).sum() < len(depth)
    assert depth.max() < 1e-6


@pytest.mark.parametrize("r", [(0.5, 0.9), (0.2, 0.5)])
def test_a_curve_begins_at_a_bound_of_its_plane(met, r):
    """At whichever it is, it ends there one way and leads on the other."""
    broken = [point for point in met if point.kind == "pitchfork"]
    (curve,) = curves.follow_curves(broken, "d", {"d": (0.02, 0.4), "r": r})
    assert curve.ends == ("r high", "r low")
    assert len(np.unique(curve.values[:, 1])) == len(curve.values)


@pytest.mark.long
def test_branches_lead_on_from_where_their_orbits_graze(found):
    """Rounding decides on which side of its graze such an orbit is. One way ends there, the other leads on."""
    graze = found["grazing"].orbit
    touching = graze[np.flatnonzero(np.asarray(graze.status) == Status.OK)][1:-1:4]
    for branch, d in zip(
        continuation.follow(touching, "d", PLANE["d"], points=10), np.asarray(touching.pair.d), strict=True
    ):
        assert "lost" not in branch.ends
        assert "grazing flight" in branch.ends
        assert min(abs(branch.values[0] - d), abs(branch.values[-1] - d)) < 1e-12


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


@pytest.mark.long
def test_gravity_unfolds_the_pitchfork_to_a_cusp(tilted):
    (fold,) = (curve for curve in tilted if curve.kind == "fold")
    (cusp,) = (point for point in fold.points if point.kind == "cusp")
    assert cusp.values[0] == pytest.approx(pitchfork(0.5), abs=1e-12)
    assert cusp.values[1] == pytest.approx(0, abs=1e-12)
    d, gamma = fold.values.T
    near = (np.abs(gamma) > 1e-6) & (np.abs(gamma) < 1e-3)
    power = np.polyfit(np.log(cusp.values[0] - d[near]), np.log(np.abs(gamma[near])), 1)[0]
    assert power == pytest.approx(1.5, abs=0.01)


@pytest.mark.long
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
        around, both = jax.jit(
            lambda *orbit: (multipliers.monodromy(*orbit), multipliers.multiplier_conditions(*orbit))
        )(pair, sequence, knots)
        speed = np.asarray(knots)[:, 1]
        weight = np.prod(speed / (speed + 0.1))
        for sign, found in zip((-1, 1), both, strict=True):
            assert float(found) == pytest.approx(
                weight * np.linalg.det(np.asarray(around) + sign * np.eye(2)), abs=1e-12
            )


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


@pytest.mark.long
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
    drawn = {line.get_color() for line in figure.axes[0].lines if len(line.get_xdata()) > 1}
    assert len(drawn - {"white"}) == 3  # white is the edge around each
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


@pytest.mark.long
def test_a_map_is_explained_by_the_curve_on_its_border():
    dataset = made_map()
    found = vijax.bifurcation_curves(dataset, max_rounds=1, round_borders=4)
    assert found.borders > 0
    assert found.explained == found.borders
    curve = max((one for one in found.curves if one.kind == "pitchfork"), key=lambda one: len(one.values))
    np.testing.assert_allclose(curve.values[:, 0], pitchfork(curve.values[:, 1]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.sort(curve.values[[0, -1], 1]), [0.3, 0.6], rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("d", "basins"), [((0.2, 0.2001), True), ((0.2001, 0.202), False)])
def test_a_border_of_basins_is_told_from_one_of_a_bifurcation(d, basins):
    """Rigid 1:1 and 1:2 attract both until the fold of 1:2 at d = 0.20158 (docs/accuracy.md)."""
    axes = {"d": np.array(d), "r": np.array([0.5, 0.5001]), "wall": "rigid"}
    one, other = (map_borders.labelled_plane(vijax.sweep(v0=v0, **axes)) for v0 in (-0.85, -1.0))
    first = np.array([[True, True], [False, False]])
    cells = one.cells | {"v0": np.where(first, -0.85, -1.0)}
    plane = dataclasses.replace(one, names=np.where(first, one.names, other.names), cells=cells)
    assert plane.names.tolist() == [["1:2", "1:2"], ["1:1", "1:1"]]
    np.testing.assert_array_equal(map_motions.both_attract(plane, map_borders.borders(plane)), [basins, basins])


def test_first_cells_of_a_search_are_spread_over_the_map():
    """Every periodic cell has one of them within a fifth of both axes, also if part of the map has no orbits."""
    whole = map_borders.labelled_plane(made_map())
    part = dataclasses.replace(whole, names=np.where(np.arange(9)[:, None] < 4, whole.names, ""))
    for plane in (whole, part):
        cells = map_curves._spread(plane)
        assert (plane.names[tuple(cells.T)] != "").all()
        assert len(np.unique(cells, axis=0)) == len(cells)
        away = np.abs(np.argwhere(plane.names != "")[:, None] - cells) / np.array(plane.names.shape)
        assert away.max(axis=2).min(axis=1).max() <= 0.2
    assert len(map_curves._spread(whole)) == 25


def test_a_search_without_time_says_what_is_left():
    dataset, told = made_map(), []
    found = vijax.bifurcation_curves(dataset, max_seconds=1e-9, progress=lambda *step: told.append(step))
    assert (found.curves, found.explained, found.ended) == ([], 0, "seconds")
    assert told == [(0, found.borders)]
    assert found.left.shape == (found.borders, 2)
    # They lie half way between cells of the pitchfork's two sides, all in one piece.
    away = found.left[:, 0] - pitchfork(found.left[:, 1])
    assert np.abs(away).max() < 0.0125
    assert len(found.largest) == found.borders


@pytest.mark.long
def test_ctrl_c_keeps_the_curves_found_until_then():
    def stop(explained, borders):
        if explained:
            raise KeyboardInterrupt

    found = vijax.bifurcation_curves(made_map(), progress=stop)
    assert found.ended == "stopped"
    assert found.curves
    assert 0 < found.explained <= found.borders
    table = vijax.curve_dataset(found)
    assert (table.attrs["ended"], table.sizes["border"]) == ("stopped", len(found.left))
    assert not table["left_basins"].any()


def test_rows_have_every_point_and_what_was_met(found, tmp_path):
    listed = list(found.values())
    table = vijax.curve_dataset(listed)
    rows = vijax.curve_rows(table)
    assert len(rows) == sum(len(curve.values) for curve in listed)
    np.testing.assert_array_equal(rows[["d", "r"]], np.concatenate([curve.values for curve in listed]))
    met = rows[rows["event"] != ""]
    assert sorted(met["event"]) == sorted(point.kind for curve in listed for point in curve.points)
    places = {point.kind: point.values for curve in listed for point in curve.points}
    for row in met.itertuples():
        np.testing.assert_allclose((row.d, row.r), places[row.event], rtol=0, atol=1e-8)
    # The flip's end and the point of the graze there are one point.
    numbered = curve_rows.numbered_points(table)
    assert [one.number for one in numbered] == list(range(1, len(numbered) + 1))
    assert sorted(one.kind for one in numbered) == ["flip-graze", "pitchfork-graze", "resonant graze"]
    curve_rows.write_rows(table.assign_coords(d=table["d"].assign_attrs(units="m")), tmp_path / "curves.csv")
    assert (tmp_path / "curves.csv").read_text().startswith("curve,point,kind,label,d [m],r,multiplier,")


# --- limits ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def limited():
    """The symmetric orbit of rigid walls where its impacts are 1 mm deep: d and r along that curve, and the device."""
    device = Harvester(penetration_limit=1e-3)
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    branches = switching.family(start, "d", (0.1, 0.3))[:1]
    points = vijax.limit_points(branches, device=device)
    (point,) = (one for one in points if one.kind == "penetration limit")
    (curve,) = curves.follow_curves([point], "d", {"d": (0.15, 0.35), "r": (0.3, 0.7)}, device=device)
    return curve, device


def deep_gap(r):
    """Give the gap at which the symmetric orbit's impacts are 1 mm deep at kappa = 400, A = 1 and omega = pi.

    Speed and gap in closed form (physics.md, 1:1 at gamma 0); the depth is Eq. (35)'s.
    """
    speed = 1e-3 * 400 / np.asarray(rigid_penetration(jnp.asarray(r)))
    return 0.5 * (1 + r) * speed - 2 / np.pi**2 * np.sqrt(1 - (0.5 * np.pi * (1 - r) * speed) ** 2)


@pytest.mark.long
def test_a_limit_of_penetration_is_where_it_is_known_to_be(limited):
    curve, _ = limited
    d, r = curve.values.T
    np.testing.assert_allclose(d, deep_gap(r), rtol=0, atol=1e-12)
    assert np.ptp(r) > 0.1


@pytest.mark.long
def test_limits_of_a_map_begin_at_its_cells():
    dataset = made_map()
    within = dataset["d"].values[:, None] < deep_gap(dataset["r"].values)
    told = dataset.assign(admissible=(("d", "r"), within)).assign_attrs(harvester_penetration_limit=1e-3)
    found = vijax.bifurcation_curves(told, max_rounds=0, limits=True)
    listed = [one for one in found.curves if one.kind == "penetration limit" and one.orbit.sequence.mirrored[0]]
    (curve,) = listed
    d, r = curve.values.T
    np.testing.assert_allclose(d, deep_gap(r), rtol=0, atol=1e-12)
    assert found.explained == vijax.bifurcation_curves(told, max_rounds=0).explained


@pytest.mark.long
def test_impacts_at_a_limit_are_flown_as_deep(limited):
    curve, device = limited
    load = limits.loads(curve.orbit, device)["penetration limit"].max(axis=1)
    flown = np.asarray(curve.orbit.status) == Status.OK
    assert flown[1:-1].all()
    np.testing.assert_allclose(load[flown], 1, rtol=0, atol=1e-12)
    assert (np.asarray(curve.orbit.residual) < 1e-12).all()


@pytest.mark.long
def test_a_limit_of_energy_holds_on_soft_walls_as_the_device_changes():
    """Along omega units of length and energy change as well; the impact map flies what is on the curve."""
    device = Harvester(omega0=60.0, s=0.2, energy_ratio_limit=0.5)
    orbit = orbit_search.search(device.pair(), "RL", guesses=64)
    branches = switching.family(orbit[:1], "omega0", (20.0, 400.0), device=device, max_switches=0)
    points = [point for point in vijax.limit_points(branches, device=device) if point.kind == "energy limit"]
    listed = curves.follow_curves(points, "omega0", {"omega0": (20.0, 400.0), "omega": (2.8, 3.4)}, device=device)
    assert listed
    for curve in listed:
        omega0, omega = curve.values.T
        here = limits.device_at(limits.device_at(device, "omega", omega[:, None]), "omega0", omega0[:, None])
        load = limits.loads(curve.orbit, here)[curve.kind].max(axis=1)
        flown = np.asarray(curve.orbit.status) == Status.OK
        assert flown[1:-1].all()
        np.testing.assert_allclose(load[flown], 1, rtol=0, atol=1e-12)
        assert np.ptp(omega) > 0.1


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plane", "message"),
    [
        ({"d": (0.1, 0.3)}, "within must give two parameters their bounds"),
        ({"d": (0.1, 0.3), "s": (0.1, 0.3)}, "within must name two parameters; got d and s, which say the same"),
        ({"gamma": (-0.1, 0.1), "beta": (-0.1, 0.1)}, "got gamma and beta, which say the same"),
        ({"d": (0.3, 0.1), "r": (0.2, 0.8)}, "within must be two finite bounds, the lower first"),
        ({"d": (0.1, 0.3), "r": (0.2, np.nan)}, "within must be two finite bounds"),
        ({"d": (0.1, 0.3), "r": (0.2, 1.5)}, "within must lie in"),
        ({"d": (0.1, 0.3), "kappa": (3, 40)}, "a rigid wall has no kappa"),
        ({"d": (0.1, 0.3), "A": (1, 2)}, "got A, which changes none of d, kappa, r and gamma where d is given"),
        ({"d": (0.3, 0.4), "r": (0.2, 0.8)}, "within must hold the points"),
    ],
)
def test_a_plane_that_cannot_be_is_told(met, plane, message):
    with pytest.raises(ValueError, match=message):
        curves.follow_curves(met, "d", plane)


def test_malformed_starts_are_told(met):
    (fold,) = met[:1]
    soft = fold._replace(orbit=eqx.tree_at(lambda o: o.pair, fold.orbit, impact_pair([0.2], [40.0], [0.5])))
    two = fold._replace(orbit=periodic.concatenate([fold.orbit, fold.orbit]))
    for points, message in (
        ([], "points must hold at least one"),
        (3, "points must be"),
        ([*met, "fold"], "points must be"),
        ([fold, soft], "points must be of one kind of wall"),
        ([two], "points must have one orbit each; got 2 at index 0"),
        ([fold._replace(value=np.nan)], "within must hold the points"),
    ):
        with pytest.raises(ValueError, match=message):
            curves.follow_curves(points, "d", PLANE)


def energy_only(dataset):
    """A map over d and A, where the motion depends on d alone."""
    return dataset.isel(r=0, drop=True).assign(P=(("d", "A"), np.ones((9, 2)))).assign_coords(A=[1.0, 2.0])


def test_curves_lie_where_they_are_whichever_axis_of_the_map_is_across(found):
    table, over = vijax.curve_dataset(list(found.values())), made_map().assign_attrs(periods=40)
    seen = []
    for plane in (over, over.transpose("r", "d")):
        axes = vijax.plots.curves(table, plane, ground="label").axes[0]
        marks = [np.ravel(line.get_data()) for line in axes.lines if len(line.get_xdata()) == 1]
        seen.append(marks if axes.get_xlabel() == "$d$" else [mark[::-1] for mark in marks])
    assert len(seen[0]) == 3
    np.testing.assert_array_equal(*seen)


def test_grazings_of_unstable_orbits_are_drawn_on_request(found):
    table = vijax.curve_dataset([found["grazing"]])
    faint = [
        {line.get_alpha() for line in vijax.plots.curves(table, unstable=wanted).axes[0].lines}
        for wanted in (False, True)
    ]
    assert (len(faint[0]), len(faint[1])) == (1, 2)


def test_a_map_that_curves_cannot_lie_over_is_told(found):
    table = vijax.curve_dataset(list(found.values()))
    for over, ground, message in (
        (made_map(), "mass", "ground must be among"),
        (made_map().rename(r="gamma_"), "label", "over must be a map over d and r alone"),
        (made_map().isel(r=0), "label", "over must be a map over d and r alone; got one over d"),
        (3, "label", "over must be a dataset"),
    ):
        with pytest.raises(ValueError, match=message):
            vijax.plots.curves(table, over, ground=ground)


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        (made_map().drop_vars("period"), "dataset must hold period"),
        (made_map().isel(d=0), "dataset must be a map over two parameters; got one over r"),
        (made_map().isel(d=[0]), "dataset must have at least two values along each axis; got 1 and 7"),
        (energy_only(made_map()), "got one over d; its motion does not depend on A"),
        (made_map().assign_attrs(membrane="hunt-crossley"), "dataset must be of linear membranes"),
        (made_map().assign_attrs(excitation="harmonics 1.0, 0.3"), "of the sine; got one of excitation harmonics"),
        (made_map().assign_attrs(friction=0.1), "dataset must be of no friction; got one of friction 0.1"),
        (made_map().assign(period=0 * made_map()["period"]), "dataset must have periodic cells with impacts"),
        (5, "dataset must be a dataset"),
    ],
)
def test_a_map_without_labels_is_told(dataset, message):
    with pytest.raises(ValueError, match=message):
        vijax.bifurcation_curves(dataset)


@pytest.mark.parametrize(
    ("argument", "value"),
    [("max_seconds", 0.0), ("max_seconds", np.nan), ("max_rounds", -1), ("max_points", 1), ("progress", 3)],
)
def test_a_budget_that_cannot_be_is_told(argument, value):
    with pytest.raises(ValueError, match=f"{argument} must be"):
        vijax.bifurcation_curves(made_map(), **{argument: value})


def test_limits_want_a_map_that_tells_what_is_admissible():
    with pytest.raises(ValueError, match="limits must be those of a map with admissible"):
        vijax.bifurcation_curves(made_map(), limits=True)
