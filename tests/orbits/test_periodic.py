"""Periodic orbits: references in 50 digits are reproduced, and motions that the ball cannot follow are rejected."""

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


def solve_from_guess(impact_unknowns, walls, pair, period=1):
    """Solve for one orbit from a guess of its impact unknowns."""
    wide = jax.tree.map(lambda leaf: jnp.atleast_1d(leaf), pair)
    walls = Sequence(jnp.asarray([walls], jnp.int32), jnp.array([2.0 * period]), jnp.array([False]))
    return periodic.solve(wide, walls, jnp.asarray(impact_unknowns)[None])


@pytest.mark.parametrize("reference", reference_orbits(), ids=lambda orbit: f"kappa {float(orbit.pair.kappa)}")
def test_reference_orbits_are_reproduced(reference):
    orbit = solve_from_guess(
        reference.impact_unknowns * (1 + 0.02 * np.array([1, -1, 1])), reference.side, reference.pair
    )
    assert orbit.status[0] == Status.OK
    assert orbit.residual[0] < 1e-13
    np.testing.assert_allclose(orbit.impact_unknowns[0], reference.impact_unknowns, rtol=0, atol=1e-12)
    np.testing.assert_allclose(orbit.depth[0], reference.depth, rtol=0, atol=1e-12)
    # The order of the two multipliers is arbitrary in the reference.
    actual, expected = (
        np.sort_complex(np.round(np.asarray(x), 9)) for x in (orbit.multipliers[0], reference.multipliers)
    )
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8)
    # The unit of length is a metre because A = 1 and omega = pi.
    np.testing.assert_allclose(orbit_properties.orbit_power(orbit, Harvester()), reference.P, rtol=1e-12)


@pytest.fixture(scope="module")
def rigid():
    """Return orbits with one right and two left impacts, rigid walls, d = 0.18; the paper has an unstable one there."""
    return orbit_search.find_orbits(impact_pair(0.18, None, 0.5), "RLL", guesses=256)


def test_search_returns_the_unstable_orbit(rigid):
    assert len(rigid) == 1
    # A multiplier below -1: the orbit lost its stability at a flip.
    assert rigid.multipliers[0, 0].real < -1.1
    assert tuple(int(x[0]) for x in orbit_properties.counts(rigid)) == (2, 1, 1)


def test_virtual_orbit_has_the_status_virtual():
    # The flight of this orbit grazes a wall at d = 0.1816; below, the solution of the equations crosses the wall.
    real = orbit_search.find_orbits(impact_pair(0.183, None, 0.5), "RL", guesses=256)
    real = real[np.flatnonzero(~np.asarray(symmetry.is_symmetric(real)))[[0, 0]]]
    orbits = periodic.solve(impact_pair([0.182, 0.181], None, 0.5), real.sequence, real.impact_unknowns)
    assert (orbits.residual < 1e-13).all()
    np.testing.assert_array_equal(orbits.status, [Status.OK, Status.VIRTUAL])
    assert np.isnan(orbits.depth[1]).all()


def test_orbits_from_states_and_their_labels():
    # The first two states lie near 50-digit orbits, the last state never reaches a wall.
    rows = reference_rows()
    u, v = (np.array([row["strobe"][i] for row in rows[:2]] + [0.0]) for i in (0, 1))
    d, kappa = np.array([0.2, 0.2, 0.3]), np.array([12.65, 40.0, 40.0])
    orbits = orbit_search.orbits_from_states(impact_pair(d, kappa, 0.5), u + 0.002, v, period=2)
    np.testing.assert_array_equal(orbits.status, [Status.OK, Status.OK, Status.NO_ORBIT])
    # The simulation covers two periods, but the orbits have period one.
    assert [tuple(int(x) for x in row) for row in np.transpose(orbit_properties.counts(orbits))][:2] == [(1, 1, 1)] * 2
    power = orbit_properties.orbit_power(orbits, Harvester())
    np.testing.assert_allclose(power[:2], [float(r["P_J"]) for r in rows[:2]], rtol=1e-12)
    assert np.isinf(orbits.residual[2])


def test_mirror_images_are_two_orbits():
    # With rigid walls their speeds are equal; only their phases differ.
    orbits = orbit_search.find_orbits(impact_pair(0.19, None, 0.5), "RL", guesses=256)
    speeds = np.sort(np.asarray(orbits.impact_unknowns[:, 0, 1]))
    assert len(orbits) == 3
    assert speeds[1] == pytest.approx(speeds[2], abs=1e-12)


def test_neutral_motion_that_grazes_a_wall_is_not_an_orbit():
    # If d > 2/pi^2, the motion without impacts, displaced until it grazes a wall, solves the equations.
    assert len(orbit_search.find_orbits(impact_pair(0.5, None, 0.9), "L", guesses=256)) == 0


def test_symmetric_orbit_closed_half_way_equals_the_full_orbit():
    reference = reference_orbits()[0]
    full = solve_from_guess(reference.impact_unknowns, reference.side, reference.pair)
    half = symmetry.close_half_way(full)
    assert half.count[0] == 1
    assert half.status[0] == Status.OK
    np.testing.assert_allclose(np.sort_complex(half.multipliers[0]), np.sort_complex(full.multipliers[0]), atol=1e-12)
    wide = periodic.pad_orbits(half, 3)
    for unfolded in (symmetry.unfold(half), symmetry.double(half), symmetry.unfold(wide)):
        np.testing.assert_allclose(unfolded.impact_unknowns, full.impact_unknowns, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="orbit must be symmetric"):
        symmetry.close_half_way(
            solve_from_guess(
                reference_orbits()[1].impact_unknowns, reference_orbits()[1].side, reference_orbits()[1].pair
            )
        )


def test_onset_passes_through_phase_0():
    # Between these stiffnesses the onset passes through the phase of a stroboscopic section.
    reference = reference_orbits()[0]
    kappa = np.linspace(12.65, 8.0, 32)
    impact_unknowns, phase = jnp.asarray(reference.impact_unknowns), []
    for value in kappa:
        orbit = solve_from_guess(impact_unknowns, reference.side, impact_pair(0.2, value, 0.5))
        assert orbit.status[0] == Status.OK
        impact_unknowns = orbit.impact_unknowns[0]
        phase.append(float(impact_unknowns[0, 0]))
    assert min(phase) < 0.01
    assert max(phase) > 1.99


def test_path_is_the_motion_of_the_orbit():
    reference = reference_orbits()[0]
    orbit = solve_from_guess(reference.impact_unknowns, reference.side, reference.pair)
    t, u, v = (x[0] for x in orbit_properties.orbit_path(orbit, samples=401))
    assert (np.diff(t) >= 0).all()
    assert t[-1] - t[0] == pytest.approx(2.0)
    assert (u[0], v[0]) == pytest.approx((u[-1], v[-1]))
    assert u.max() - 0.5 * 0.2 == pytest.approx(reference.depth.max(), abs=1e-6)
    # The displacement is the integral of the velocity.
    np.testing.assert_allclose(np.diff(u), 0.5 * (v[1:] + v[:-1]) * np.diff(t), atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: orbit_search.find_orbits(p, "RXL"), "impacts must be walls"),
        (lambda p: orbit_search.find_orbits(p, "0:0"), "impacts must be 1 to 64"),
        (lambda p: orbit_search.find_orbits(p, "1:2/2T", 3), "period must agree"),
        (lambda p: orbit_search.find_orbits(p, "1:1/0T"), "impacts must be walls"),
        (lambda p: orbit_search.find_orbits(p, "RL", 1.5), "period must be a whole number"),
        (lambda p: orbit_search.find_orbits(p, "RL", guesses=0), "guesses must be a whole number"),
        (lambda p: orbit_search.find_orbits(impact_pair([0.1, 0.2], 40.0, 0.5), "RL"), "pair must be one cell"),
        (
            lambda p: orbit_search.orbits_from_states(impact_pair([[0.1, 0.2]], 40.0, 0.5), 0.0, 0.1),
            r"pair must be one cell, or one a state; got d of shape \(1, 2\); flatten its fields and the states",
        ),
        (lambda p: orbit_search.orbits_from_states(p, 0.0, 0.1, 2.5), "t must lie in"),
        (
            lambda p: orbit_search.orbits_from_states(p, 0.0, 0.1, period=0),
            "period must be a whole number of at least 1",
        ),
        (
            lambda p: orbit_search.orbits_from_states(p, 0.0, 0.1, settle=-1),
            "settle must be a whole number of at least 0",
        ),
    ],
)
def test_bad_input_raises(call, message):
    with pytest.raises(ValueError, match=message):
        call(impact_pair(0.2, 40.0, 0.5))


def test_labels_become_cyclically_distinct_sequences():
    assert orbit_search.sequences("1:2") == ([(-1, 1, 1)], 1)
    assert orbit_search.sequences("rll", 3) == ([(1, -1, -1)], 3)
    sequences, period = orbit_search.sequences("2:2/3T")
    assert period == 3
    assert sequences == [(-1, -1, 1, 1), (-1, 1, -1, 1)]


def test_tiles_occupy_all_cores(monkeypatch):
    """A search of 2,048 guesses would fill half of a call of 4,096 rows with padding."""
    sizes = []

    def work(rows):
        sizes.append(len(rows[0]))
        return rows

    monkeypatch.setattr(periodic.tiles, "workers", lambda: 2)
    for count, expected in ((20, {32}), (300, {256}), (2048, {1024}), (5000, {1024}), (9000, {4096})):
        sizes.clear()
        (result,) = periodic._by_tiles(work, (np.arange(float(count)),))
        np.testing.assert_array_equal(result, np.arange(float(count)))
        assert set(sizes) == expected, count
