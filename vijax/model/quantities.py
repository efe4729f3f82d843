"""What every quantity is called, what its values must be, and what an axis of it is."""

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from vijax.model import units
from vijax.runtime import checks
from vijax.runtime.checks import is_concrete


class _Rule(NamedTuple):
    """What values of a quantity must be, in code and in words, and what to do about others."""

    holds: Callable[[np.ndarray], np.ndarray]
    must: str
    advice: str


_POSITIVE = (lambda x: (x > 0) & np.isfinite(x), "must be positive and finite")
_FINITE = (np.isfinite, "must be finite")
_RIGID = 'a rigid wall is wall="rigid" (kappa=None in an ImpactPair)'

_RULES = {
    "d": _Rule(*_POSITIVE, "it is the gap between the walls in units of A pi^2/omega^2"),
    "kappa": _Rule(*_POSITIVE, _RIGID),
    "r": _Rule(lambda x: (x > 0) & (x <= 1), "must lie in (0, 1]", "an elastic wall is r = 1"),
    "gamma": _Rule(*_FINITE, "level ground is gamma = 0"),
    "m_b": _Rule(*_POSITIVE, "it is the mass of the ball in kg"),
    "s": _Rule(*_POSITIVE, "it is the gap between the membranes in m"),
    "omega0": _Rule(*_POSITIVE, _RIGID),
    "k": _Rule(*_POSITIVE, _RIGID),
    "A": _Rule(*_POSITIVE, "it is the forcing amplitude in m/s^2; without forcing there is no unit of length"),
    "omega": _Rule(*_POSITIVE, "it is the forcing frequency in rad/s"),
    "beta": _Rule(*_FINITE, "it is the inclination in rad; level ground is beta = 0"),
    "g": _Rule(*_POSITIVE, "it is the acceleration of gravity in m/s^2; level ground is beta = 0"),
    "w0": _Rule(*_POSITIVE, "it is the thickness of the membrane in m"),
    "R0": _Rule(*_POSITIVE, "it is the radius of the membrane in m"),
    "eps_M": _Rule(*_POSITIVE, "it is the permittivity of the membrane in F/m"),
    "C_T": _Rule(lambda x: (x >= 0) & np.isfinite(x), "must be finite and not negative", "it is a capacitance in F"),
    "V": _Rule(*_FINITE, "it is a voltage in V"),
    "r_b": _Rule(*_POSITIVE, "it is the radius of the ball in m"),
    "penetration_limit": _Rule(lambda x: x > 0, "must be positive", "leave it out for R0, or give inf for no limit"),
}


def check(name: str, value: Any, argument: str | None = None) -> None:
    """Raise unless every element of `value` may be the quantity `name`; traced values pass unseen.

    Args:
        name: A field of `ImpactPair` or `Harvester`, or "k".
        value: A number or an array.
        argument: That an error speaks of, unless it is called as the quantity is.

    Raises:
        ValueError: "r must lie in (0, 1]; got -0.2 at index (3, 7); an elastic wall is r = 1".

    Warns:
        UserWarning: An inclination beyond pi/2, as degrees taken for rad.
    """
    if not is_concrete(value):
        return
    rule = _RULES[name]
    called = argument or name
    array = checks.numbers(called, value, rule.advice)
    good = rule.holds(array)
    if not np.all(good):
        raise ValueError(f"{called} {rule.must}; got {checks.first(array, good)}; {rule.advice}")
    if name == "beta" and (steepest := np.abs(array).max()) > 0.5 * math.pi:
        advice = "20 degrees are 20deg on the command line, and numpy.deg2rad(20) in Python"
        warnings.warn(f"{called} is up to {steepest:.6g} rad, which is beyond pi/2; {advice}", stacklevel=2)


class Axis(NamedTuple):
    """How an axis is written and what it is; `quantities.check` knows what its values must be."""

    symbol: str
    units: str
    description: str


AXES = {
    "d": Axis("d", "1", "gap between the walls, s omega^2 / (A pi^2)"),
    "kappa": Axis(r"\kappa", "1", "stiffness of the walls, omega0 pi / omega"),
    "r": Axis("r", "1", "coefficient of restitution of a free contact"),
    "gamma": Axis(r"\gamma", "1", "gravity along the axis, g sin(beta) / A"),
    "omega": Axis(r"\omega", units.cf("omega"), "angular frequency of the forcing"),
    "s": Axis("s", units.cf("s"), "gap between the membranes"),
    "omega0": Axis(r"\omega_0", units.cf("omega0"), "natural frequency of ball and membrane"),
    "k": Axis("k", units.cf("k"), "stiffness of the membrane"),
    "A": Axis("A", units.cf("A"), "amplitude of the forcing"),
    "beta": Axis(r"\beta", units.cf("beta"), "inclination"),
    "u0": Axis("u_0", "1", "displacement at the start, in units of A pi^2 / omega^2"),
    "v0": Axis("v_0", "1", "velocity at the start, in units of A pi / omega"),
}
