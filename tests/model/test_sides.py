"""Two walls that differ: values per wall, the pair and the device of such walls, and rejected arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax import Sides
from vijax.model import pair as pairs
from vijax.model.device import (
    depth_unit,
    device_from_attributes,
    pair_and_device,
    with_constants,
    with_fields,
    with_pair,
)
from vijax.model.energy import admissible, harvested_energy
from vijax.model.walls.sides import as_sides, at_wall, field_of, map_walls, values_by_name


def test_values_per_wall_and_values_common_to_both_walls():
    per_wall = Sides(np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    np.testing.assert_array_equal(at_wall(per_wall, np.array([-1, 1])), [1.0, 4.0])
    np.testing.assert_array_equal(at_wall(per_wall, 1), [3.0, 4.0])
    assert at_wall(5.0, -1) == 5.0
    assert map_walls(lambda a, b: a + b, Sides(1, 2), 10) == Sides(11, 12)
    assert map_walls(lambda a: a + 1, 1) == 2
    assert as_sides(7) == Sides(7, 7)
    assert values_by_name("r", Sides(1, 2)) == {"r_left": 1, "r_right": 2}
    assert values_by_name("r", 1) == {"r": 1}


def test_a_pair_accepts_numbers_per_wall():
    pair = vijax.impact_pair([0.2, 0.3], Sides(12.0, [50.0, 60.0]), 0.5, 0.1)
    assert pair.has_unequal_walls
    assert not pair.rigid
    for field in (pair.kappa, pair.r):
        assert field.left.shape == field.right.shape == (2,)
    left, right = pair.at(-1), pair.at(1)
    assert not left.has_unequal_walls
    np.testing.assert_array_equal(left.kappa, [12.0, 12.0])
    np.testing.assert_array_equal(right.kappa, [50.0, 60.0])
    np.testing.assert_allclose(pair.mu.right, right.mu, rtol=1e-15)
    np.testing.assert_allclose(pair.omega1.left, left.omega1, rtol=1e-15)
    rebuilt = pairs.pair_of(pairs.pair_quantities(pair), "soft")
    assert jax.tree.structure(rebuilt) == jax.tree.structure(pair)
    assert all(np.array_equal(*both) for both in zip(jax.tree.leaves(rebuilt), jax.tree.leaves(pair), strict=True))
    plain = vijax.impact_pair(0.2, 12.0, 0.5)
    assert plain.at(1) is plain
    # A rigid wall opposite a soft wall, two rigid walls with different r, and two walls without a stiffness.
    mixed, both_rigid = vijax.impact_pair(0.2, Sides(25.0, None), 0.5), vijax.impact_pair(0.2, None, Sides(0.5, 0.7))
    assert (mixed.walls, mixed.rigid_side, mixed.rigid) == ("rigid_right", 1, False)
    assert (both_rigid.walls, both_rigid.rigid_side, both_rigid.rigid, both_rigid.has_unequal_walls) == (
        "rigid",
        0,
        True,
        True,
    )
    assert vijax.impact_pair(0.2, Sides(None, None), 0.5).walls == "rigid"
    assert vijax.impact_pair(0.2, Sides(None, 25.0), 0.5).walls == "rigid_left"
    assert "kappa_right" not in pairs.pair_quantities(mixed)


def test_computations_per_side_use_the_kind_of_the_wall():
    side = jnp.array([-1.0, 1.0])
    kappa = {"soft": 12.0, "rigid": None, "rigid_left": Sides(None, 12.0), "rigid_right": Sides(12.0, None)}
    expected = {"soft": [1, 1], "rigid": [2, 2], "rigid_left": [2, 1], "rigid_right": [1, 2]}
    for walls, stiffness in kappa.items():
        pair = vijax.impact_pair(0.2, stiffness, Sides(0.5, 0.7))
        assert pair.walls == walls
        kind, r = pair.by_wall_kind(side, lambda wall: (0 * side + 2, wall.r), lambda wall: (0 * side + 1, wall.r))
        np.testing.assert_array_equal(kind, expected[walls])
        np.testing.assert_array_equal(r, [0.5, 0.7])
        np.testing.assert_array_equal(pair.is_rigid_at(side) & np.full(2, True), np.array(expected[walls]) == 2)


def test_mirror_symmetry_requires_equal_walls():
    levels = [0.0, 0.0, 0.1]
    walls = {
        "equal": (40.0, 0.5, [True, True, False]),
        "kappa": (Sides(40.0, [40.0, 41.0, 40.0]), 0.5, [True, False, False]),
        "r": (40.0, Sides(0.5, [0.5, 0.6, 0.5]), [True, False, False]),
        "rigid r": (None, Sides(0.5, [0.5, 0.6, 0.5]), [True, False, False]),
        "one rigid": (Sides(40.0, None), 0.5, [False, False, False]),
    }
    for kappa, r, expected in walls.values():
        pair = vijax.impact_pair(0.2, kappa, r, levels)
        np.testing.assert_array_equal(pair.symmetric, expected)
        if not pair.rigid_side:
            np.testing.assert_array_equal(pairs.has_mirror_symmetry(pairs.pair_quantities(pair)), expected)


def test_a_device_passes_constants_per_wall_to_the_pair():
    device = vijax.Harvester(omega0=Sides(300.0, 500.0), V=Sides(1000.0, 2000.0), A=2.0)
    pair = device.pair()
    assert pair.has_unequal_walls
    np.testing.assert_allclose([pair.kappa.left, pair.kappa.right], [300.0, 500.0], rtol=1e-15)
    np.testing.assert_allclose([device.k.left, device.k.right], [315.0, 875.0], rtol=1e-15)
    assert device.pair("rigid_left").walls == "rigid_left"
    # If any constant differs, the pair has unequal walls, because energies depend on the wall of the impact.
    assert vijax.Harvester(V=Sides(1.0, 2.0)).pair().has_unequal_walls
    depth = 1e-4
    for side, V in ((-1, 1000.0), (1, 2000.0)):
        expected = harvested_energy(vijax.Harvester(V=V), depth)
        np.testing.assert_allclose(harvested_energy(device.at(side), depth), expected, rtol=1e-15)
    back = with_pair(vijax.Harvester(A=2.0), pair)
    np.testing.assert_allclose([back.omega0.left, back.omega0.right], [300.0, 500.0], rtol=1e-14)
    half_rigid = with_pair(vijax.Harvester(A=2.0), vijax.impact_pair(0.2, Sides(None, 30.0), 0.5))
    np.testing.assert_allclose([half_rigid.omega0.left, half_rigid.omega0.right], [400.0, 30.0], rtol=1e-14)
    assert float(half_rigid.s) == pytest.approx(0.2 * 2.0, rel=1e-14)
    rims = vijax.Harvester(R0=Sides(0.0063, 0.007))
    assert rims.depth_limit == Sides(0.0063, 0.007)
    assert not admissible(rims.at(-1), 0.0, 1.0, jnp.asarray(0.0065))
    assert admissible(rims.at(1), 0.0, 1.0, jnp.asarray(0.0065))
    calculated_depth = depth_unit(device, vijax.impact_pair(0.2, None, 0.5))
    assert calculated_depth.left / calculated_depth.right == pytest.approx(5 / 3)


def test_names_of_constants_per_wall():
    device = with_constants(vijax.Harvester(), omega0_left=300.0, k_right=875.0, V_right=1000.0)
    assert float(device.omega0.left) == 300.0
    assert float(device.omega0.right) == pytest.approx(500.0)
    assert Sides(2000.0, 1000.0) == device.V
    assert float(field_of(device, "k_left")) == pytest.approx(315.0)
    assert field_of(device, "A") == 1.0
    assert with_fields(device, {"r": 0.3}).r == 0.3
    attributes = {f"harvester_{name}": value for name, value in values_by_name("V", device.V).items()}
    assert device_from_attributes(attributes).V == device.V


def test_equal_membranes_yield_equal_energies():
    """Stiffness and restitution do not affect the energy of a motion."""
    assert vijax.Harvester().has_equal_membranes
    assert vijax.Harvester(omega0=Sides(1.0, 2.0), r=Sides(0.1, 0.2)).has_equal_membranes
    assert vijax.Harvester(V=Sides(2.0, 2.0)).has_equal_membranes
    for name in ("V", "w0", "eps_M"):
        assert not vijax.Harvester(**{name: Sides(1.0, 2.0)}).has_equal_membranes


@pytest.mark.parametrize("wall", ["soft", "rigid_left"])
def test_pair_and_device_reproduce_a_table(wall):
    table = {"d": 0.2, "kappa_left": 20.0, "kappa_right": 40.0, "r_left": 0.5, "r_right": 0.6, "gamma": 0.0}
    pair, device = pair_and_device(vijax.Harvester(), table | {"A": 2.0, "omega": 6.0}, wall)
    assert pair.walls == wall
    assert float(pair.r.right) == 0.6
    assert float(device.omega0.right) == pytest.approx(40 * 6 / np.pi)


def test_rigid_walls_use_the_stiffness_of_the_table():
    table = {"d": 0.2, "kappa_left": 20.0, "kappa_right": 20.0, "r_left": 0.5, "r_right": 0.6, "gamma": 0.0}
    pair, device = pair_and_device(vijax.Harvester(), table | {"A": 2.0, "omega": np.pi}, "rigid")
    assert (pair.walls, float(device.omega0)) == ("rigid", pytest.approx(20.0))


BAD = [
    (lambda: vijax.impact_pair(0.2, Sides(12.0, -1.0), 0.5), r"kappa_right must be positive .*got -1"),
    (lambda: vijax.impact_pair(0.2, 12.0, Sides(0.5, 1.5)), r"r_right must lie in \(0, 1\]"),
    (lambda: vijax.impact_pair(0.2, Sides([12.0, 13.0], [1.0, 2.0, 3.0]), 0.5), "broadcast"),
    (lambda: vijax.Harvester(A=Sides(1.0, 2.0)), "A must be equal at both walls; only omega0, r, w0"),
    (lambda: vijax.Harvester(R0=Sides(0.0063, 0.004)), "r_b must be smaller than R0_right"),
    (lambda: vijax.Harvester(omega0=Sides(1.0, 0.0)), "omega0_right must be positive"),
    (lambda: harvested_energy(vijax.Harvester(V=Sides(1.0, 2.0)), 1e-4), "device must have equal walls"),
    (lambda: vijax.impact_pair(0.2, Sides(12.0, None), 0.5).mu, "kappa must be a number"),
    (lambda: with_constants(vijax.Harvester(), A_left=2.0), "A_left must be a constant of .* end in _left or _right"),
    (lambda: with_constants(vijax.Harvester(), V_left=1.0, V=2.0), "V_left and V give the same constant; give one for"),
    (lambda: with_constants(vijax.Harvester(), V=2.0, V_left=1.0), "V and V_left give the same constant"),
    (lambda: with_constants(vijax.Harvester(), omega0_left=3.0, k=5.0), "omega0_left and omega0 give the same"),
    (lambda: vijax.trajectory(vijax.impact_pair(0.2, Sides(None, 12.0), 0.5), -0.15, 0.0, 1), "u0 must lie within"),
]


@pytest.mark.parametrize(("act", "words"), BAD, ids=[words[:24] for _, words in BAD])
def test_invalid_arguments_are_rejected(act, words):
    with pytest.raises(ValueError, match=words):
        act()
