"""Curves of bifurcations: their places, the multipliers of their orbits, and their ends where orbits end."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

import vijax
from vijax.continuation import branch_continuation, branch_switching, limits
from vijax.continuation.branch_events import Point
from vijax.continuation.curves import curve_table, curves
from vijax.continuation.curves.curve_equations import EventLocation
from vijax.continuation.curves.curve_starts import curve_start, with_grazing_impact
from vijax.continuation.from_map import map_attractors, map_borders, map_curves
from vijax.model.device import Harvester
from vijax.model.energy import rigid_penetration
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import multipliers, orbit_search, periodic
from vijax.orbits.shooting import Sequence

PLANE = {"d": (0.05, 0.35), "r": (0.02, 0.98)}


@pytest.fixture(scope="module")
def events():
    """Return the events of symmetric period-1 orbits of rigid walls, closed half way, and of bifurcating branches."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    return [point for branch in branch_switching.follow_families(start, "d", (0.1, 0.3)) for point in branch.points]


@pytest.fixture(scope="module")
def curves_by_kind(events):
    listed = curves.follow_curves(events, "d", PLANE)
    # Five points of three kinds: both points of a mirror pair lie on one curve.
    assert len(listed) == 3
    return {curve.kind: curve for curve in listed}


def pitchfork(r):
    """Return the gap of the pitchfork of the symmetric orbit of rigid walls (physics.md, 1:1 at gamma 0)."""
    q = (1 + r) / (np.pi * (1 - r))
    return (1 - 4 / np.pi**2) * q / np.sqrt(1 + 4 * q * q)


def test_curves_are_distinct(events, curves_by_kind):
    assert sorted(point.kind for point in events) == ["flip"] * 2 + ["grazing flight"] * 2 + ["pitchfork"]
    assert sorted(curves_by_kind) == ["flip", "grazing", "pitchfork"]


def test_curve_of_pitchforks_matches_the_closed_form(curves_by_kind):
    d, r = curves_by_kind["pitchfork"].values.T
    np.testing.assert_allclose(d, pitchfork(r), rtol=0, atol=1e-13)
    assert curves_by_kind["pitchfork"].ends == ("r high", "pitchfork-graze")
    assert r.max() == pytest.approx(0.98, abs=1e-14)


def test_points_of_curves_are_orbits_with_the_expected_multiplier(curves_by_kind):
    for kind, curve in curves_by_kind.items():
        assert (np.asarray(curve.orbit.residual) < 1e-12).all()
        assert (np.asarray(curve.orbit.status)[1:-1] == Status.OK).all()
        if kind == "grazing":
            continue
        largest = np.asarray(curve.orbit.multipliers)[:, 0]
        assert np.abs(largest - (-1 if kind == "flip" else 1)).max() < 1e-9
        counted = np.asarray(curve.orbit.count) * (2 if kind == "pitchfork" else 1)
        product = np.asarray(curve.orbit.multipliers).prod(axis=1).real
        np.testing.assert_allclose(product, curve.values[:, 1] ** (2 * counted), rtol=0, atol=1e-10)


def test_curves_of_the_flip_and_the_graze_share_their_common_point(curves_by_kind):
    (flip_end,) = curves_by_kind["flip"].points
    assert (flip_end.kind, flip_end.test) == ("flip-graze", "flight")
    flip_graze, _, pitchfork_graze = sorted(curves_by_kind["grazing"].points, key=lambda point: -point.values[1])
    # Where the mirror pair merges with the symmetric orbit, the ball grazes both walls.
    assert (flip_graze.kind, pitchfork_graze.kind) == ("flip-graze", "pitchfork-graze")
    (pitchfork_end,) = curves_by_kind["pitchfork"].points
    np.testing.assert_allclose(pitchfork_graze.values, pitchfork_end.values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(flip_graze.values, flip_end.values, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def switched_curves(curves_by_kind):
    """Return the curve of the graze of the mirror pair, and the curves that start at its points of codimension 2."""
    graze = curves_by_kind["grazing"]
    index = int(np.abs(graze.values[:, 1] - 0.29).argmin())
    start = Point("grazing flight", float(graze.values[index, 0]), graze.orbit[index : index + 1])
    return curves.follow_curves([start], "d", {"d": (0.05, 0.35), "r": (0.2, 0.55)}, max_switches=1)


@pytest.mark.long
def test_curves_start_at_points_of_codimension_2(switched_curves):
    properties = sorted(
        (item.kind, int(item.orbit.count[0]), int(item.orbit.sequence.span[0])) for item in switched_curves
    )
    # The flip-graze starts the flip and the graze of the doubled orbit, the resonant graze orbits with one more impact.
    assert properties == [("flip", 2, 2), ("flip", 3, 2), ("fold", 3, 2), ("grazing", 2, 2), ("grazing", 4, 4)]
    for curve in switched_curves:
        assert (np.asarray(curve.orbit.residual) < 1e-12).all()
        # A curve may start within rounding of its end, where rounding decides the status of its orbits.
        distance = np.abs(curve.values - curve.values[[0, -1], None]).max(axis=2).min(axis=0)
        assert (distance[2:-2] > 1e-12).all()
        assert (np.asarray(curve.orbit.status)[distance > 1e-12] == Status.OK).all()


@pytest.mark.long
def test_fold_and_flip_are_tangent_to_their_graze_at_its_resonance(switched_curves):
    """Their distance grows as the square of the offset along the graze (Simpson, Ghosh, arXiv 2602.22797)."""
    graze = next(
        candidate
        for candidate in switched_curves
        if (candidate.kind, candidate.points[0].test) == ("grazing", "") and candidate.orbit.count[0] == 2
    )
    (resonant,) = (point.values for point in graze.points if point.kind == "resonant graze")
    sorted_values = graze.values[np.argsort(graze.values[:, 1])]
    switched = [curve for curve in switched_curves if curve.orbit.count[0] == 3]
    assert len(switched) == 2
    for curve in switched:
        (end,) = (point for point in curve.points if point.test == "impact")
        np.testing.assert_allclose(end.values, resonant, rtol=0, atol=1e-12)
        d, r = curve.values[np.abs(curve.values[:, 1] - resonant[1]) < 0.05].T
        offset = np.abs(r - resonant[1])
        distance = np.abs(d - CubicSpline(sorted_values[:, 1], sorted_values[:, 0])(r))[offset > 5e-3]
        power = np.polyfit(np.log(offset[offset > 5e-3]), np.log(distance), 1)[0]
        assert power == pytest.approx(2, abs=0.1)


def test_grazing_impact_is_verified_if_rounding_removes_it(curves_by_kind):
    """Along the curve of a graze, rounding decides whether the ball reaches the wall."""
    graze = curves_by_kind["grazing"].orbit[1:-1]
    attempts = [
        curve_start(Point("grazing flight", 0.0, graze[i : i + 1]), (0.0, 0.0), 1e-4) for i in range(len(graze))
    ]
    starts = [start for start in attempts if not isinstance(start, str)]
    impact, wall, wait = (np.array([getattr(start, name) for start in starts]) for name in ("impact", "wall", "delay"))
    assert len(np.unique(impact)) == 1
    orbits = with_grazing_impact(
        graze.pair, graze.impact_unknowns, graze.sequence, EventLocation(impact[0], wall), wait
    )
    assert (np.asarray(orbits.status) == Status.OK).all()
    depth = np.asarray(orbits.depth)[:, impact[0] + 1]
    assert 0 < (depth == 0).sum() < len(depth)
    assert depth.max() < 1e-6


@pytest.mark.parametrize("r", [(0.5, 0.9), (0.2, 0.5)])
def test_curve_starts_at_a_bound_of_its_plane(events, r):
    """At either bound the curve ends in one direction and continues in the other."""
    pitchforks = [point for point in events if point.kind == "pitchfork"]
    (curve,) = curves.follow_curves(pitchforks, "d", {"d": (0.02, 0.4), "r": r})
    assert curve.ends == ("r high", "r low")
    assert len(np.unique(curve.values[:, 1])) == len(curve.values)


@pytest.mark.long
def test_branches_start_at_grazing_orbits(curves_by_kind):
    """Rounding decides the side of the graze. The branch ends there in one direction and continues in the other."""
    graze = curves_by_kind["grazing"].orbit
    grazing = graze[np.flatnonzero(np.asarray(graze.status) == Status.OK)][1:-1:4]
    for branch, d in zip(
        branch_continuation.follow_orbits(grazing, "d", PLANE["d"], points=10),
        np.asarray(grazing.pair.d),
        strict=True,
    ):
        assert "lost" not in branch.ends
        assert "grazing flight" in branch.ends
        assert min(abs(branch.values[0] - d), abs(branch.values[-1] - d)) < 1e-12


def test_stability_of_a_graze_is_the_stability_of_the_grazing_orbit(curves_by_kind):
    graze = curves_by_kind["grazing"]
    border = next(point.values[1] for point in graze.points if point.kind == "flip-graze")
    np.testing.assert_array_equal(graze.stable, graze.values[:, 1] < border)
    assert curves_by_kind["flip"].stable.all()


@pytest.fixture(scope="module")
def tilted():
    """Return curves of the same orbit under gravity, which breaks the symmetry."""
    orbit = orbit_search.find_orbits(impact_pair(0.2, None, 0.5, 0.01), "RL", guesses=64)
    (branch,) = (
        candidate
        for candidate in branch_switching.follow_families(orbit, "d", (0.1, 0.35), max_switches=0)
        if len(candidate.points) == 3
    )
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
def test_folds_end_at_their_graze_and_the_graze_continues(tilted):
    fold, graze = sorted(tilted, key=lambda curve: curve.kind)
    assert fold.ends == ("fold-graze", "fold-graze")
    (fold_graze,) = (point for point in graze.points if point.kind == "fold-graze")
    assert min(np.abs(np.subtract(end.values, fold_graze.values)).max() for end in fold.points) < 1e-9


def test_conditions_match_the_monodromy_matrix(events):
    for point in events:
        orbit = point.orbit
        pair, sequence, impact_unknowns = (
            jax.tree.map(lambda x: x[0], leaf) for leaf in (orbit.pair, orbit.sequence, orbit.impact_unknowns)
        )
        monodromy, conditions = jax.jit(
            lambda *orbit: (multipliers.monodromy(*orbit), multipliers.multiplier_conditions(*orbit))
        )(pair, sequence, impact_unknowns)
        speed = np.asarray(impact_unknowns)[:, 1]
        weight = np.prod(speed / (speed + 0.1))
        for sign, condition in zip((-1, 1), conditions, strict=True):
            assert float(condition) == pytest.approx(
                weight * np.linalg.det(np.asarray(monodromy) + sign * np.eye(2)), abs=1e-12
            )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": []}, "points must hold at least one"),
        ({"points": ["fold"]}, "points must be a list of points of branches"),
        ({"within": {"d": (0.05, 0.3)}}, "within must specify bounds of two parameters"),
        ({"within": {"d": (0.05, 0.3), "s": (0.1, 0.2)}}, "within must name two parameters; got d and s"),
        ({"within": {"d": (0.05, 0.3), "kappa": (3, 400)}}, "a rigid wall has no kappa"),
        ({"within": {"d": (0.3, 0.05), "r": (0.1, 0.9)}}, "within must be two finite bounds"),
        ({"within": {"d": (0.05, 0.1), "r": (0.1, 0.9)}}, "within must hold the points"),
        ({"within": {"omega": (1, 5), "r": (0.1, 0.9)}}, "along must be in the plane of omega and r"),
        ({"max_points": 1}, "max_points must be a whole number"),
    ],
)
def test_bad_input_raises(events, change, message):
    with pytest.raises(ValueError, match=message):
        curves.follow_curves(**{"points": events, "along": "d", "within": PLANE} | change)


@pytest.mark.long
def test_curve_along_constants_of_the_device_matches_the_closed_form(events):
    """Along omega and s the pitchfork has the same gap, d = s omega^2 / (A pi^2)."""
    device = Harvester(s=0.2)
    orbit = orbit_search.find_orbits(device.pair("rigid"), "RL", guesses=32)
    branches = branch_switching.follow_families(orbit, "omega", (3.0, 4.0), device=device, max_switches=0)
    points = [point for branch in branches for point in branch.points if point.kind == "pitchfork"]
    (curve,) = curves.follow_curves(points, "omega", {"omega": (3.0, 4.5), "s": (0.15, 0.3)}, device=device)
    np.testing.assert_allclose(curve.values[:, 1] * curve.values[:, 0] ** 2 / np.pi**2, pitchfork(0.5), rtol=1e-12)


def test_dataset_contains_the_curves_and_their_points(curves_by_kind, tmp_path):
    listed = list(curves_by_kind.values())
    table = vijax.curve_dataset(listed)
    assert table.attrs["along"] == "d r"
    for index, curve in enumerate(listed):
        row = table.isel(curve=index)
        assert (row["kind"].item(), row["end_first"].item(), row["end_last"].item()) == (curve.kind, *curve.ends)
        assert row["label"].item() == "1:1"
        size = len(curve.values)
        np.testing.assert_array_equal(row["d"][:size], curve.values[:, 0])
        assert np.isnan(row["d"][size:]).all()
        assert [kind for kind in row["event"].values if kind] == [point.kind for point in curve.points]
        if curve.points:
            assert float(row["event_r"][0]) == curve.points[0].values[1]
    vijax.save(table, tmp_path / "curves.zarr")
    assert vijax.load(tmp_path / "curves.zarr")["kind"].values.tolist() == list(curves_by_kind)


def test_picture_has_a_line_per_kind_and_a_mark_per_point(curves_by_kind):
    table = vijax.curve_dataset(list(curves_by_kind.values()))
    figure = vijax.plots.curves(table, unstable=True)
    colours = {line.get_color() for line in figure.axes[0].lines if len(line.get_xdata()) > 1}
    assert len(colours - {"white"}) == 3  # white is the edge around a line
    markers = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 1]
    # The end of the flip and the point of the graze coincide.
    assert len(markers) == len(
        {point.kind + f"{point.values[0]:.4g}" for c in curves_by_kind.values() for point in c.points}
    )


def made_map(label=lambda d, r: d < pitchfork(r)):
    """Return a map of rigid walls with the labels "1:2" and "1:1" on the two sides of the pitchfork."""
    d, r = np.linspace(0.2, 0.3, 9), np.linspace(0.3, 0.6, 7)
    below = label(d[:, None], r[None])
    unit = np.ones(below.shape, int)
    variables = {"period": unit, "impacts_left": unit, "impacts_right": unit + below, "status": 0 * unit}
    # A map of rigid walls has a kappa as well, for its energies.
    constants = {"gamma": 0.0, "v0": -0.3, "u0": 0.05, "kappa": 400.0}
    data_variables = {name: (("d", "r"), x) for name, x in variables.items()}
    return xr.Dataset(data_variables, coords={"d": d, "r": r, **constants}, attrs={"wall": "rigid"})


@pytest.mark.long
def test_borders_of_a_map_are_explained_by_their_curve():
    dataset = made_map()
    result = vijax.bifurcation_curves(dataset, max_rounds=1, round_borders=4)
    assert result.borders > 0
    assert result.explained == result.borders
    curve = max(
        (candidate for candidate in result.curves if candidate.kind == "pitchfork"),
        key=lambda candidate: len(candidate.values),
    )
    np.testing.assert_allclose(curve.values[:, 0], pitchfork(curve.values[:, 1]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.sort(curve.values[[0, -1], 1]), [0.3, 0.6], rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("d", "basins"), [((0.2, 0.2001), True), ((0.2001, 0.202), False)])
def test_border_of_basins_is_distinguished_from_a_bifurcation(d, basins):
    """Between rigid walls, 1:1 and 1:2 both attract up to the fold of 1:2 at d = 0.20158 (docs/accuracy.md)."""
    axes = {"d": np.array(d), "r": np.array([0.5, 0.5001]), "wall": "rigid"}
    first_plane, second_plane = (map_borders.labelled_plane(vijax.sweep(v0=v0, **axes)) for v0 in (-0.85, -1.0))
    first = np.array([[True, True], [False, False]])
    cells = first_plane.cells | {"v0": np.where(first, -0.85, -1.0)}
    plane = dataclasses.replace(
        first_plane, labels=np.where(first, first_plane.labels, second_plane.labels), cells=cells
    )
    assert plane.labels.tolist() == [["1:2", "1:2"], ["1:1", "1:1"]]
    np.testing.assert_array_equal(map_attractors.both_attract(plane, map_borders.borders(plane)), [basins, basins])


def test_first_cells_of_a_search_are_spread_over_the_map():
    """Every periodic cell has a first cell within a fifth of both axes, also if part of the map has no orbits."""
    full = map_borders.labelled_plane(made_map())
    partial = dataclasses.replace(full, labels=np.where(np.arange(9)[:, None] < 4, full.labels, ""))
    for plane in (full, partial):
        cells = map_curves._lattice_cells(plane)
        assert (plane.labels[tuple(cells.T)] != "").all()
        assert len(np.unique(cells, axis=0)) == len(cells)
        distance = np.abs(np.argwhere(plane.labels != "")[:, None] - cells) / np.array(plane.labels.shape)
        assert distance.max(axis=2).min(axis=1).max() <= 0.2
    assert len(map_curves._lattice_cells(full)) == 25


def test_search_without_time_returns_all_borders_as_unexplained():
    dataset, calls = made_map(), []
    result = vijax.bifurcation_curves(dataset, max_seconds=1e-9, progress=lambda *step: calls.append(step))
    assert (result.curves, result.explained, result.ended) == ([], 0, "seconds")
    assert calls == [(0, result.borders)]
    assert result.unexplained.shape == (result.borders, 2)
    # The borders lie half way between cells on the two sides of the pitchfork, and are connected.
    offset = result.unexplained[:, 0] - pitchfork(result.unexplained[:, 1])
    assert np.abs(offset).max() < 0.0125
    assert len(result.largest_unexplained) == result.borders


@pytest.mark.long
def test_interrupted_search_returns_the_finished_curves():
    def stop(explained, borders):
        if explained:
            raise KeyboardInterrupt

    result = vijax.bifurcation_curves(made_map(), progress=stop)
    assert result.ended == "stopped"
    assert result.curves
    assert 0 < result.explained <= result.borders
    table = vijax.curve_dataset(result)
    assert (table.attrs["ended"], table.sizes["border"]) == ("stopped", len(result.unexplained))
    assert not table["left_basins"].any()


def test_rows_contain_all_points_and_events(curves_by_kind, tmp_path):
    listed = list(curves_by_kind.values())
    table = vijax.curve_dataset(listed)
    rows = vijax.curve_rows(table)
    assert len(rows) == sum(len(curve.values) for curve in listed)
    np.testing.assert_array_equal(rows[["d", "r"]], np.concatenate([curve.values for curve in listed]))
    event_rows = rows[rows["event"] != ""]
    assert sorted(event_rows["event"]) == sorted(point.kind for curve in listed for point in curve.points)
    places = {point.kind: point.values for curve in listed for point in curve.points}
    for row in event_rows.itertuples():
        np.testing.assert_allclose((row.d, row.r), places[row.event], rtol=0, atol=1e-8)
    # The end of the flip and the point of the graze have one number.
    numbered = curve_table.numbered_points(table)
    assert [numbered_point.number for numbered_point in numbered] == list(range(1, len(numbered) + 1))
    assert sorted(numbered_point.kind for numbered_point in numbered) == [
        "flip-graze",
        "pitchfork-graze",
        "resonant graze",
    ]
    curve_table.write_rows(table.assign_coords(d=table["d"].assign_attrs(units="m")), tmp_path / "curves.csv")
    assert (tmp_path / "curves.csv").read_text().startswith("curve,point,kind,label,d [m],r,multiplier,")


# --- limits ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def limited():
    """Return the curve of symmetric orbits of rigid walls with impacts 1 mm deep, and the device."""
    device = Harvester(penetration_limit=1e-3)
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    branches = branch_switching.follow_families(start, "d", (0.1, 0.3))[:1]
    points = vijax.limit_points(branches, device=device)
    (point,) = (candidate for candidate in points if candidate.kind == "penetration limit")
    (curve,) = curves.follow_curves([point], "d", {"d": (0.15, 0.35), "r": (0.3, 0.7)}, device=device)
    return curve, device


def deep_gap(r):
    """Return the gap of the symmetric orbit with impacts 1 mm deep at kappa = 400, A = 1 and omega = pi.

    Speed and gap have closed forms (physics.md, 1:1 at gamma 0); Eq. (35) gives the depth.
    """
    speed = 1e-3 * 400 / np.asarray(rigid_penetration(jnp.asarray(r)))
    return 0.5 * (1 + r) * speed - 2 / np.pi**2 * np.sqrt(1 - (0.5 * np.pi * (1 - r) * speed) ** 2)


@pytest.mark.long
def test_curve_of_the_penetration_limit_matches_the_closed_form(limited):
    curve, _ = limited
    d, r = curve.values.T
    np.testing.assert_allclose(d, deep_gap(r), rtol=0, atol=1e-12)
    assert np.ptp(r) > 0.1


@pytest.mark.long
def test_limits_of_a_map_start_at_its_cells():
    dataset = made_map()
    within = dataset["d"].values[:, None] < deep_gap(dataset["r"].values)
    limited_map = dataset.assign(admissible=(("d", "r"), within)).assign_attrs(harvester_penetration_limit=1e-3)
    result = vijax.bifurcation_curves(limited_map, max_rounds=0, limits=True)
    listed = [
        candidate
        for candidate in result.curves
        if candidate.kind == "penetration limit" and candidate.orbit.sequence.mirrored[0]
    ]
    (curve,) = listed
    d, r = curve.values.T
    np.testing.assert_allclose(d, deep_gap(r), rtol=0, atol=1e-12)
    assert result.explained == vijax.bifurcation_curves(limited_map, max_rounds=0).explained


@pytest.mark.long
def test_verified_impacts_on_the_curve_of_a_limit_have_load_1(limited):
    curve, device = limited
    load = limits.load_ratios(curve.orbit, device)["penetration limit"].max(axis=1)
    verified = np.asarray(curve.orbit.status) == Status.OK
    assert verified[1:-1].all()
    np.testing.assert_allclose(load[verified], 1, rtol=0, atol=1e-12)
    assert (np.asarray(curve.orbit.residual) < 1e-12).all()


@pytest.mark.long
def test_energy_limit_of_soft_walls_along_constants_of_the_device():
    """Along omega the units of length and energy change as well; the impact map verifies the orbits of the curve."""
    device = Harvester(omega0=60.0, s=0.2, energy_ratio_limit=0.5)
    orbit = orbit_search.find_orbits(device.pair(), "RL", guesses=64)
    branches = branch_switching.follow_families(orbit[:1], "omega0", (20.0, 400.0), device=device, max_switches=0)
    points = [point for point in vijax.limit_points(branches, device=device) if point.kind == "energy limit"]
    listed = curves.follow_curves(points, "omega0", {"omega0": (20.0, 400.0), "omega": (2.8, 3.4)}, device=device)
    assert listed
    for curve in listed:
        omega0, omega = curve.values.T
        devices = limits.device_with_value(
            limits.device_with_value(device, "omega", omega[:, None]), "omega0", omega0[:, None]
        )
        load = limits.load_ratios(curve.orbit, devices)[curve.kind].max(axis=1)
        verified = np.asarray(curve.orbit.status) == Status.OK
        assert verified[1:-1].all()
        np.testing.assert_allclose(load[verified], 1, rtol=0, atol=1e-12)
        assert np.ptp(omega) > 0.1


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plane", "message"),
    [
        ({"d": (0.1, 0.3)}, "within must specify bounds of two parameters"),
        (
            {"d": (0.1, 0.3), "s": (0.1, 0.3)},
            "within must name two parameters; got d and s, which are the same parameter",
        ),
        ({"gamma": (-0.1, 0.1), "beta": (-0.1, 0.1)}, "got gamma and beta, which are the same parameter"),
        ({"d": (0.3, 0.1), "r": (0.2, 0.8)}, "within must be two finite bounds, the lower first"),
        ({"d": (0.1, 0.3), "r": (0.2, np.nan)}, "within must be two finite bounds"),
        ({"d": (0.1, 0.3), "r": (0.2, 1.5)}, "within must lie in"),
        ({"d": (0.1, 0.3), "kappa": (3, 40)}, "a rigid wall has no kappa"),
        ({"d": (0.1, 0.3), "A": (1, 2)}, "got A, which changes none of d, kappa, r and gamma where d is given"),
        ({"d": (0.3, 0.4), "r": (0.2, 0.8)}, "within must hold the points"),
    ],
)
def test_invalid_planes_raise(events, plane, message):
    with pytest.raises(ValueError, match=message):
        curves.follow_curves(events, "d", plane)


def test_malformed_starts_raise(events):
    (fold,) = events[:1]
    soft = fold._replace(orbit=eqx.tree_at(lambda o: o.pair, fold.orbit, impact_pair([0.2], [40.0], [0.5])))
    two = fold._replace(orbit=periodic.concatenate([fold.orbit, fold.orbit]))
    for points, message in (
        ([], "points must hold at least one"),
        (3, "points must be"),
        ([*events, "fold"], "points must be"),
        ([fold, soft], "points must be of one kind of wall"),
        ([two], "points must have one orbit each; got 2 at index 0"),
        ([fold._replace(value=np.nan)], "within must hold the points"),
    ):
        with pytest.raises(ValueError, match=message):
            curves.follow_curves(points, "d", PLANE)


def energy_only(dataset):
    """Return a map over d and A with a motion that depends only on d."""
    return dataset.isel(r=0, drop=True).assign(P=(("d", "A"), np.ones((9, 2)))).assign_coords(A=[1.0, 2.0])


def test_curves_are_drawn_alike_over_a_transposed_map(curves_by_kind):
    table, dataset = vijax.curve_dataset(list(curves_by_kind.values())), made_map().assign_attrs(periods=40)
    positions = []
    for plane in (dataset, dataset.transpose("r", "d")):
        axes = vijax.plots.curves(table, plane, ground="label").axes[0]
        markers = [np.ravel(line.get_data()) for line in axes.lines if len(line.get_xdata()) == 1]
        positions.append(markers if axes.get_xlabel() == "$d$" else [mark[::-1] for mark in markers])
    assert len(positions[0]) == 3
    np.testing.assert_array_equal(*positions)


def test_grazings_of_unstable_orbits_are_drawn_on_request(curves_by_kind):
    table = vijax.curve_dataset([curves_by_kind["grazing"]])
    opacities = [
        {line.get_alpha() for line in vijax.plots.curves(table, unstable=unstable).axes[0].lines}
        for unstable in (False, True)
    ]
    assert (len(opacities[0]), len(opacities[1])) == (1, 2)


def test_invalid_background_maps_raise(curves_by_kind):
    table = vijax.curve_dataset(list(curves_by_kind.values()))
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
def test_unsupported_maps_raise(dataset, message):
    with pytest.raises(ValueError, match=message):
        vijax.bifurcation_curves(dataset)


@pytest.mark.parametrize(
    ("argument", "value"),
    [("max_seconds", 0.0), ("max_seconds", np.nan), ("max_rounds", -1), ("max_points", 1), ("progress", 3)],
)
def test_invalid_budgets_raise(argument, value):
    with pytest.raises(ValueError, match=f"{argument} must be"):
        vijax.bifurcation_curves(made_map(), **{argument: value})


def test_limits_require_a_map_with_the_variable_admissible():
    with pytest.raises(ValueError, match="limits must be those of a map with admissible"):
        vijax.bifurcation_curves(made_map(), limits=True)
