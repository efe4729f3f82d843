"""Stored energies and forces of membranes; the forces of rubber are derived here from its strain energy."""

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import vijax
from vijax.model.walls.membrane import Linear

PAIR = vijax.impact_pair(0.2, 40.0, 0.5)
DEPTHS = np.array([1e-6, 1e-3, 0.02, 0.07])
RUBBERS = {
    "gently stretched": (1.02, 0.05, math.inf),
    "well stretched": (1.8, 0.03, math.inf),
    "near its limit": (1.5, 0.06, 6.0),
}


def of(name):
    return vijax.Hyperelastic(*RUBBERS[name])


def strain_energy(law, w, ratio=0.0):
    """Return the strain energy of Mooney-Rivlin (C1 = 1/2, C2 = ratio/2) or Gent in the cone, up to a factor."""
    hoop = mpmath.mpf(float(law.prestretch)) ** 2
    along = hoop * (1 + (mpmath.mpf(w) / mpmath.mpf(float(law.radius))) ** 2)
    thin = 1 / (hoop * along)
    first, second = along + hoop + thin, 1 / along + 1 / hoop + 1 / thin
    if math.isinf(law.stretch_limit):
        return (first - 3) / 2 + ratio * (second - 3) / 2
    limit = mpmath.mpf(float(law.stretch_limit))
    return -limit / 2 * mpmath.log(1 - (first - 3) / limit)


@pytest.mark.parametrize(
    ("name", "ratio"), [*((name, 0.0) for name in RUBBERS), ("gently stretched", 0.3), ("well stretched", 0.1)]
)
def test_the_force_of_rubber_is_the_derivative_of_its_strain_energy(name, ratio):
    law = of(name)
    with mpmath.workdps(50):
        # kappa^2 is the derivative of the force at w = 0, for any modulus and thickness.
        scale = 40**2 / mpmath.diff(lambda w: strain_energy(law, w, ratio), 0, 2)
        expected = [float(-scale * mpmath.diff(lambda w: strain_energy(law, w, ratio), w)) for w in DEPTHS]
        stored = [float(scale * (strain_energy(law, w, ratio) - strain_energy(law, 0, ratio))) for w in DEPTHS]
    forces = [float(law.acceleration(PAIR, jnp.asarray(w), jnp.zeros(()))) for w in DEPTHS]
    np.testing.assert_allclose(forces, expected, rtol=1e-13)
    np.testing.assert_allclose(law.energy(PAIR, DEPTHS), stored, rtol=1e-13)


@pytest.mark.parametrize("law", [*map(of, RUBBERS), Linear(), vijax.HuntCrossley(0.5, 2.0)], ids=str)
def test_stored_energy_is_the_integral_of_the_force(law):
    np.testing.assert_allclose(law.energy(PAIR, DEPTHS), vijax.MembraneLaw.energy(law, PAIR, DEPTHS), rtol=1e-8)


def test_the_energy_of_a_custom_law_is_computed_by_quadrature():
    class Cubic(vijax.MembraneLaw):
        beta: float

        def acceleration(self, pair, w, z):
            return -(pair.kappa**2 * (w + self.beta * w**3) + pair.mu * z)

    expected = 40**2 * (DEPTHS**2 / 2 + 500 * DEPTHS**4 / 4)
    np.testing.assert_allclose(Cubic(500.0).energy(PAIR, DEPTHS), expected, rtol=1e-14)
    assert Cubic(500.0).energy(PAIR, 0.01).shape == ()


def test_rubber_is_a_spring_at_small_w_and_has_the_damping_of_the_pair():
    law = of("well stretched")
    slope = jax.grad(lambda w, z: law.acceleration(PAIR, w, z), argnums=(0, 1))(jnp.asarray(0.0), jnp.asarray(0.0))
    np.testing.assert_allclose(slope, (-(40.0**2), -PAIR.mu), rtol=1e-14)
    # A stage of a step may evaluate the law after the exit.
    once = law.acceleration(PAIR, jnp.asarray(-0.01), jnp.asarray(0.0))
    assert once == -law.acceleration(PAIR, jnp.asarray(0.01), jnp.asarray(0.0)) > 0


def test_gent_membranes_are_never_penetrated_to_their_limit():
    law = of("near its limit")
    push = [float(law.acceleration(PAIR, jnp.asarray(w), jnp.zeros(()))) for w in (0.05, 0.06, 0.07, 0.08, 0.2)]
    assert all(np.isfinite(push))
    assert all(np.diff(push) < 0)
    assert push[-1] < -1e6


def test_the_penetration_follows_from_the_energy():
    small, large = (vijax.Hyperelastic(1.2, radius) for radius in (0.01, 1e4))
    near = vijax.impact_pair(0.2, 40.0, 0.999)
    deep = {}
    for law in (small, large):
        motion = vijax.trajectory(near, 0.0, 3.0, 1, method="ode", membrane=law)
        impact = jax.tree.map(lambda x: float(x[0]), motion.impacts)
        # The forcing is at most 1 and the damping tiny: v^2/2 plus the work of the forcing.
        kinetic = 0.5 * impact.v_in**2
        assert abs(float(law.energy(near, impact.depth)) - kinetic) < 2 * impact.depth + 0.01 * kinetic
        deep[law] = impact.depth
    linear = vijax.trajectory(near, 0.0, 3.0, 1).impacts
    assert abs(deep[large] / float(linear.depth[0]) - 1) < 1e-6
    # Far beyond its radius the membrane is a spring again, without the part of the tension that thinning removes.
    assert abs(deep[small] / deep[large] / math.sqrt(1 - 1.2**-6) - 1) < 0.01


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"prestretch": 1.0, "radius": 0.1}, "prestretch must be one finite number above 1; got 1.0"),
        ({"prestretch": 1.5, "radius": 0.0}, "radius must be one finite number above 0; got 0.0"),
        ({"prestretch": [1.5, 2.0], "radius": 0.1}, "prestretch must"),
        ({"prestretch": 1.5, "radius": math.inf}, "radius must"),
        ({"prestretch": 1.5, "radius": 0.1, "stretch_limit": 1.6}, "stretch_limit must be one number above 1.698"),
        ({"prestretch": 1.5, "radius": 0.1, "stretch_limit": math.nan}, "stretch_limit must"),
    ],
)
def test_invalid_parameters_of_rubber_are_rejected(numbers, message):
    with pytest.raises(ValueError, match=message):
        vijax.Hyperelastic(**numbers)
