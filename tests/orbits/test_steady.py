"""Steady states: values and gradients of 50-digit orbits, second derivatives, and NaN where none can be meant."""

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


def known(references, twist=1.0):
    """Orbits as they are written down, knots off by a factor."""
    # Nothing is weakly typed: the program would be compiled again for what is moved, or found.
    pair = jax.tree.map(lambda *x: jnp.asarray(np.array(x)), *(one.pair for one in references))
    count = len(references)
    side = jnp.asarray([one.side for one in references], jnp.int32)
    sequence = Sequence(side, jnp.full(count, 2.0, float), jnp.zeros(count, bool))
    blank = jnp.full(side.shape, jnp.nan, float)
    knots = jnp.asarray([one.knots for one in references]) * twist
    return periodic.Orbit(
        pair, sequence, knots, blank, blank, jnp.zeros((count, 2), complex), blank[:, 0], jnp.zeros(count, jnp.int32)
    )


def of_pair(pair, orbit):
    """What the tests differentiate: energy per half period, largest speed."""
    found = steady(DEVICE, orbit, pair=pair)
    return jnp.stack([found.P, found.speed]), found


@pytest.fixture(scope="module")
def found():
    """Steady states of the references and their derivatives, forward, from guesses 1 % off."""
    guess = known(reference_orbits(), 1 + 0.01 * np.array([1, -1, 1]))
    slope = jax.jit(jax.vmap(jax.jacfwd(of_pair, has_aux=True)))
    return guess, slope, *slope(guess.pair, guess)


def test_values_are_those_of_50_digits(found):
    _, _, _, state = found
    np.testing.assert_array_equal(state.status, Status.OK)
    for index, (row, reference) in enumerate(zip(reference_rows(), reference_orbits(), strict=True)):
        assert float(state.P[index]) == pytest.approx(float(row["P_J"]), rel=1e-13)
        np.testing.assert_allclose(state.depth[index], reference.depth, rtol=1e-12)
        assert float(state.multiplier[index]) == pytest.approx(np.abs(reference.multipliers).max(), rel=1e-10)


def test_derivatives_in_kappa_are_those_of_50_digits(found):
    _, _, slopes, _ = found
    wanted = [float(row["dP_dkappa"]) for row in reference_rows()]
    np.testing.assert_allclose(slopes.kappa[:, 0], wanted, rtol=1e-12)


def test_derivatives_in_every_parameter_are_those_of_differences(found):
    guess, slope, slopes, _ = found
    for name in ("d", "kappa", "r", "gamma"):
        step = 1e-3 * np.maximum(np.abs(getattr(guess.pair, name)), 0.05)

        def at(times, name=name, step=step):
            pair = dataclasses.replace(guess.pair, **{name: getattr(guess.pair, name) + times * step})
            state = slope(pair, guess)[1]
            return np.stack([state.P, state.speed], axis=1)

        difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step[:, None])
        # Gravity splits the equal speeds of a symmetric orbit: their largest has a kink there.
        smooth = slice(0, 1) if name == "gamma" else slice(None)
        mine, wanted = getattr(slopes, name)[:, smooth], difference[:, smooth]
        np.testing.assert_allclose(mine, wanted, rtol=2e-6, atol=1e-9, err_msg=name)


@pytest.mark.long
def test_reverse_is_forward_and_second_derivatives_are_differences_of_first(found):
    guess, slope, slopes, _ = found
    one, pair = guess[1], jax.tree.map(lambda x: x[1], guess.pair)

    def P(kappa):
        return of_pair(dataclasses.replace(pair, kappa=kappa), one)[0][0]

    value, second = jax.jit(lambda kappa: jax.jvp(jax.grad(P), (kappa,), (jnp.ones_like(kappa),)))(pair.kappa)
    assert float(value) == pytest.approx(float(slopes.kappa[1, 0]), rel=1e-12)
    step = 1e-2

    def first(times):
        moved = dataclasses.replace(guess.pair, kappa=guess.pair.kappa + times * step)
        return slope(moved, guess)[0].kappa[1, 0]

    difference = (8 * (first(1) - first(-1)) - (first(2) - first(-2))) / (12 * step)
    assert float(second) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.long
def test_what_pads_an_orbit_changes_nothing(found):
    """Orbits of several widths are padded with NaN."""
    guess, slope, slopes, state = found
    padded = periodic.widened(guess, 4)
    assert np.isnan(padded.knots[:, 2:]).all()
    wide_slopes, wide_state = slope(padded.pair, padded)
    for wide, narrow in zip(jax.tree.leaves(wide_slopes), jax.tree.leaves(slopes), strict=True):
        np.testing.assert_allclose(wide, narrow, rtol=1e-12, atol=1e-18)
    for name in ("P", "speed", "multiplier", "condition"):
        np.testing.assert_allclose(getattr(wide_state, name), getattr(state, name), rtol=1e-12)
    np.testing.assert_array_equal(wide_state.depth[:, 2:], 0)
    assert np.isfinite(wide_state.knots).all()


def test_where_no_orbit_attracts_nothing_is_said(found):
    guess, slope, _, _ = found
    every = orbit_search.search(impact_pair(0.2, 25.0, 0.5), "RL", guesses=64)
    repels = every[np.flatnonzero(np.abs(every.multipliers[:, 0]) > 1.01)[[0, 0, 0, 0]]]
    nonsense = dataclasses.replace(guess, knots=guess.knots * jnp.array([1.0, 1.0, -1.0]))
    for orbit, wanted in ((repels, Status.UNSTABLE), (nonsense, Status.NO_ORBIT)):
        slopes, state = slope(orbit.pair, orbit)
        np.testing.assert_array_equal(state.status, wanted)
        for leaf in (state.P, state.power, state.speed, *jax.tree.leaves(slopes)):
            assert np.isnan(leaf).all()


def test_a_rigid_wall_yields_by_the_depth_it_is_lent():
    start = orbit_search.search(impact_pair(0.3, None, 0.5), "RL", guesses=64)
    index = int(np.abs(start.multipliers[:, 0]).argmin())
    one = start[index]

    def P(r):
        pair = ImpactPair(one.pair.d, None, r, one.pair.gamma)
        return steady(DEVICE, one, pair=pair).P

    value = jax.jit(P)
    assert float(value(0.5)) == pytest.approx(float(orbit_properties.power(start, DEVICE)[index]), rel=1e-12)
    difference = (8 * (value(0.501) - value(0.499)) - (value(0.502) - value(0.498))) / 0.012
    assert float(jax.jit(jax.jacfwd(P))(0.5)) == pytest.approx(float(difference), rel=1e-7)


def test_several_cells_or_devices_are_refused_with_what_to_do(found):
    orbit = jax.tree.map(lambda x: x[0], found[0])
    cells = impact_pair(np.full((2, 2), 0.2), 400.0, 0.5)
    with pytest.raises(ValueError, match=r"pair must be one cell; got d of shape \(2, 2\); map several by jax.vmap"):
        steady(DEVICE, orbit, pair=cells)
    with pytest.raises(ValueError, match=r"device.s must be one number; got shape \(2,\); map several by jax.vmap"):
        steady(Harvester(s=[0.2, 0.3]), orbit)


def test_a_record_prints_its_status_by_name_and_what_to_do():
    # The symmetric 1:1 orbit of a rigid wall repels beyond its flip at d = 0.187.
    found = orbit_search.search(impact_pair(0.15, None, 0.5), "RL", guesses=64)
    state = steady(DEVICE, found[0], pair=jax.tree.map(lambda x: x[0], found.pair))
    assert int(state.status) == Status.UNSTABLE
    assert "status=<Status.UNSTABLE: 9, follow it as a branch" in repr(state).replace("\n", " ")
    assert f"'OK': {len(found)}" in repr(found)
    assert "status=" in repr(jax.eval_shape(lambda: state))
    assert all(status.advice for status in Status)


@pytest.fixture(scope="module")
def pressed():
    """Period-1 orbits that end a chatter pressed on a wall, through a contact of many turning points."""
    rows = json.loads((Path(__file__).parents[1] / "data" / "long_contacts.json").read_text())
    width = 16
    pair = impact_pair(*(np.array([row[name] for row in rows]) for name in ("d", "kappa", "r", "gamma")))
    side, knots = np.zeros((len(rows), width), np.int32), np.zeros((len(rows), width, 3))
    for index, row in enumerate(rows):
        side[index, : len(row["side"])], knots[index, : len(row["side"])] = row["side"], row["knots"]
    sequence = Sequence(jnp.asarray(side), jnp.full(len(rows), 2.0, float), jnp.zeros(len(rows), bool))
    return pair, sequence, jnp.asarray(knots)


@pytest.mark.long
@pytest.mark.parametrize("off", [1.0, 1.05])
def test_a_pressed_contact_is_what_the_impact_map_flies(pressed, off):
    pair, sequence, knots = pressed
    pair = dataclasses.replace(pair, d=off * pair.d)
    flown = periodic.solve(pair, sequence, knots)
    state = jax.jit(jax.vmap(lambda orbit: steady(DEVICE, orbit, pair=orbit.pair)))(flown)
    # Off its place one of them would meet the wall twice more: that is no orbit, whatever its equations say.
    np.testing.assert_array_equal(state.status, flown.status)
    assert (np.asarray(flown.status) == Status.VIRTUAL).sum() == (off != 1.0)
    good = np.asarray(flown.status) == Status.OK
    np.testing.assert_allclose(state.P[good], orbit_properties.power(flown, DEVICE)[good], rtol=1e-12)
