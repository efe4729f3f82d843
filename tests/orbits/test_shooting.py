"""Multiple shooting: 50-digit orbits solve the equations, derivatives are those of the equations, Newton ends."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import reference_orbits
from vijax.model.pair import impact_pair
from vijax.orbits import multipliers, shooting
from vijax.orbits.shooting import Sequence


def sequence(*walls, span=2.0, mirrored=False, width=None):
    """Walls padded to a width."""
    padded = (*walls, *[0] * ((width or len(walls)) - len(walls)))
    return Sequence(jnp.asarray(padded, jnp.int32), jnp.asarray(span), jnp.asarray(mirrored))


@pytest.mark.parametrize("orbit", reference_orbits(), ids=lambda orbit: f"kappa {float(orbit.pair.kappa)}")
def test_reference_orbits_solve_the_equations(orbit):
    missing = jax.jit(shooting.gap)(orbit.pair, sequence(*orbit.side), jnp.asarray(orbit.knots))
    assert np.abs(missing).max() < 3e-14


CASES = {
    "soft": (impact_pair(0.2, 12.0, 0.5, 0.1), sequence(1, -1, -1, width=4)),
    "rigid": (impact_pair(0.2, None, 0.5, 0.1), sequence(1, -1, -1, width=4)),
    "mirrored": (impact_pair(0.2, 12.0, 0.5, 0.0), sequence(1, span=1.0, mirrored=True)),
}
# No orbit: derivatives are wanted off one too.
KNOTS = np.array([[0.1, 0.5, 0.2], [0.9, 0.4, 0.25], [1.6, 0.1, 0.05], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_the_equations(case):
    pair, walls = CASES[case]
    width = walls.side.shape[0]
    moved = jax.tree.map(lambda leaf: jnp.full_like(leaf, 0.3), pair)
    linear = jax.jit(shooting.linearise)(pair, walls, jnp.asarray(KNOTS[:width]), moved)

    @jax.jit
    def missing(unknown):
        shifted = jax.tree.map(lambda a, b: a + unknown[-1] * b, pair, moved)
        return shooting.gap(shifted, walls, unknown[:-1].reshape(width, 3))

    here = jnp.append(KNOTS[:width], 0.0)
    real = np.repeat(np.asarray(walls.real), 3)
    np.testing.assert_allclose(linear.gap, missing(here), rtol=0, atol=1e-14)
    np.testing.assert_allclose(linear.slope[real], jax.jit(jax.jacfwd(missing))(here)[real], rtol=1e-12, atol=1e-12)
    # Padded knots stay where they are.
    np.testing.assert_array_equal(linear.slope[~real, :-1], np.eye(real.size)[~real])


def test_the_monodromy_contracts_as_contact_and_impacts_do():
    for case, (pair, walls) in CASES.items():
        knots = jnp.asarray(KNOTS[: walls.side.shape[0]])
        stay, count = float(KNOTS[: int(walls.real.sum()), 2].sum()), int(walls.real.sum())
        expected = 0.5 ** (2 * count) if case == "rigid" else math.exp(-float(pair.mu) * stay)
        if case == "rigid":
            knots = knots.at[:, 2].set(0.0)
        around = jax.jit(multipliers.monodromy)(pair, walls, knots)
        np.testing.assert_allclose(np.linalg.det(around), expected, rtol=1e-12)


def test_newton_comes_back_from_afar_and_says_when_it_does_not():
    orbit = reference_orbits()[1]
    far = orbit.knots * (1 + 0.05 * np.array([1, -1, 1]))
    nonsense = np.array([[0.5, 3.0, 0.01], [0.6, 0.01, 1.0]])
    guesses = jnp.asarray(np.stack([far, nonsense, np.full_like(far, np.nan)]))
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, *jnp.shape(leaf))), (orbit.pair, sequence(*orbit.side)))
    knots, residual, departure = jax.jit(shooting.newton)(*wide, guesses)
    np.testing.assert_allclose(knots[0], orbit.knots, rtol=0, atol=1e-14)
    assert residual[0] < 1e-14
    assert np.isinf(residual[1:]).all()
    known = jax.jit(jax.vmap(shooting.departures))(*wide, knots)
    np.testing.assert_allclose(departure.speed[0], known.speed[0], rtol=1e-14)
    assert [x[0].tolist() for x in departure[2:]] == [x[0].tolist() for x in known[2:]]


def test_impossible_knots_are_told():
    pair, walls = CASES["soft"]
    good = jnp.asarray(KNOTS)
    possible = jax.jit(shooting.possible)
    assert possible(pair, walls, good)
    for row, column, value in ((0, 1, -0.1), (1, 2, 0.0), (2, 0, 0.95)):
        assert not possible(pair, walls, good.at[row, column].set(value))
