"""A survey finds the attractors that a sweep finds, as verified orbits, and leaves out what is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax import clearance
from vijax import orbit as orbits
from vijax.model import ImpactPair, Status
from vijax.simulate import LINKS
from vijax.survey import survey

KAPPA = np.geomspace(3, 400, LINKS)


@pytest.fixture(scope="module")
def found():
    """Up and down in kappa at d = 0.2 and up at d = 0.12, where chaos is."""
    kappa = np.stack([KAPPA, KAPPA[::-1], KAPPA])
    d = np.array([0.2, 0.2, 0.12])[:, None] * np.ones_like(kappa)
    one = np.ones_like(kappa)
    return survey(
        ImpactPair(d, kappa, 0.5 * one, 0 * one),
        np.full(3, 0.05853),
        np.full(3, -0.47898),
        np.ones(3),
        longest=4,
        impacts=8,
        periods=400,
    )


def test_orbits_are_those_of_a_sweep(found):
    # The only attractor at d = 0.2 from kappa 5 on, mirror images aside.
    swept = vijax.sweep(d=0.2, kappa=KAPPA[8:], r=0.5, outputs=["P", "period"])
    here = np.flatnonzero((found.chain == 0) & (found.link >= 8))
    assert here.size == KAPPA.size - 8
    np.testing.assert_allclose(orbits.power(found.orbit[here], vijax.Harvester()), swept["P"], rtol=1e-7)
    np.testing.assert_array_equal(orbits.counts(found.orbit[here]).period, swept["period"])


def test_every_orbit_is_verified_attracts_and_stands_at_its_cell(found):
    assert (np.asarray(found.orbit.status) == Status.OK).all()
    assert (np.abs(np.asarray(found.orbit.multipliers)).max(axis=1) < 1).all()
    down = found.chain == 1
    np.testing.assert_array_equal(found.orbit.pair.kappa[down], KAPPA[::-1][found.link[down]])
    assert (np.diff(found.chain * LINKS + found.link) > 0).all()


def test_chaos_has_no_orbit(found):
    swept = vijax.sweep(d=0.12, kappa=KAPPA, r=0.5, outputs=["period"])
    chaos = np.flatnonzero(swept["period"].values == 0)
    assert chaos.size
    assert not np.isin(chaos, found.link[found.chain == 2]).any()


def test_clearances_are_those_of_the_motion_in_between(found):
    some = found.orbit[np.arange(0, len(found.orbit), 7)]
    sequence, knots = some.sequence, jnp.nan_to_num(some.knots)
    room = jax.jit(jax.vmap(clearance.between))(some.pair, sequence, knots).clearance
    assert (np.stack(room) > 0).all()
    _, u, _ = orbits.path(some, samples=2001)
    for index in range(len(some)):
        half = 0.5 * float(some.pair.d[index])
        pieces = u[index].reshape(-1, 2001)[: 2 * int(some.count[index])]
        turns = [half - x for piece in pieces[1::2] for x in _turning(piece)]
        wanted = min([*turns, 1.0])
        assert float(room.flight[index]) == pytest.approx(wanted, abs=1e-6)


def _turning(u):
    """Turning points of a sampled flight: maxima as they are, minima from the left wall, turned over."""
    step = np.diff(u)
    places = np.flatnonzero(step[1:] * step[:-1] < 0) + 1
    return [u[i] if step[i - 1] > 0 else -u[i] for i in places]
