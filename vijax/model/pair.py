"""The vibro-impact pair in its two nondimensional scalings, and the checks of what a user gives."""

import math
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vijax.model import units
from vijax.model.choices import Walls
from vijax.model.quantities import check
from vijax.model.restitution import damped_frequency, damping_ratio, restitution
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.arrays import AnyArray
from vijax.runtime.checks import is_concrete
from vijax.runtime.context import door

Real = float | Float[AnyArray, "..."]


class ImpactPair(eqx.Module):
    """Nondimensional impact pair, Eqs. (37)-(38); every field a scalar or an array of one common shape.

    Fields are not checked, so that the record can be traced; `impact_pair` is the door that checks.

    Attributes:
        d: Gap between the walls in units of A pi^2/omega^2, > 0.
        kappa: Natural frequency of the soft wall, omega0 pi/omega > 0; None for a rigid wall.
        r: Coefficient of restitution of a free contact, in (0, 1].
        gamma: Gravity along the axis over the forcing amplitude, g sin(beta)/A.
    """

    d: Float[AnyArray, "..."]
    kappa: Float[AnyArray, "..."] | None
    r: Float[AnyArray, "..."]
    gamma: Float[AnyArray, "..."]

    @property
    def rigid(self) -> bool:
        """Say whether the walls are rigid, which is a static choice that no compiled program asks twice."""
        return self.kappa is None

    @property
    @door
    def mu(self) -> Float[AnyArray, "..."]:
        """Compute the damping of w'' + mu w' + kappa^2 w = f, as `restitution` calibrates it."""
        return 2 * self.zeta

    @property
    @door
    def zeta(self) -> Float[AnyArray, "..."]:
        """Compute the decay rate mu/2 of a free contact."""
        return self._soft_kappa() * damping_ratio(self.r)

    @property
    @door
    def omega1(self) -> Float[AnyArray, "..."]:
        """Compute the damped frequency sqrt(kappa^2 - zeta^2)."""
        return damped_frequency(self._soft_kappa(), self.r)

    def _soft_kappa(self) -> Float[AnyArray, "..."]:
        if self.kappa is None:
            raise ValueError("kappa must be a number for a membrane's damping and frequency; got None (a rigid wall)")
        return self.kappa


WALLS: tuple[Walls, ...] = get_args(Walls)


class MembranePair(eqx.Module):
    """The soft pair in the second scaling, Eq. (39): lengths in units of s, times in units of 1/omega0.

    With x = U/s and t* = omega0 tau:  x'' = -g* + A* cos(omega* t*), and in contact -sign(x)(|x| - 1/2) - c* x' more.
    It stays put while omega moves, where (d, kappa) follows a curve d kappa^2 = 1/A* = const.
    """

    g_star: Float[AnyArray, "..."]
    A_star: Float[AnyArray, "..."]
    omega_star: Float[AnyArray, "..."]
    c_star: Float[AnyArray, "..."]

    @property
    @door
    def length_unit(self) -> Float[AnyArray, "..."]:
        """Give units of u per unit of x: d."""
        return (self.omega_star / math.pi) ** 2 / self.A_star

    @property
    @door
    def time_unit(self) -> Float[AnyArray, "..."]:
        """Compute units of t per unit of t*: 1/kappa."""
        return self.omega_star / math.pi


@door
def membrane_pair(pair: ImpactPair) -> MembranePair:
    """Bring a soft pair into the scaling of Eq. (39).

    A* = 1/(d kappa^2), g* = gamma A*, omega* = pi/kappa, c* = mu/kappa.
    """
    kappa = pair._soft_kappa()
    strength = 1 / (pair.d * kappa**2)
    return MembranePair(pair.gamma * strength, strength, math.pi / kappa, 2 * damping_ratio(pair.r))


@door
def from_membrane_pair(pair: MembranePair) -> ImpactPair:
    """Bring a soft pair into the scaling of Eqs. (37)-(38); the inverse of `membrane_pair` for 0 <= c* < 2."""
    ratio = 0.5 * pair.c_star
    return ImpactPair(pair.length_unit, 1 / pair.time_unit, restitution(ratio), pair.g_star / pair.A_star)


def check_pair(pair: Any) -> ImpactPair:
    """Return the pair, if its fields may be; those of traced values pass unseen.

    Raises:
        ValueError: No pair, a field that cannot be, or fields that do not broadcast.
    """
    given = vars(checks.instance("pair", pair, ImpactPair, "vijax.impact_pair(...)"))
    fields = {name: value for name, value in given.items() if value is not None}
    for name, value in fields.items():
        check(name, value)
    checks.shapes(**fields)
    return pair


def check_start(pair: ImpactPair, name: str, u: Any) -> None:
    """Raise ValueError unless a displacement lies between rigid walls; soft ones may be entered, traced ones pass."""
    if not pair.rigid or not is_concrete(pair.d, u):
        return
    u, half = np.broadcast_arrays(np.asarray(u), 0.5 * np.asarray(pair.d))
    good = np.abs(u) <= half
    if not good.all():
        raise ValueError(
            f"{name} must lie within the gap of a rigid wall, |{name}| <= d/2; got {name} = {checks.first(u, good)} "
            f"at d = {2 * half[~good].flat[0]:g}"
        )


@door
def impact_pair(d: Given, kappa: Given | None, r: Given | None, gamma: Given = 0.0) -> ImpactPair:
    """Make a checked `ImpactPair`, its fields broadcast to one shape.

    Args:
        d: Gap between the walls, > 0, any shape.
        kappa: Natural frequency of the soft walls, > 0 and finite; None for rigid walls.
        r: Coefficient of restitution, in (0, 1].
        gamma: Gravity over forcing amplitude, finite.

    Raises:
        ValueError: A value that cannot be, or shapes that do not broadcast (traced values are not looked at).
    """
    given = {"d": d, "kappa": kappa, "r": r, "gamma": gamma}
    if kappa is None:
        del given["kappa"]
    given = {name: units.plain(name, value) for name, value in given.items()}
    for name, value in given.items():
        check(name, value)
    arrays = [np.asarray(value) if isinstance(value, list | tuple) else value for value in given.values()]
    dtype = jnp.result_type(float, *arrays)  # float64, or float32 where all arrays are
    # By NumPy where it can: JAX would compile a program for every shape.
    own = np if checks.is_concrete(*arrays) else jnp
    arrays = [own.asarray(array, dtype) for array in arrays]
    shape = checks.shapes(**dict(zip(given, arrays, strict=True)))
    fields = {name: own.broadcast_to(array, shape) for name, array in zip(given, arrays, strict=True)}
    pair = ImpactPair(fields["d"], fields.get("kappa"), fields["r"], fields["gamma"])
    return jax.device_put(pair) if own is np else pair
