"""Maps of walls that differ: as equal ones where they agree, energies and limits by wall, orbits as they are shot."""

import dataclasses

import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax import Sides
from vijax.model.device import told_device
from vijax.model.pair import pair_of
from vijax.orbits.map_borders import device_of
from vijax.planes import sweep as sweeps
from vijax.planes.cells import cells

D, KAPPA = np.array([0.2, 0.25]), np.array([30.0, 60.0, 90.0])
NUMBERS = "P", "period", "impacts_left", "impacts_right", "max_penetration", "energy_ratio", "contact_time", "status"


def sides(**values):
    """Cells of walls of a kappa of their own each, from one start."""
    return vijax.sweep(**({"d": D, "kappa_left": KAPPA, "kappa_right": 40.0} | values))


@pytest.fixture(scope="module")
def found():
    return sides()


def test_walls_of_one_kappa_are_equal_walls():
    own = [sides(kappa_left=kappa, kappa_right=kappa) for kappa in KAPPA]
    for index, one in enumerate(own):
        whole = vijax.sweep(d=D, kappa=KAPPA).isel(kappa=index)
        for name in NUMBERS:
            np.testing.assert_allclose(one[name], whole[name], rtol=1e-12, err_msg=name)
    assert {"kappa_left", "kappa_right", "r_left", "r_right"} < set(own[0].coords)
    assert not {"kappa", "r"} & set(own[0].coords)


@pytest.mark.long
def test_cells_are_the_orbits_that_the_equations_have(found):
    seen = 0
    for i, d in enumerate(D):
        for j, kappa in enumerate(KAPPA):
            cell = found.isel(d=i, kappa_left=j)
            left, right, period = (int(cell[name]) for name in ("impacts_left", "impacts_right", "period"))
            if (left, right, period) != (1, 1, 1):
                continue
            orbit = vijax.find_orbits(vijax.impact_pair(d, Sides(kappa, 40.0), 0.5), "LR", guesses=64)
            powers = np.asarray(vijax.orbit_power(orbit, vijax.Harvester()))
            assert np.abs(powers / float(cell["P"]) - 1).min() < 1e-11
            seen += 1
    assert seen >= 2


def test_a_rigid_wall_beside_a_membrane_yields_nothing():
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


def test_energies_are_those_of_the_wall_that_is_met(found):
    only = {
        side: sides(device=vijax.Harvester(V=Sides(*V)))
        for side, V in {"left": (2000.0, 0.0), "right": (0.0, 1000.0)}.items()
    }
    both = sides(device=vijax.Harvester(V=Sides(2000.0, 1000.0)))
    np.testing.assert_allclose(only["left"]["P"] + only["right"]["P"], both["P"], rtol=1e-12)
    assert (only["left"]["P"] > 0).all()
    assert (only["right"]["P"] > 0).all()
    np.testing.assert_allclose(only["left"]["P"] + 4 * only["right"]["P"], found["P"], rtol=1e-12)
    assert Sides(2000.0, 1000.0) == told_device(both.attrs).V


def test_each_wall_has_a_limit_of_its_own(found):
    """A membrane that is no deeper than its own rim is admissible, whatever the other one's is."""
    depth = float(found["max_penetration"].isel(d=0, kappa_left=0))
    kept = {"w0": 0.1, "r_b": 0.1 * depth}  # thick: no energy is in the way
    softer = sides(d=D[0], kappa_left=KAPPA[0], device=vijax.Harvester(**kept, R0=Sides(1.01 * depth, 0.99 * depth)))
    stiffer = sides(d=D[0], kappa_left=KAPPA[0], device=vijax.Harvester(**kept, R0=Sides(0.99 * depth, 1.01 * depth)))
    # The softer wall, on the left, is entered deepest.
    assert bool(softer["admissible"])
    assert not bool(stiffer["admissible"])
    assert float(softer["max_penetration"]) == pytest.approx(depth, rel=1e-12)


@pytest.mark.long
def test_exchanged_walls_give_the_same_with_sides_exchanged():
    # Attractors that many starts share: which of several one start meets is no mirror image of the other's.
    one = sides(d=0.25, kappa_left=[60.0, 90.0], r_left=0.4, r_right=0.6, starts=8)
    other = vijax.sweep(d=0.25, kappa_right=[60.0, 90.0], kappa_left=40.0, r_left=0.6, r_right=0.4, starts=8)
    np.testing.assert_array_equal(one["attractors"], 1)
    np.testing.assert_allclose(one["P"], other["P"], rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("told", "near"),
    [({"method": "ode"}, 1e-6), ({"method": "rk4", "steps": 500}, 0.08)],
    ids=["ode", "rk4"],
)
def test_other_methods_meet_the_same_walls(told, near):
    cell = {"d": 0.25, "kappa_left": 30.0, "kappa_right": 60.0, "r_left": 0.4, "r_right": 0.6}
    cell |= {"until": "window", "periods": 10, "transient": 40}
    exact, found = vijax.sweep(**cell), vijax.sweep(**cell, **told)
    for name in ("P", "restitution_left", "restitution_right"):
        assert float(found[name]) == pytest.approx(float(exact[name]), rel=near), name


@pytest.mark.long
def test_a_diagram_along_one_wall_has_the_cells_of_the_map(found):
    """Of a device that harvests at the right wall alone."""
    told = {"kappa_right": 40.0, "periods": 200, "device": vijax.Harvester(V=Sides(0.0, 2000.0))}
    diagram = vijax.orbit_diagram(along="kappa_left", values=KAPPA, d=0.25, **told)
    there = found.sel(d=0.25)
    alike = ((diagram["impacts_left"] == there["impacts_left"]) & (diagram["period"] == there["period"])).values
    assert alike.sum() >= 2
    for name in ("max_penetration", "impacts_right"):
        np.testing.assert_allclose(diagram[name].values[alike], there[name].values[alike], rtol=1e-10)
    energy, side = diagram["E"].values, diagram["side"].values
    known = np.isfinite(energy)
    np.testing.assert_array_equal(energy[known] > 0, side[known] > 0)


def test_what_is_not_given_of_a_wall_is_the_device_s():
    device = vijax.Harvester(omega0=Sides(300.0, 500.0), r=0.4)
    quantities = cells({"d": 0.2, "kappa_left": [20.0, 30.0]}, device, "soft").quantities
    assert quantities["kappa_left"].dims == ("kappa_left",)
    assert float(quantities["kappa_right"]) == pytest.approx(500.0)
    assert float(quantities["r_left"]) == float(quantities["r_right"]) == 0.4
    # A common axis stands for both, and one kind of wall leaves the membrane of the other out.
    both = cells({"d": 0.2, "omega0": [20.0, 30.0], "r_left": 0.3}, vijax.Harvester(), "soft")
    assert both.quantities["kappa_left"].dims == both.quantities["kappa_right"].dims == ("omega0",)
    assert both.unequal
    mixed = cells({"d": 0.2, "kappa": 30.0}, vijax.Harvester(), "rigid_left")
    assert (
        pair_of({name: float(mixed.quantities[name]) for name in mixed.pair_names}, "rigid_left").walls == "rigid_left"
    )


BAD = [
    ({"kappa": 3.0, "kappa_left": 4.0}, "kappa and kappa_left give the same quantity; give one for both walls"),
    ({"omega0": 3.0, "k_right": 4.0}, "omega0 and k_right give the same quantity"),
    ({"omega0_left": 3.0, "k_left": 4.0}, "omega0_left and k_left give the same quantity; give one of them"),
    ({"r_left": 1.5}, r"r_left must lie in \(0, 1\]; got 1.5"),
    ({"kappa_left": 3.0, "wall": "rigid"}, "kappa_left must be left out of rigid walls"),
    ({"wall": "rigid", "device": vijax.Harvester(V=Sides(1.0, 2.0))}, "device.V must be one number for rigid walls"),
    ({"kappa_left": 3.0, "wall": "rigid_left"}, 'kappa_left must be left out with wall="rigid_left"'),
    ({"wall": "rigid_right", "u0": 0.15}, "u0 must lie in the gap of a rigid wall"),
    ({"wall": "rigid_right", "method": "ode"}, 'wall must be "soft" for method="ode"'),
    ({"r_left": 0.5, "method": "ode", "membrane": vijax.HuntCrossley(0.5)}, "r_left must be left out with a membrane"),
]


@pytest.mark.parametrize(("given", "words"), BAD, ids=[words[:30] for _, words in BAD])
def test_what_cannot_be_is_told_before_anything_runs(given, words):
    with pytest.raises(ValueError, match=words):
        vijax.sweep(**({"d": 0.2} | given))


@pytest.mark.long
def test_mirror_images_that_yield_apart_are_two_attractors():
    """Of walls that are alike but for what their membranes yield."""
    told = {"d": 0.14, "kappa": 60.0, "starts": 8}
    equal, apart = vijax.sweep(**told), vijax.sweep(**told, device=vijax.Harvester(V=Sides(2000.0, 0.0)))
    assert int(apart["attractors"]) > int(equal["attractors"])
    assert float(apart["P_least"]) < 0.7 * float(apart["P_greatest"])
    with pytest.raises(ValueError, match="merge_mirrors must be left out"):
        vijax.basin_fractions(d=0.2, merge_mirrors=True, starts=2, device=vijax.Harvester(V=Sides(2000.0, 0.0)))


def test_a_comparison_is_of_one_membrane():
    with pytest.raises(ValueError, match="kappa_left must be left out of a comparison"):
        vijax.compare(d=0.2, kappa_left=30.0)


def test_curves_know_the_device_of_a_map_whose_walls_share_an_axis():
    """What is given for both stands in what each has."""
    with no_cell_runs():
        found = vijax.sweep(d=D, kappa=KAPPA, r_left=0.4, device=vijax.Harvester(V=Sides(1000.0, 2000.0)))
    device = device_of(found)
    assert (float(device.omega0.left), float(device.omega0.right)) == (KAPPA[0], KAPPA[0])
    assert (float(device.r.left), float(device.r.right)) == (0.4, 0.5)
    assert Sides(1000.0, 2000.0) == device.V


def test_mirror_images_are_merged_only_where_walls_are_alike():
    with pytest.raises(ValueError, match="merge_mirrors must be left out unless both walls are alike everywhere"):
        vijax.basin_fractions(d=0.2, kappa_left=20.0, kappa_right=30.0, merge_mirrors=True, starts=2)
    alike = sweeps.plan({"d": 0.2, "kappa_left": 20.0, "kappa_right": 20.0}, ["P"])
    apart = dataclasses.replace(
        alike, cells=cells({"d": 0.2, "kappa_left": 20.0, "r_left": 0.4}, vijax.Harvester(), "soft")
    )
    for planned, wanted in ((alike, True), (apart, False)):
        assert planned.cells.pair(np.array([0]), "soft").symmetric[0] == wanted
