"""Membrane work under several harmonics: against quadrature, in short and long contacts, and with one harmonic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.impact.roots import implicit_root
from vijax.model import flow
from vijax.model.energy import SHORT_REACH, membrane_work
from vijax.model.forcing.harmonic_work import harmonic_contact_work
from vijax.model.forcing.waves import Wave, contact_motion, sine

NODES, WEIGHTS = np.polynomial.legendre.leggauss(200)


def under(*harmonics):
    """Return harmonics with these orders and complex amplitudes."""
    return tuple(Wave(order, jnp.asarray(x.real), jnp.asarray(x.imag)) for order, x in harmonics)


SINE = under((1, 1.0 + 0j))
THREE = under((1, 0.8 - 0.6j), (2, 0.3 + 0.4j), (5, -0.2 + 0.1j))
WITHOUT_THE_FIRST = under((2, 0.5 - 0.1j), (3, 0.2 + 0.7j))


def contact(m, waves, gamma, side, speed):
    """Return the end of a contact: its duration, and the rates at both ends."""
    s = np.linspace(0, 4 * np.pi / float(m.omega1), 4001)
    w = np.asarray(contact_motion(m, waves, side, gamma, speed, jnp.asarray(s))[0])
    after = int(np.argmax(w[1:] <= 0)) + 1
    low, high = s[after - 1], s[after]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high) if float(contact_motion(m, waves, side, gamma, speed, middle)[0]) > 0 else (low, middle)
        )
    return high, (jnp.asarray(speed), contact_motion(m, waves, side, gamma, speed, high)[1])


@pytest.mark.parametrize("waves", [SINE, THREE, WITHOUT_THE_FIRST], ids=["one", "three", "higher"])
@pytest.mark.parametrize(
    ("kappa", "r", "speed", "tolerance"),
    [(40.0, 0.5, 0.3, 1e-12), (2.2, 0.7, 0.5, 1e-12), (60.0, 0.9, 1.0, 1e-12), (2 * np.pi, 0.6, 0.4, 1e-12)],
)
def test_harmonic_work_equals_the_loss_by_quadrature(waves, kappa, r, speed, tolerance):
    m, gamma, side = flow.membrane(vijax.impact_pair(0.2, kappa, r)), jnp.asarray(0.1), jnp.asarray(-1.0)
    duration, z = contact(m, waves, gamma, side, speed)
    rate = contact_motion(m, waves, side, gamma, speed, jnp.asarray(0.5 * duration * (NODES + 1)))[1]
    lost = float(m.mu) * 0.5 * duration * float(WEIGHTS @ np.asarray(rate) ** 2)
    assert float(harmonic_contact_work(m, waves, gamma, side, duration, z)) == pytest.approx(lost, rel=tolerance)


def test_work_with_a_single_harmonic_equals_the_formula_of_the_paper():
    m, gamma, side, t = flow.membrane(vijax.impact_pair(0.2, 25.0, 0.5)), 0.05, 1.0, 0.3
    waves = sine(jnp.asarray(t))
    duration, z = contact(m, waves, gamma, side, 0.4)
    expected = membrane_work(
        m.kappa, m.mu, gamma, side, jnp.asarray(t), jnp.asarray(duration), side * z[0], side * z[1]
    )
    assert float(harmonic_contact_work(m, waves, gamma, side, duration, z)) == pytest.approx(float(expected), rel=1e-13)


@pytest.mark.parametrize(("order", "speed"), [(2, 1e-3), (2, 1e-6), (5, 0.045)])
def test_short_contacts_have_relative_precision(order, speed):
    """The closed form would lose all digits of the shortest contacts; the longest is short for one harmonic only."""
    m, side = flow.membrane(vijax.impact_pair(0.2, 3.0, 0.5)), 1.0
    waves = under((1, -1.0 + 0j), (order, -0.5 + 0j))
    duration, z = contact(m, waves, jnp.asarray(0.0), side, speed)
    assert np.pi * duration < SHORT_REACH
    assert (order * np.pi * duration < SHORT_REACH) == (order == 2)
    rate = contact_motion(m, waves, side, jnp.asarray(0.0), speed, jnp.asarray(0.5 * duration * (NODES + 1)))[1]
    lost = float(m.mu) * 0.5 * duration * float(WEIGHTS @ np.asarray(rate) ** 2)
    assert float(harmonic_contact_work(m, waves, jnp.asarray(0.0), side, duration, z)) == pytest.approx(
        lost, rel=1e-11, abs=0
    )


def test_work_without_damping_is_zero_and_its_derivative_is_finite():
    m, gamma, side, speed = flow.membrane(vijax.impact_pair(0.2, 40.0, 1.0)), jnp.asarray(0.1), 1.0, 0.3
    duration, _ = contact(m, THREE, gamma, side, speed)

    def work(zeta):
        damped = flow.Membrane(m.kappa, zeta, jnp.sqrt(m.kappa**2 - zeta**2))
        ends = implicit_root(
            lambda s, m: contact_motion(m, THREE, side, gamma, speed, s)[0], jnp.asarray(duration), damped
        )
        rate = contact_motion(damped, THREE, side, gamma, speed, ends)[1]
        return harmonic_contact_work(damped, THREE, gamma, side, ends, (jnp.asarray(speed), rate))

    rate = contact_motion(m, THREE, side, gamma, speed, jnp.asarray(0.5 * duration * (NODES + 1)))[1]
    lost = duration * float(WEIGHTS @ np.asarray(rate) ** 2)
    assert float(work(jnp.asarray(0.0))) == 0.0
    assert float(jax.grad(work)(jnp.asarray(0.0))) == pytest.approx(lost, rel=1e-9)


def test_the_size_of_the_program_does_not_depend_on_the_harmonics():
    """All pairs of harmonics use the same closed form."""
    m = flow.membrane(vijax.impact_pair(0.2, 40.0, 0.5))

    def size(waves):
        slope = jax.jacfwd(lambda s: harmonic_contact_work(m, waves, 0.02, 1.0, s, (0.3, -0.2)))
        return str(jax.make_jaxpr(slope)(0.1)).count(" = ")

    five = under(*((order, 0.1 + 0.1j) for order in range(1, 6)))
    assert size(five) < 1.1 * size(five[:2])
