"""Multiple shooting: residuals of references in 50 digits, derivatives of the residuals, and Newton's method."""

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
    """Return a sequence of walls, padded to a width."""
    padded = (*walls, *[0] * ((width or len(walls)) - len(walls)))
    return Sequence(jnp.asarray(padded, jnp.int32), jnp.asarray(span), jnp.asarray(mirrored))


@pytest.mark.parametrize("orbit", reference_orbits(), ids=lambda orbit: f"kappa {float(orbit.pair.kappa)}")
def test_reference_orbits_solve_the_equations(orbit):
    residual = jax.jit(shooting.residuals)(orbit.pair, sequence(*orbit.side), jnp.asarray(orbit.impact_unknowns))
    assert np.abs(residual).max() < 3e-14


CASES = {
    "soft": (impact_pair(0.2, 12.0, 0.5, 0.1), sequence(1, -1, -1, width=4)),
    "rigid": (impact_pair(0.2, None, 0.5, 0.1), sequence(1, -1, -1, width=4)),
    "mirrored": (impact_pair(0.2, 12.0, 0.5, 0.0), sequence(1, span=1.0, mirrored=True)),
}
# These unknowns are not an orbit: the derivatives must be right off an orbit too.
UNKNOWNS = np.array([[0.1, 0.5, 0.2], [0.9, 0.4, 0.25], [1.6, 0.1, 0.05], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("case", CASES)
def test_derivatives_match_automatic_differentiation(case):
    pair, walls = CASES[case]
    width = walls.side.shape[0]
    moved = jax.tree.map(lambda leaf: jnp.full_like(leaf, 0.3), pair)
    linear = jax.jit(shooting.linearise)(pair, walls, jnp.asarray(UNKNOWNS[:width]), moved)

    @jax.jit
    def residual(unknown):
        shifted = jax.tree.map(lambda a, b: a + unknown[-1] * b, pair, moved)
        return shooting.residuals(shifted, walls, unknown[:-1].reshape(width, 3))

    here = jnp.append(UNKNOWNS[:width], 0.0)
    real = np.repeat(np.asarray(walls.real), 3)
    np.testing.assert_allclose(linear.residuals, residual(here), rtol=0, atol=1e-14)
    np.testing.assert_allclose(linear.slope[real], jax.jit(jax.jacfwd(residual))(here)[real], rtol=1e-12, atol=1e-12)
    # The Jacobian of padded impact unknowns is the identity.
    np.testing.assert_array_equal(linear.slope[~real, :-1], np.eye(real.size)[~real])


def test_determinant_of_the_monodromy_is_the_loss_of_all_impacts():
    for case, (pair, walls) in CASES.items():
        impact_unknowns = jnp.asarray(UNKNOWNS[: walls.side.shape[0]])
        contact_duration, count = float(UNKNOWNS[: int(walls.real.sum()), 2].sum()), int(walls.real.sum())
        expected = 0.5 ** (2 * count) if case == "rigid" else math.exp(-float(pair.mu) * contact_duration)
        if case == "rigid":
            impact_unknowns = impact_unknowns.at[:, 2].set(0.0)
        monodromy = jax.jit(multipliers.monodromy)(pair, walls, impact_unknowns)
        np.testing.assert_allclose(np.linalg.det(monodromy), expected, rtol=1e-12)


def test_newton_converges_from_afar_or_returns_an_infinite_residual():
    orbit = reference_orbits()[1]
    far = orbit.impact_unknowns * (1 + 0.05 * np.array([1, -1, 1]))
    nonsense = np.array([[0.5, 3.0, 0.01], [0.6, 0.01, 1.0]])
    guesses = jnp.asarray(np.stack([far, nonsense, np.full_like(far, np.nan)]))
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, *jnp.shape(leaf))), (orbit.pair, sequence(*orbit.side)))
    impact_unknowns, residual, exits = jax.jit(shooting.newton)(*wide, guesses)
    np.testing.assert_allclose(impact_unknowns[0], orbit.impact_unknowns, rtol=0, atol=1e-14)
    assert residual[0] < 1e-14
    assert np.isinf(residual[1:]).all()
    expected = jax.jit(jax.vmap(shooting.contact_exits))(*wide, impact_unknowns)
    np.testing.assert_allclose(exits.speed[0], expected.speed[0], rtol=1e-14)
    assert [x[0].tolist() for x in exits[2:]] == [x[0].tolist() for x in expected[2:]]


def test_impossible_impact_unknowns_are_detected():
    pair, walls = CASES["soft"]
    good = jnp.asarray(UNKNOWNS)
    has_positive_durations = jax.jit(shooting.has_positive_durations)
    assert has_positive_durations(pair, walls, good)
    for row, column, value in ((0, 1, -0.1), (1, 2, 0.0), (2, 0, 0.95)):
        assert not has_positive_durations(pair, walls, good.at[row, column].set(value))
