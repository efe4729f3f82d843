"""Records of the vibro-impact pair (device, nondimensional system, state, impact) and the scalings that join them."""

import dataclasses
import enum
import math
import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vijax import checks, units
from vijax.checks import is_concrete
from vijax.context import door

Real = float | Float[Array, "..."]


class Status(enum.IntEnum):
    """How a cell ended, and what to do; the values are what the `status` variable of a map stores."""

    OK = 0  # a periodic attractor, or averages with a standard error over an aperiodic one
    NO_IMPACT = 1  # neutral or free motion that never touches a wall again
    PERMANENT_CONTACT = 2  # rests in or on one wall for ever
    STICKING = 3  # as OK, but the attractor chatters into sticking on a rigid wall
    SLOW = 4  # neither periodic nor certainly aperiodic when the periods were spent
    EVENT_BUDGET = 5  # more impacts than the budget allows
    NONFINITE = 6  # the state left the finite numbers
    NO_ORBIT = 7  # no periodic orbit was found from the guess
    VIRTUAL = 8  # the equations of an orbit hold, but the ball would meet a wall in between
    UNSTABLE = 9  # the orbit repels, or is at a bifurcation
    NOT_RUN = 10  # the store is not finished, and nothing is known of the cell yet

    @property
    def advice(self) -> str:
        """What to do about it, in a sentence."""
        return _ADVICE[self]

    def __repr__(self) -> str:
        return f"<Status.{self.name}: {self.value}, {self.advice}>"


_ADVICE = {
    Status.OK: "use it: the motion is periodic, or its averages have a standard error",
    Status.NO_IMPACT: "narrow the gap, force more strongly, or start elsewhere: the ball meets no wall any more",
    Status.PERMANENT_CONTACT: "force more strongly, or incline less: the ball never leaves a wall again",
    Status.STICKING: "use it as an attractor: the ball rests on a rigid wall for a while, and no orbit can be followed",
    Status.SLOW: "run more periods: the motion is neither periodic yet nor certainly aperiodic",
    Status.EVENT_BUDGET: "allow more impacts, or look at fewer periods: the ball chatters",
    Status.NONFINITE: "take shorter steps or tighter tolerances, or the exact method: the numbers overflowed",
    Status.NO_ORBIT: "begin nearer to an orbit, by a search or in smaller steps: the equations have no solution there",
    Status.VIRTUAL: "search for orbits with other impacts: the ball would meet a wall in between",
    Status.UNSTABLE: "follow it as a branch, or look for what attracts by a sweep: no ball stays on this orbit",
    Status.NOT_RUN: "give the same command again: it goes on with what is left",
}


class WithStatus(eqx.Module):
    """A record that prints its `status` by name."""

    def __repr__(self) -> str:
        status = getattr(self, "status", None)
        if not isinstance(status, np.ndarray | np.generic | jax.Array) or not is_concrete(status):
            return eqx.tree_pformat(self)
        names = Counter(Status(int(code)).name for code in np.ravel(status))
        told = dict(names) if np.ndim(status) else Status(int(status))
        return eqx.tree_pformat(eqx.tree_at(lambda record: record.status, self, told))


class State(eqx.Module):
    """Where the ball is: displacement, velocity, phase t in [0, 2), periods completed, and the mode (-1, 0, +1)."""

    u: Float[Array, "..."]
    v: Float[Array, "..."]
    t: Float[Array, "..."]
    n: Int[Array, "..."]
    mode: Int[Array, "..."]


class Impact(eqx.Module):
    """One finished impact. `work` is the energy given to the membrane per unit mass, in squared velocity units."""

    n: Int[Array, "..."]
    t: Float[Array, "..."]
    side: Int[Array, "..."]
    v_in: Float[Array, "..."]
    v_out: Float[Array, "..."]
    depth: Float[Array, "..."]
    duration: Float[Array, "..."]
    work: Float[Array, "..."]


class ImpactPair(eqx.Module):
    """Nondimensional impact pair, Eqs. (37)-(38); every field a scalar or an array of one common shape.

    Fields are not checked, so that the record can be traced; `impact_pair` is the door that checks.

    Attributes:
        d: Gap between the walls in units of A pi^2/omega^2, > 0.
        kappa: Natural frequency of the soft wall, omega0 pi/omega > 0; None for a rigid wall.
        r: Coefficient of restitution of a free contact, in (0, 1].
        gamma: Gravity along the axis over the forcing amplitude, g sin(beta)/A.
    """

    d: Float[Array, "..."]
    kappa: Float[Array, "..."] | None
    r: Float[Array, "..."]
    gamma: Float[Array, "..."]

    @property
    @door
    def mu(self) -> Float[Array, "..."]:
        """Damping of w'' + mu w' + kappa^2 w = f, by the calibration of Eq. (19)."""
        return 2 * self.zeta

    @property
    @door
    def zeta(self) -> Float[Array, "..."]:
        """Decay rate mu/2 of a free contact."""
        return self._soft_kappa() * damping_ratio(self.r)

    @property
    @door
    def omega1(self) -> Float[Array, "..."]:
        """Damped frequency sqrt(kappa^2 - zeta^2) = kappa pi/sqrt(pi^2 + ln^2 r): from r, as the difference cancels."""
        return self._soft_kappa() * math.pi / jnp.sqrt(math.pi**2 + jnp.log(self.r) ** 2)

    def _soft_kappa(self) -> Float[Array, "..."]:
        if self.kappa is None:
            raise ValueError("kappa must be a number for a membrane's damping and frequency; got None (a rigid wall)")
        return self.kappa


@door
def damping_ratio(r: Real) -> Float[Array, "..."]:
    """Ratio c/(2 sqrt(k m_b)) = mu/(2 kappa) whose free contact has restitution r.

    -ln r/sqrt(pi^2 + ln^2 r), in [0, 1): every contact is underdamped.

    Source: Eqs. (14)-(19).
    """
    decrement = 0.0 - jnp.log(r)  # +0 at r = 1, where a bare minus leaves -0
    return decrement / jnp.sqrt(math.pi**2 + decrement * decrement)


WALLS = ("soft", "rigid")


class Harvester(eqx.Module):
    """The device in SI units; the defaults are Tables I and II of the paper.

    Every field is a number or an array, traced and never static; quantities of pint become plain numbers. The stiffness
    k is derived from m_b and omega0; `with_constants(device, k=...)` sets omega0 by it.

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
        """Stiffness of the membrane, m_b omega0^2 [N/m]."""
        return self.m_b * self.omega0**2

    @property
    @door
    def length_unit(self) -> Real:
        """Metres per unit of u: A pi^2/omega^2."""
        return self.A * (math.pi / self.omega) ** 2

    @property
    @door
    def speed_unit(self) -> Real:
        """Metres per second per unit of u': A pi/omega."""
        return self.A * (math.pi / self.omega)

    @property
    def depth_limit(self) -> Real:
        """Largest admissible penetration [m]."""
        return self.R0 if self.penetration_limit is None else self.penetration_limit

    @door
    def pair(self, wall: str = "soft") -> ImpactPair:
        """The device in nondimensional form, Eqs. (37)-(38).

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


@door
def with_pair(device: Harvester, pair: ImpactPair) -> Harvester:
    """The device that has the given nondimensional form, by its s, omega0, r and beta; the inverse of `Harvester.pair`.

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
    """The device with some constants changed, checked by name; `k` [N/m] sets omega0 = sqrt(k/m_b).

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


class MembranePair(eqx.Module):
    """The soft pair in the second scaling, Eq. (39): lengths in units of s, times in units of 1/omega0.

    With x = U/s and t* = omega0 tau:  x'' = -g* + A* cos(omega* t*), and in contact -sign(x)(|x| - 1/2) - c* x' more.
    It stays put while omega moves, where (d, kappa) follows a curve d kappa^2 = 1/A* = const.
    """

    g_star: Float[Array, "..."]
    A_star: Float[Array, "..."]
    omega_star: Float[Array, "..."]
    c_star: Float[Array, "..."]

    @property
    @door
    def length_unit(self) -> Float[Array, "..."]:
        """Units of u per unit of x: d."""
        return (self.omega_star / math.pi) ** 2 / self.A_star

    @property
    @door
    def time_unit(self) -> Float[Array, "..."]:
        """Units of t per unit of t*: 1/kappa."""
        return self.omega_star / math.pi


@door
def membrane_pair(pair: ImpactPair) -> MembranePair:
    """A soft pair in the scaling of Eq. (39).

    A* = 1/(d kappa^2), g* = gamma A*, omega* = pi/kappa, c* = mu/kappa.
    """
    kappa = pair._soft_kappa()
    strength = 1 / (pair.d * kappa**2)
    return MembranePair(pair.gamma * strength, strength, math.pi / kappa, 2 * damping_ratio(pair.r))


@door
def from_membrane_pair(pair: MembranePair) -> ImpactPair:
    """A soft pair in the scaling of Eqs. (37)-(38); the inverse of `membrane_pair` for 0 <= c* < 2."""
    ratio = 0.5 * pair.c_star
    r = jnp.exp(-math.pi * ratio / jnp.sqrt((1 - ratio) * (1 + ratio)))
    return ImpactPair(pair.length_unit, 1 / pair.time_unit, r, pair.g_star / pair.A_star)


# --- the door -------------------------------------------------------------------------------------


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


def check_device(device: Any) -> Harvester:
    """The device, if it is one."""
    return checks.instance("device", device, Harvester, "vijax.Harvester(...)")


def one_device(device: Any) -> Harvester:
    """The device, each constant of it one number that is not traced; that of Tables I and II where none is given."""
    if device is None:
        return Harvester()
    for name, value in vars(checks.known("device", check_device(device))).items():
        if value is not None and np.ndim(value):
            raise ValueError(
                f"device.{name} must be one number; got shape {np.shape(value)}; give it as an axis, or one device each"
            )
    return device


def check_pair(pair: Any) -> ImpactPair:
    """The pair, if its fields may be; those of traced values pass unseen.

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
    if pair.kappa is not None or not is_concrete(pair.d, u):
        return
    u, half = np.broadcast_arrays(np.asarray(u), 0.5 * np.asarray(pair.d))
    good = np.abs(u) <= half
    if not good.all():
        raise ValueError(
            f"{name} must lie within the gap of a rigid wall, |{name}| <= d/2; got {name} = {checks.first(u, good)} "
            f"at d = {2 * half[~good].flat[0]:g}"
        )


@door
def impact_pair(d: Any, kappa: Any, r: Any, gamma: Any = 0.0) -> ImpactPair:
    """A checked `ImpactPair`, its fields broadcast to one shape.

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
