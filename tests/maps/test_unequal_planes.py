"""Maps of unequal walls: agreement with equal walls, energies and limits by wall, orbits by shooting."""

import dataclasses

import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax import Sides
from vijax.continuation.from_map.map_borders import device_of
from vijax.maps import sweep as sweeps
from vijax.maps.cells import cells
from vijax.model.device import device_from_attributes
from vijax.model.pair import pair_of

D, KAPPA = np.array([0.2, 0.25]), np.array([30.0, 60.0, 90.0])
NUMBERS = "P", "period", "impacts_left", "impacts_right", "max_penetration", "energy_ratio", "contact_time", "status"


def sides(**values):
    """Sweep devices with different kappa on the left and right wall, from one start."""
    return vijax.sweep(**({"d": D, "kappa_left": KAPPA, "kappa_right": 40.0} | values))


@pytest.fixture(scope="module")
def result():
    return sides()


def test_walls_with_equal_kappa_agree_with_equal_walls():
    sided = [sides(kappa_left=kappa, kappa_right=kappa) for kappa in KAPPA]
    for index, actual in enumerate(sided):
        expected = vijax.sweep(d=D, kappa=KAPPA).isel(kappa=index)
        for name in NUMBERS:
            np.testing.assert_allclose(actual[name], expected[name], rtol=1e-12, err_msg=name)
    assert {"kappa_left", "kappa_right", "r_left", "r_right"} < set(sided[0].coords)
    assert not {"kappa", "r"} & set(sided[0].coords)


@pytest.mark.long
def test_power_of_cells_agrees_with_orbits_by_shooting(result):
    compared = 0
    for i, d in enumerate(D):
        for j, kappa in enumerate(KAPPA):
            cell = result.isel(d=i, kappa_left=j)
            left, right, period = (int(cell[name]) for name in ("impacts_left", "impacts_right", "period"))
            if (left, right, period) != (1, 1, 1):
                continue
            orbit = vijax.find_orbits(vijax.impact_pair(d, Sides(kappa, 40.0), 0.5), "LR", guesses=64)
            powers = np.asarray(vijax.orbit_power(orbit, vijax.Harvester()))
            assert np.abs(powers / float(cell["P"]) - 1).min() < 1e-11
            compared += 1
    assert compared >= 2


def test_rigid_wall_opposite_a_membrane_harvests_nothing():
    kappa, r = 30.0, Sides(0.5, 0.7)
    cell = vijax.sweep(d=0.3, kappa=kappa, r_left=r.left, r_right=r.right, wall="rigid_right")
    pair = vijax.impact_pair(0.3, Sides(kappa, None), r)
    orbit = vijax.find_orbits(pair, "LR", guesses=64)
    powers = np.asarray(vijax.orbit_power(orbit, vijax.Harvester()))
    assert int(cell["period"]) == 1
    assert np.abs(powers / float(cell["P"]) - 1).min() < 1e-11
    assert float(cell["restitution_right"]) == pytest.approx(0.7, rel=1e-14)
    assert np.isinf(cell["kappa_right"])
    right = np.asarray(orbit.sequence.side) == 1
    assert (np.asarray(orbit.depth)[right] == 0).all()
    assert (np.asarray(orbit.work)[right] > 0).all()


def test_power_is_the_sum_over_the_walls(result):
    only = {
        side: sides(device=vijax.Harvester(V=Sides(*V)))
        for side, V in {"left": (2000.0, 0.0), "right": (0.0, 1000.0)}.items()
    }
    both = sides(device=vijax.Harvester(V=Sides(2000.0, 1000.0)))
    np.testing.assert_allclose(only["left"]["P"] + only["right"]["P"], both["P"], rtol=1e-12)
    assert (only["left"]["P"] > 0).all()
    assert (only["right"]["P"] > 0).all()
    np.testing.assert_allclose(only["left"]["P"] + 4 * only["right"]["P"], result["P"], rtol=1e-12)
    assert Sides(2000.0, 1000.0) == device_from_attributes(both.attrs).V


def test_walls_have_separate_penetration_limits(result):
    """A device is admissible if neither membrane is deeper than its rim; the rims may differ."""
    depth = float(result["max_penetration"].isel(d=0, kappa_left=0))
    common = {"w0": 0.1, "r_b": 0.1 * depth}  # a thick membrane, so the energy limit is not reached
    softer = sides(d=D[0], kappa_left=KAPPA[0], device=vijax.Harvester(**common, R0=Sides(1.01 * depth, 0.99 * depth)))
    stiffer = sides(d=D[0], kappa_left=KAPPA[0], device=vijax.Harvester(**common, R0=Sides(0.99 * depth, 1.01 * depth)))
    # The penetration is largest at the softer wall, on the left.
    assert bool(softer["admissible"])
    assert not bool(stiffer["admissible"])
    assert float(softer["max_penetration"]) == pytest.approx(depth, rel=1e-12)


@pytest.mark.long
def test_exchanged_walls_give_equal_power():
    # Compare attractors of many starts; a single start and its mirror image may reach different attractors.
    original = sides(d=0.25, kappa_left=[60.0, 90.0], r_left=0.4, r_right=0.6, starts=8)
    exchanged = vijax.sweep(d=0.25, kappa_right=[60.0, 90.0], kappa_left=40.0, r_left=0.6, r_right=0.4, starts=8)
    np.testing.assert_array_equal(original["attractors"], 1)
    np.testing.assert_allclose(original["P"], exchanged["P"], rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "rtol"),
    [({"method": "ode"}, 1e-6), ({"method": "rk4", "steps": 500}, 0.08)],
    ids=["ode", "rk4"],
)
def test_other_methods_agree_for_unequal_walls(method, rtol):
    cell = {"d": 0.25, "kappa_left": 30.0, "kappa_right": 60.0, "r_left": 0.4, "r_right": 0.6}
    cell |= {"until": "window", "periods": 10, "transient": 40}
    exact, approximate = vijax.sweep(**cell), vijax.sweep(**cell, **method)
    for name in ("P", "restitution_left", "restitution_right"):
        assert float(approximate[name]) == pytest.approx(float(exact[name]), rel=rtol), name


@pytest.mark.long
def test_orbit_diagram_along_kappa_of_a_wall_agrees_with_the_map(result):
    """The device harvests at the right wall only."""
    arguments = {"kappa_right": 40.0, "periods": 200, "device": vijax.Harvester(V=Sides(0.0, 2000.0))}
    diagram = vijax.orbit_diagram(along="kappa_left", values=KAPPA, d=0.25, **arguments)
    cells_of_map = result.sel(d=0.25)
    same_orbit = (
        (diagram["impacts_left"] == cells_of_map["impacts_left"]) & (diagram["period"] == cells_of_map["period"])
    ).values
    assert same_orbit.sum() >= 2
    for name in ("max_penetration", "impacts_right"):
        np.testing.assert_allclose(diagram[name].values[same_orbit], cells_of_map[name].values[same_orbit], rtol=1e-10)
    energy, side = diagram["E"].values, diagram["side"].values
    recorded = np.isfinite(energy)
    np.testing.assert_array_equal(energy[recorded] > 0, side[recorded] > 0)


def test_device_supplies_the_unspecified_quantities_of_a_wall():
    device = vijax.Harvester(omega0=Sides(300.0, 500.0), r=0.4)
    quantities = cells({"d": 0.2, "kappa_left": [20.0, 30.0]}, device, "soft").quantities
    assert quantities["kappa_left"].dims == ("kappa_left",)
    assert float(quantities["kappa_right"]) == pytest.approx(500.0)
    assert float(quantities["r_left"]) == float(quantities["r_right"]) == 0.4
    # A common axis applies to both walls; a rigid left wall has no membrane.
    both = cells({"d": 0.2, "omega0": [20.0, 30.0], "r_left": 0.3}, vijax.Harvester(), "soft")
    assert both.quantities["kappa_left"].dims == both.quantities["kappa_right"].dims == ("omega0",)
    assert both.has_unequal_walls
    mixed = cells({"d": 0.2, "kappa": 30.0}, vijax.Harvester(), "rigid_left")
    assert (
        pair_of({name: float(mixed.quantities[name]) for name in mixed.pair_names}, "rigid_left").walls == "rigid_left"
    )


BAD = [
    ({"kappa": 3.0, "kappa_left": 4.0}, "kappa and kappa_left give the same quantity; give one for both walls"),
    ({"omega0": 3.0, "k_right": 4.0}, "omega0 and k_right give the same quantity"),
    ({"omega0_left": 3.0, "k_left": 4.0}, "omega0_left and k_left give the same quantity; give one of them"),
    ({"r_left": 1.5}, r"r_left must lie in \(0, 1\]; got 1.5"),
    ({"kappa_left": 3.0, "wall": "rigid"}, "kappa_left must be left out with rigid walls"),
    ({"wall": "rigid", "device": vijax.Harvester(V=Sides(1.0, 2.0))}, "device.V must be one number for rigid walls"),
    ({"kappa_left": 3.0, "wall": "rigid_left"}, 'kappa_left must be left out with wall="rigid_left"'),
    ({"wall": "rigid_right", "u0": 0.15}, "u0 must lie in the gap of a rigid wall"),
    ({"wall": "rigid_right", "method": "ode"}, 'wall must be "soft" for method="ode"'),
    ({"r_left": 0.5, "method": "ode", "membrane": vijax.HuntCrossley(0.5)}, "r_left must be left out with a membrane"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[message[:30] for _, message in BAD])
def test_invalid_arguments_are_rejected_before_any_simulation(arguments, message):
    with pytest.raises(ValueError, match=message):
        vijax.sweep(**({"d": 0.2} | arguments))


@pytest.mark.long
def test_mirror_images_with_different_power_are_two_attractors():
    """The walls differ only in the voltage of their membranes."""
    arguments = {"d": 0.14, "kappa": 60.0, "starts": 8}
    equal, unequal = vijax.sweep(**arguments), vijax.sweep(**arguments, device=vijax.Harvester(V=Sides(2000.0, 0.0)))
    assert int(unequal["attractors"]) > int(equal["attractors"])
    assert float(unequal["P_least"]) < 0.7 * float(unequal["P_greatest"])
    with pytest.raises(ValueError, match="merge_mirrors must be left out"):
        vijax.basin_fractions(d=0.2, merge_mirrors=True, starts=2, device=vijax.Harvester(V=Sides(2000.0, 0.0)))


def test_comparison_rejects_unequal_walls():
    with pytest.raises(ValueError, match="kappa_left must be left out of a comparison"):
        vijax.compare(d=0.2, kappa_left=30.0)


def test_device_of_a_map_with_an_axis_for_both_walls():
    """An axis for both walls sets the value of the left and of the right wall."""
    with no_cell_runs():
        result = vijax.sweep(d=D, kappa=KAPPA, r_left=0.4, device=vijax.Harvester(V=Sides(1000.0, 2000.0)))
    device = device_of(result)
    assert (float(device.omega0.left), float(device.omega0.right)) == (KAPPA[0], KAPPA[0])
    assert (float(device.r.left), float(device.r.right)) == (0.4, 0.5)
    assert Sides(1000.0, 2000.0) == device.V


def test_mirror_images_are_merged_only_for_equal_walls():
    with pytest.raises(ValueError, match="merge_mirrors must be left out unless both walls are alike everywhere"):
        vijax.basin_fractions(d=0.2, kappa_left=20.0, kappa_right=30.0, merge_mirrors=True, starts=2)
    equal = sweeps.plan({"d": 0.2, "kappa_left": 20.0, "kappa_right": 20.0}, ["P"])
    unequal = dataclasses.replace(
        equal, cells=cells({"d": 0.2, "kappa_left": 20.0, "r_left": 0.4}, vijax.Harvester(), "soft")
    )
    for planned, expected in ((equal, True), (unequal, False)):
        assert planned.cells.pair(np.array([0]), "soft").symmetric[0] == expected
