"""Records print numbers where equinox prints dtypes and shapes."""

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from vijax.design.aperiodic.average import Average


def test_a_gradient_prints_its_numbers():
    slope = jax.grad(lambda pair: 3 * pair.d + pair.kappa)(vijax.impact_pair(0.2, 400.0, 0.5))
    assert str(slope) == "ImpactPair(d=3, kappa=1, r=0, gamma=0)"
    slope = jax.grad(lambda device: device.s * 2 + device.V * 1e-7)(vijax.Harvester())
    assert "s=2, omega0=0," in str(slope)
    assert "V=1e-07" in str(slope)
    assert max(map(len, str(slope).splitlines())) <= 100


def test_arrays_print_their_numbers_if_they_are_few():
    assert str(vijax.impact_pair([0.1, 0.2], None, 0.5)) == ("ImpactPair(d=[0.1, 0.2], r=[0.5, 0.5], gamma=[0, 0])")
    assert str(vijax.impact_pair(np.linspace(0.1, 0.2, 99), None, 0.5)).startswith("ImpactPair(d=f64[99], r=f64[99]")
    unequal = vijax.impact_pair(0.1, vijax.Sides(4.0, 5.0), 0.5)
    assert "kappa=Sides(left=4, right=5)" in str(unequal)


def test_a_traced_record_prints():
    texts = []
    jax.jit(lambda pair: texts.append(str(pair)) or pair.d)(vijax.impact_pair(0.2, 400.0, 0.5))
    assert "ImpactPair(d=" in texts[0]


def test_an_average_prints_its_numbers_and_its_smoothness():
    number, pair, device = jnp.asarray(2.5e-5), vijax.impact_pair(0.2, 400.0, 0.5), vijax.Harvester()
    text = str(
        Average(number, number, number, pair, pair, device, device, jnp.asarray(0.5), jnp.asarray(True), jnp.asarray(4))
    )
    assert "P=2.5e-05," in text
    assert "by_pair=ImpactPair(d=0.2, kappa=400, r=0.5, gamma=0)," in text
    assert "smoothness=Smoothness.KINK" in text
