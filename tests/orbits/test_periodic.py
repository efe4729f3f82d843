"""Periodic orbits: 50-digit ones found again, stable or not; nothing called an orbit that the ball does not follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import reference_orbits, reference_rows
from vijax.model.device import Harvester
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import orbit_properties, orbit_search, periodic, symmetry
from vijax.orbits.shooting import Sequence


def guessed(knots, walls, pair, period=1):
    """Solve from knots of one orbit."""
    wide = jax.tree.map(lambda leaf: jnp.atleast_1d(leaf), pair)
    walls = Sequence(jnp.asarray([walls], jnp.int32), jnp.array([2.0 * period]), jnp.array([False]))
    return periodic.solve(wide, walls, jnp.asarray(knots)[None])


@pytest.mark.parametrize("reference", reference_orbits(), ids=lambda orbit: f"kappa {float(orbit.pair.kappa)}")
def test_reference_orbits(reference):
    found = guessed(reference.knots * (1 + 0.02 * np.array([1, -1, 1])), reference.side, reference.pair)
    assert found.status[0] == Status.OK
    assert found.residual[0] < 1e-13
    np.testing.assert_allclose(found.knots[0], reference.knots, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.depth[0], reference.depth, rtol=0, atol=1e-12)
    # The reference lists a pair in no order.
    mine, theirs = (np.sort_complex(np.round(np.asarray(x), 9)) for x in (found.multipliers[0], reference.multipliers))
    np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-8)
    # Its length unit is a metre: A = 1 and omega = pi.
    np.testing.assert_allclose(orbit_properties.power(found, Harvester()), reference.P, rtol=1e-12)


@pytest.fixture(scope="module")
def rigid():
    """Orbits with one right and two left impacts, rigid walls, d = 0.18, where the paper names an unstable one."""
    return orbit_search.search(impact_pair(0.18, None, 0.5), "RLL", guesses=256)


def test_the_unstable_orbit_is_found(rigid):
    assert len(rigid) == 1
    # Unstable by a flip.
    assert rigid.multipliers[0, 0].real < -1.1
    assert tuple(int(x[0]) for x in orbit_properties.counts(rigid)) == (2, 1, 1)


def test_a_virtual_orbit_is_called_so():
    # The flight of this orbit grazes a wall at d = 0.1816: below, the equations still hold and the ball does not obey.
    real = orbit_search.search(impact_pair(0.183, None, 0.5), "RL", guesses=256)
    real = real[np.flatnonzero(~np.asarray(symmetry.symmetric(real)))[[0, 0]]]
    there = periodic.solve(impact_pair([0.182, 0.181], None, 0.5), real.sequence, real.knots)
    assert (there.residual < 1e-13).all()
    np.testing.assert_array_equal(there.status, [Status.OK, Status.VIRTUAL])
    assert np.isnan(there.depth[1]).all()


def test_from_states_to_orbits_and_their_labels():
    # The first two states lie near 50-digit orbits, the last meets no wall.
    rows = reference_rows()
    u, v = (np.array([row["strobe"][i] for row in rows[:2]] + [0.0]) for i in (0, 1))
    d, kappa = np.array([0.2, 0.2, 0.3]), np.array([12.65, 40.0, 40.0])
    found = orbit_search.from_state(impact_pair(d, kappa, 0.5), u + 0.002, v, period=2)
    np.testing.assert_array_equal(found.status, [Status.OK, Status.OK, Status.NO_ORBIT])
    # Flown for two periods, but of period one.
    assert [tuple(int(x) for x in row) for row in np.transpose(orbit_properties.counts(found))][:2] == [(1, 1, 1)] * 2
    power = orbit_properties.power(found, Harvester())
    np.testing.assert_allclose(power[:2], [float(r["P_J"]) for r in rows[:2]], rtol=1e-12)
    assert np.isinf(found.residual[2])


def test_mirror_images_are_two_orbits():
    # With rigid walls their speeds are the same: they differ in phase alone.
    found = orbit_search.search(impact_pair(0.19, None, 0.5), "RL", guesses=256)
    speeds = np.sort(np.asarray(found.knots[:, 0, 1]))
    assert len(found) == 3
    assert speeds[1] == pytest.approx(speeds[2], abs=1e-12)


def test_motion_that_only_touches_a_wall_is_no_orbit():
    # d > 2/pi^2: the neutral motion about the middle, moved sideways until it grazes, solves the equations.
    assert len(orbit_search.search(impact_pair(0.5, None, 0.9), "L", guesses=256)) == 0


def test_a_symmetric_orbit_closed_half_way_is_the_same():
    reference = reference_orbits()[0]
    full = guessed(reference.knots, reference.side, reference.pair)
    half = symmetry.halved(full)
    assert half.count[0] == 1
    assert half.status[0] == Status.OK
    np.testing.assert_allclose(np.sort_complex(half.multipliers[0]), np.sort_complex(full.multipliers[0]), atol=1e-12)
    wide = periodic.widened(half, 3)
    for again in (symmetry.unfolded(half), symmetry.doubled(half), symmetry.unfolded(wide)):
        np.testing.assert_allclose(again.knots, full.knots, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="orbit must be symmetric"):
        symmetry.halved(guessed(reference_orbits()[1].knots, reference_orbits()[1].side, reference_orbits()[1].pair))


def test_an_impact_at_phase_0_is_no_obstacle():
    # Between these stiffnesses the onset passes through the phase at which a stroboscopic section would be taken.
    reference = reference_orbits()[0]
    kappa = np.linspace(12.65, 8.0, 32)
    knots, phase = jnp.asarray(reference.knots), []
    for value in kappa:
        found = guessed(knots, reference.side, impact_pair(0.2, value, 0.5))
        assert found.status[0] == Status.OK
        knots = found.knots[0]
        phase.append(float(knots[0, 0]))
    assert min(phase) < 0.01
    assert max(phase) > 1.99


def test_the_path_is_the_motion():
    reference = reference_orbits()[0]
    orbit = guessed(reference.knots, reference.side, reference.pair)
    t, u, v = (x[0] for x in orbit_properties.path(orbit, samples=401))
    assert (np.diff(t) >= 0).all()
    assert t[-1] - t[0] == pytest.approx(2.0)
    assert (u[0], v[0]) == pytest.approx((u[-1], v[-1]))
    assert u.max() - 0.5 * 0.2 == pytest.approx(reference.depth.max(), abs=1e-6)
    # Displacement is the integral of the velocity.
    np.testing.assert_allclose(np.diff(u), 0.5 * (v[1:] + v[:-1]) * np.diff(t), atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: orbit_search.search(p, "RXL"), "impacts must be walls"),
        (lambda p: orbit_search.search(p, "0:0"), "impacts must be 1 to 64"),
        (lambda p: orbit_search.search(p, "1:2/2T", 3), "period must agree"),
        (lambda p: orbit_search.search(p, "1:1/0T"), "impacts must be walls"),
        (lambda p: orbit_search.search(p, "RL", 1.5), "period must be a whole number"),
        (lambda p: orbit_search.search(p, "RL", guesses=0), "guesses must be a whole number"),
        (lambda p: orbit_search.search(impact_pair([0.1, 0.2], 40.0, 0.5), "RL"), "pair must be one cell"),
        (
            lambda p: orbit_search.from_state(impact_pair([[0.1, 0.2]], 40.0, 0.5), 0.0, 0.1),
            r"pair must be one cell, or one a state; got d of shape \(1, 2\); flatten its fields and the states",
        ),
        (lambda p: orbit_search.from_state(p, 0.0, 0.1, 2.5), "t must lie in"),
        (lambda p: orbit_search.from_state(p, 0.0, 0.1, period=0), "period must be a whole number of at least 1"),
        (lambda p: orbit_search.from_state(p, 0.0, 0.1, settle=-1), "settle must be a whole number of at least 0"),
    ],
)
def test_bad_input_is_told(call, message):
    with pytest.raises(ValueError, match=message):
        call(impact_pair(0.2, 40.0, 0.5))


def test_labels_become_cyclically_distinct_sequences():
    assert orbit_search.sequences("1:2") == ([(-1, 1, 1)], 1)
    assert orbit_search.sequences("rll", 3) == ([(1, -1, -1)], 3)
    every, period = orbit_search.sequences("2:2/3T")
    assert period == 3
    assert every == [(-1, -1, 1, 1), (-1, 1, -1, 1)]


def test_no_core_is_left_without_a_tile_for_the_sake_of_a_larger_one(monkeypatch):
    """A search of 2,048 guesses would fill half of a call of 4,096 rows with padding."""
    sizes = []

    def work(rows):
        sizes.append(len(rows[0]))
        return rows

    monkeypatch.setattr(periodic.tiles, "workers", lambda: 2)
    for count, wanted in ((20, {32}), (300, {256}), (2048, {1024}), (5000, {1024}), (9000, {4096})):
        sizes.clear()
        (found,) = periodic._by_tiles(work, (np.arange(float(count)),))
        np.testing.assert_array_equal(found, np.arange(float(count)))
        assert set(sizes) == wanted, count
