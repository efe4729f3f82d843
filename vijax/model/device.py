"""The harvester in SI units, and how it becomes a nondimensional pair and comes back from one."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vijax.model import units
from vijax.model.pair import WALLS, ImpactPair, Real, check_pair
from vijax.model.quantities import check
from vijax.runtime import checks
from vijax.runtime.checks import is_concrete
from vijax.runtime.context import door


class Harvester(eqx.Module):
    """The device in SI units; the defaults are Tables I and II of the paper.

    Every field is a number or an array, traced and never static; quantities of pint become plain numbers. The stiffness
    k is m_b omega0^2, so a membrane of known k has omega0 = sqrt(k/m_b); `sweep` takes k as an axis, too.

    Attributes:
        m_b: Mass of the ball [kg].
        s: Gap between the membranes [m].
        omega0: Natural frequency of ball and membrane [rad/s].
        r: Coefficient of restitution of a free contact, in (0, 1].
        A: Amplitude of the forcing acceleration [m/s^2].
        omega: Frequency of the forcing [rad/s].
        beta: Inclination [rad].
        g: Acceleration of gravity [m/s^2].
        w0: Thickness of the undeformed membrane [m].
        R0: Radius of the membrane [m].
        eps_M: Permittivity of the membrane [F/m].
        C_T: Transfer capacitance [F].
        V: Voltage [V].
        r_b: Radius of the ball [m], below R0.
        penetration_limit: Largest admissible penetration [m]; None for R0.

    Raises:
        TypeError: A name that is no constant; it says which there are.
        ValueError: A constant that cannot be (traced values are not looked at).
    """

    m_b: Real = 0.0035
    s: Real = 0.3
    omega0: Real = 400.0
    r: Real = 0.5
    A: Real = 1.0
    omega: Real = math.pi
    beta: Real = 0.0
    g: Real = 9.8
    w0: Real = 0.00025
    R0: Real = 0.0063
    eps_M: Real = 4.15e-11
    C_T: Real = 99.35e-9
    V: Real = 2000.0
    r_b: Real = 0.0050
    penetration_limit: Real | None = None

    def __new__(cls, *constants: Any, **named: Any):
        """Refuse a name that is no constant, with the names that there are, which Python would not say."""
        known = [field.name for field in dataclasses.fields(cls)]
        for name in named:
            if name not in known:
                advice = "; a membrane of stiffness k has omega0 = sqrt(k/m_b)" if name == "k" else ""
                raise TypeError(f"{name} must be a constant of the device; known are {', '.join(known)}{advice}")
        return super().__new__(cls)

    def __post_init__(self):
        for field in dataclasses.fields(self):
            setattr(self, field.name, units.plain(field.name, getattr(self, field.name)))

    def __check_init__(self):
        for field in dataclasses.fields(self):
            if field.name != "penetration_limit" or self.penetration_limit is not None:
                check(field.name, getattr(self, field.name))
        if is_concrete(self.r_b, self.R0) and not np.all(np.asarray(self.r_b) < np.asarray(self.R0)):
            raise ValueError(
                f"r_b must be smaller than R0, the radius of the membrane that the ball sinks into; "
                f"got r_b = {checks.shown(self.r_b)}, R0 = {checks.shown(self.R0)}"
            )

    @property
    @door
    def k(self) -> Real:
        """Compute the stiffness of the membrane, m_b omega0^2 [N/m]."""
        return self.m_b * self.omega0**2

    @property
    @door
    def length_unit(self) -> Real:
        """Compute metres per unit of u, A pi^2/omega^2."""
        return self.A * (math.pi / self.omega) ** 2

    @property
    @door
    def speed_unit(self) -> Real:
        """Compute metres per second per unit of u', A pi/omega."""
        return self.A * (math.pi / self.omega)

    @property
    def depth_limit(self) -> Real:
        """Compute the largest admissible penetration [m]."""
        return self.R0 if self.penetration_limit is None else self.penetration_limit

    @door
    def pair(self, wall: str = "soft") -> ImpactPair:
        """Bring the device into nondimensional form, Eqs. (37)-(38).

        d = s omega^2/(A pi^2), kappa = omega0 pi/omega, gamma = g sin(beta)/A.

        Args:
            wall: "soft" for the membrane, "rigid" for the wall that it becomes as omega0 grows (kappa = None).
        """
        checks.choice("wall", wall, WALLS)
        d, gamma = self.s / self.length_unit, self.g * jnp.sin(self.beta) / self.A
        d, kappa, r, gamma = jnp.broadcast_arrays(d, self.omega0 * (math.pi / self.omega), self.r, gamma)
        return ImpactPair(d, None if wall == "rigid" else kappa, r, gamma)


CONSTANTS = tuple(field.name for field in dataclasses.fields(Harvester) if field.name != "penetration_limit")
"""Constants of the device; the penetration limit is none, but a choice of who builds it."""


def told_device(attributes: Mapping[Any, Any]) -> Harvester:
    """Read the device that a map's attributes tell; what they do not tell, as its axes, is that of Tables I and II."""
    names = (*CONSTANTS, "penetration_limit")
    told = {name: float(attributes[f"harvester_{name}"]) for name in names if f"harvester_{name}" in attributes}
    # The limit is told as a number even where it is the radius of the membrane, as a device says by None.
    if told.get("penetration_limit") == told.get("R0"):
        told.pop("penetration_limit", None)
    return Harvester(**told)


@door
def with_pair(device: Harvester, pair: ImpactPair) -> Harvester:
    """Give a device the given nondimensional form, by its s, omega0, r and beta; the inverse of `Harvester.pair`.

    Args:
        device: Gives A, omega, g and everything electrical; and omega0 where the wall of `pair` is rigid.
        pair: A pair that an inclination can give: |gamma| <= g/A.

    Raises:
        ValueError: No inclination gives gamma, or a field that cannot be (traced values leave beta = NaN instead).
    """
    check_pair(pair)
    sine = pair.gamma * check_device(device).A / device.g
    if is_concrete(sine) and np.any(np.abs(sine) > 1):
        raise ValueError(
            f"gamma must lie in [-g/A, g/A] for an inclination to give it; got {checks.first(sine, np.abs(sine) <= 1)} "
            f"for gamma A/g; lower A or raise g"
        )
    omega0 = device.omega0 if pair.kappa is None else pair.kappa * device.omega / math.pi
    return dataclasses.replace(device, s=pair.d * device.length_unit, omega0=omega0, r=pair.r, beta=jnp.arcsin(sine))


@door
def with_constants(device: Harvester, **constants: Real) -> Harvester:
    """Change some constants of a device, checked by name; `k` [N/m] sets omega0 = sqrt(k/m_b).

    Raises:
        ValueError: An unknown constant, both k and omega0, or a value that cannot be.
    """
    known = [field.name for field in dataclasses.fields(check_device(device))]
    for name in constants:
        if name not in (*known, "k"):
            raise ValueError(f"{name} must be a constant of the device; got {name!r}; known are k, {', '.join(known)}")
    constants = {name: units.plain(name, value) for name, value in constants.items()}
    if "k" in constants:
        if "omega0" in constants:
            raise ValueError("k and omega0 must not both be given, as k = m_b omega0^2; got both; leave one out")
        k, m_b = constants.pop("k"), constants.get("m_b", device.m_b)
        check("k", k)
        check("m_b", m_b)
        constants["omega0"] = jnp.sqrt(k / m_b)
    return dataclasses.replace(device, **constants)


@door
def depth_unit(device: Harvester, pair: ImpactPair) -> Real:
    """Compute metres per unit of an impact's depth; a rigid wall's depth is recorded as that of kappa = 1."""
    if pair.rigid:
        return device.length_unit * device.omega / (math.pi * device.omega0)
    return device.length_unit


def electrical(device: Harvester) -> Harvester:
    """Leave out of a device what the energy of an impact of known depth does not depend on: those fields are None."""
    return eqx.tree_at(
        lambda one: (one.s, one.omega0, one.r, one.A, one.omega, one.beta, one.g, one.penetration_limit),
        device,
        (None,) * 8,
        is_leaf=lambda leaf: leaf is None,
    )


def check_device(device: Any) -> Harvester:
    """Return the device, if it is one."""
    return checks.instance("device", device, Harvester, "vijax.Harvester(...)")


def one_device(device: Any) -> Harvester:
    """Return the device, each constant one number that is not traced; that of Tables I and II where none is given."""
    if device is None:
        return Harvester()
    for name, value in vars(checks.known("device", check_device(device))).items():
        if value is not None and np.ndim(value):
            raise ValueError(
                f"device.{name} must be one number; got shape {np.shape(value)}; give it as an axis, or one device each"
            )
    return device
