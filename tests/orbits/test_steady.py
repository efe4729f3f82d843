"""Steady states: values and derivatives of orbits in 50 digits, second derivatives, and NaN where no orbit attracts."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import reference_orbits, reference_rows
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.orbits import orbit_properties, orbit_search, periodic
from vijax.orbits.shooting import Sequence
from vijax.orbits.steady import steady

DEVICE = Harvester()


def reference_batch(references, factor=1.0):
    """Return the orbits of the references, with impact unknowns multiplied by a factor."""
    # No leaf is weakly typed; a weak type would compile the program again for other orbits.
    pair = jax.tree.map(lambda *x: jnp.asarray(np.array(x)), *(reference.pair for reference in references))
    count = len(references)
    side = jnp.asarray([reference.side for reference in references], jnp.int32)
    sequence = Sequence(side, jnp.full(count, 2.0, float), jnp.zeros(count, bool))
    blank = jnp.full(side.shape, jnp.nan, float)
    impact_unknowns = jnp.asarray([reference.impact_unknowns for reference in references]) * factor
    return periodic.Orbit(
        pair,
        sequence,
        impact_unknowns,
        blank,
        blank,
        jnp.zeros((count, 2), complex),
        blank[:, 0],
        jnp.zeros(count, jnp.int32),
    )


def power_and_speed(pair, orbit):
    """Return power (energy per half period) and largest speed, which the tests differentiate, and the steady state."""
    state = steady(DEVICE, orbit, pair=pair)
    return jnp.stack([state.P, state.speed]), state


@pytest.fixture(scope="module")
def reference_results():
    """Return guesses 1 % off the references, the forward derivative, and the derivatives and steady states."""
    guess = reference_batch(reference_orbits(), 1 + 0.01 * np.array([1, -1, 1]))
    slope = jax.jit(jax.vmap(jax.jacfwd(power_and_speed, has_aux=True)))
    return guess, slope, *slope(guess.pair, guess)


def test_values_match_50_digits(reference_results):
    _, _, _, state = reference_results
    np.testing.assert_array_equal(state.status, Status.OK)
    for index, (row, reference) in enumerate(zip(reference_rows(), reference_orbits(), strict=True)):
        assert float(state.P[index]) == pytest.approx(float(row["P_J"]), rel=1e-13)
        np.testing.assert_allclose(state.depth[index], reference.depth, rtol=1e-12)
        assert float(state.multiplier[index]) == pytest.approx(np.abs(reference.multipliers).max(), rel=1e-10)


def test_derivatives_by_kappa_match_50_digits(reference_results):
    _, _, slopes, _ = reference_results
    expected = [float(row["dP_dkappa"]) for row in reference_rows()]
    np.testing.assert_allclose(slopes.kappa[:, 0], expected, rtol=1e-12)


def test_derivatives_by_all_parameters_match_finite_differences(reference_results):
    guess, slope, slopes, _ = reference_results
    for name in ("d", "kappa", "r", "gamma"):
        step = 1e-3 * np.maximum(np.abs(getattr(guess.pair, name)), 0.05)

        def at(times, name=name, step=step):
            pair = dataclasses.replace(guess.pair, **{name: getattr(guess.pair, name) + times * step})
            state = slope(pair, guess)[1]
            return np.stack([state.P, state.speed], axis=1)

        difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step[:, None])
        # Gravity splits the equal speeds of a symmetric orbit: the largest speed has a kink there.
        smooth = slice(0, 1) if name == "gamma" else slice(None)
        actual, expected = getattr(slopes, name)[:, smooth], difference[:, smooth]
        np.testing.assert_allclose(actual, expected, rtol=2e-6, atol=1e-9, err_msg=name)


@pytest.mark.long
def test_reverse_mode_and_second_derivatives_match_forward_mode(reference_results):
    guess, slope, slopes, _ = reference_results
    orbit, pair = guess[1], jax.tree.map(lambda x: x[1], guess.pair)

    def P(kappa):
        return power_and_speed(dataclasses.replace(pair, kappa=kappa), orbit)[0][0]

    value, second = jax.jit(lambda kappa: jax.jvp(jax.grad(P), (kappa,), (jnp.ones_like(kappa),)))(pair.kappa)
    assert float(value) == pytest.approx(float(slopes.kappa[1, 0]), rel=1e-12)
    step = 1e-2

    def first(times):
        moved = dataclasses.replace(guess.pair, kappa=guess.pair.kappa + times * step)
        return slope(moved, guess)[0].kappa[1, 0]

    difference = (8 * (first(1) - first(-1)) - (first(2) - first(-2))) / (12 * step)
    assert float(second) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.long
def test_padding_of_an_orbit_does_not_change_its_steady_state(reference_results):
    """Orbits of several widths are padded with NaN."""
    guess, slope, slopes, state = reference_results
    padded = periodic.pad_orbits(guess, 4)
    assert np.isnan(padded.impact_unknowns[:, 2:]).all()
    wide_slopes, wide_state = slope(padded.pair, padded)
    for wide, narrow in zip(jax.tree.leaves(wide_slopes), jax.tree.leaves(slopes), strict=True):
        np.testing.assert_allclose(wide, narrow, rtol=1e-12, atol=1e-18)
    for name in ("P", "speed", "multiplier", "condition"):
        np.testing.assert_allclose(getattr(wide_state, name), getattr(state, name), rtol=1e-12)
    np.testing.assert_array_equal(wide_state.depth[:, 2:], 0)
    assert np.isfinite(wide_state.impact_unknowns).all()


def test_steady_state_is_nan_where_no_orbit_attracts(reference_results):
    guess, slope, _, _ = reference_results
    orbits = orbit_search.find_orbits(impact_pair(0.2, 25.0, 0.5), "RL", guesses=64)
    repelling = orbits[np.flatnonzero(np.abs(orbits.multipliers[:, 0]) > 1.01)[[0, 0, 0, 0]]]
    nonsense = dataclasses.replace(guess, impact_unknowns=guess.impact_unknowns * jnp.array([1.0, 1.0, -1.0]))
    for orbit, expected in ((repelling, Status.UNSTABLE), (nonsense, Status.NO_ORBIT)):
        slopes, state = slope(orbit.pair, orbit)
        np.testing.assert_array_equal(state.status, expected)
        for leaf in (state.P, state.power, state.speed, *jax.tree.leaves(slopes)):
            assert np.isnan(leaf).all()


def test_power_of_rigid_walls_uses_the_depth_of_the_formula():
    orbits = orbit_search.find_orbits(impact_pair(0.3, None, 0.5), "RL", guesses=64)
    index = int(np.abs(orbits.multipliers[:, 0]).argmin())
    orbit = orbits[index]

    def P(r):
        pair = ImpactPair(orbit.pair.d, None, r, orbit.pair.gamma)
        return steady(DEVICE, orbit, pair=pair).P

    value = jax.jit(P)
    assert float(value(0.5)) == pytest.approx(float(orbit_properties.orbit_power(orbits, DEVICE)[index]), rel=1e-12)
    difference = (8 * (value(0.501) - value(0.499)) - (value(0.502) - value(0.498))) / 0.012
    assert float(jax.jit(jax.jacfwd(P))(0.5)) == pytest.approx(float(difference), rel=1e-7)


def test_several_cells_or_devices_raise_with_advice(reference_results):
    orbit = jax.tree.map(lambda x: x[0], reference_results[0])
    cells = impact_pair(np.full((2, 2), 0.2), 400.0, 0.5)
    with pytest.raises(ValueError, match=r"pair must be one cell; got d of shape \(2, 2\); map several by jax.vmap"):
        steady(DEVICE, orbit, pair=cells)
    with pytest.raises(ValueError, match=r"device.s must be one number; got shape \(2,\); map several by jax.vmap"):
        steady(Harvester(s=[0.2, 0.3]), orbit)


def test_steady_state_prints_its_status_by_name_with_advice():
    # The symmetric 1:1 orbit of a rigid wall repels below its flip at d = 0.187.
    orbits = orbit_search.find_orbits(impact_pair(0.15, None, 0.5), "RL", guesses=64)
    state = steady(DEVICE, orbits[0], pair=jax.tree.map(lambda x: x[0], orbits.pair))
    assert int(state.status) == Status.UNSTABLE
    assert "status=<Status.UNSTABLE: 9, follow it as a branch" in repr(state).replace("\n", " ")
    assert f"'OK': {len(orbits)}" in repr(orbits)
    assert "status=" in repr(jax.eval_shape(lambda: state))
    assert all(status.advice for status in Status)


@pytest.fixture(scope="module")
def long_contacts():
    """Return period-1 orbits with a chatter that ends in a gravity-prolonged contact of many turning points."""
    rows = json.loads((Path(__file__).parents[1] / "data" / "long_contacts.json").read_text())
    width = 16
    pair = impact_pair(*(np.array([row[name] for row in rows]) for name in ("d", "kappa", "r", "gamma")))
    side, impact_unknowns = np.zeros((len(rows), width), np.int32), np.zeros((len(rows), width, 3))
    for index, row in enumerate(rows):
        side[index, : len(row["side"])], impact_unknowns[index, : len(row["side"])] = row["side"], row["knots"]
    sequence = Sequence(jnp.asarray(side), jnp.full(len(rows), 2.0, float), jnp.zeros(len(rows), bool))
    return pair, sequence, jnp.asarray(impact_unknowns)


@pytest.mark.long
@pytest.mark.parametrize("factor", [1.0, 1.05])
def test_steady_state_of_long_contacts_matches_the_impact_map(long_contacts, factor):
    pair, sequence, impact_unknowns = long_contacts
    pair = dataclasses.replace(pair, d=factor * pair.d)
    orbits = periodic.solve(pair, sequence, impact_unknowns)
    state = jax.jit(jax.vmap(lambda orbit: steady(DEVICE, orbit, pair=orbit.pair)))(orbits)
    # At the larger gap one solution of the equations would reach the wall twice more: this orbit is virtual.
    np.testing.assert_array_equal(state.status, orbits.status)
    assert (np.asarray(orbits.status) == Status.VIRTUAL).sum() == (factor != 1.0)
    good = np.asarray(orbits.status) == Status.OK
    np.testing.assert_allclose(state.P[good], orbit_properties.orbit_power(orbits, DEVICE)[good], rtol=1e-12)
