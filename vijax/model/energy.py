"""Energy of an impact: what the membrane's capacitance harvests, what the ball gives to it, and if that suffices."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.flow import half_turn, phasor
from vijax.model.pair import ImpactPair
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.arrays import Values
from vijax.runtime.context import door
from vijax.runtime.tiles import elementwise
from vijax.runtime.xla import once

PI = math.pi


@door
def stretch(device: Harvester, depth: Values) -> Values:
    """Compute the relative growth A_s/(pi R0^2) - 1 of a membrane of area A_s that a ball has entered by `depth` [m].

    With lengths in units of R0, h = r_b - depth and S^2 = 1 + h^2 - r_b^2 (the tangent from the rim to the ball):
    cos(alpha) = (r_b h + S)/(1 + h^2), and A_s/(pi R0^2) - 1 = (1 - cos)/cos (1 - r_b^2 (1 - cos)).

    Source: Eqs. (30)-(31) with r_b sin(alpha) for the printed r_b cos(alpha), so that the area is continuous at 0.
    """
    R0: Any = device.R0
    ball = device.r_b / R0
    x = jnp.where(depth < 0, 0.0, depth) / R0
    tangent = jnp.sqrt(1 + x * (x - 2 * ball))
    reach = 1 + (ball - x) ** 2
    # 1 - cos(alpha) = rise/(over reach): the difference itself has no digit left below depth 1e-8 R0.
    rise = x * x * (tangent * (1 + tangent) + ball * (2 * ball - x))
    over = (1 + tangent) ** 2
    # One division for both quotients: it takes as long as all the rest.
    near, far = ball * (ball - x) + tangent, over * reach
    return rise * (far - ball * ball * rise) / (over * near * far)


def _rest_capacitance(device: Harvester) -> Values:
    """Compute the capacitance of the undeformed membrane [F]."""
    eps_M: Any = device.eps_M
    R0: Any = device.R0
    w0: Any = device.w0
    return jnp.asarray(eps_M * PI * R0**2 / w0)


@door
def capacitance(device: Harvester, depth: Values) -> Values:
    """Compute the capacitance [F] of a membrane that a ball has entered by `depth` [m].

    C_M = eps_M A_s^2/(w0 pi R0^2): the volume is kept, so the membrane thins as its area grows.

    Source: Eqs. (30)-(33), the area as in `stretch`.
    """
    return _rest_capacitance(device) * (1 + stretch(device, depth)) ** 2


@door
def harvested_energy(device: Harvester, depth: Given) -> Values:
    """Compute the energy E_j [J] of an impact whose largest penetration is `depth`, in metres or a quantity of pint.

    E = (C_max + C_T)/(C_min + C_T) (C_max - C_min) V^2/2, of full relative accuracy down to depth 0, where it and its
    gradient vanish.

    Raises:
        ValueError: If the device is none, or a depth no number (traced ones are not looked at).

    Source: Eq. (34).
    """
    if check_device(device).unequal:
        raise ValueError("device must be that of one wall, device.at(1) or device.at(-1); got one whose walls differ")
    given: Any = units.plain("depth", depth)
    if checks.is_concrete(given):
        found = checks.numbers("depth", given, some=False)
        # A number and an array of JAX stay what they are: their precision is the result's.
        given = jnp.asarray(found, float) if isinstance(given, list | tuple) else given
    return elementwise(_harvested, device, given)


@once
def _harvested(device: Harvester, depth: Values) -> Values:
    V: Any = device.V
    growth = stretch(device, depth)
    least = _rest_capacitance(device)
    gain = least * growth * (2 + growth)
    # One division for the device, not one for every impact.
    return (0.5 * V**2) * gain * (1 + gain * (1 / (least + device.C_T)))


@door
def rigid_penetration(r: Values) -> Values:
    """Compute the largest penetration chi of a free contact, in v_in/omega0; a rigid wall is lent it for its energy.

    chi = exp(ln r/pi arctan(-pi/ln r)): depth [m] = |v_in| [m/s] chi/omega0, or |v| chi/kappa in units of u.

    Source: Eq. (35), with atan2, so that chi = 1 at r = 1.
    """
    decrement = 0.0 - jnp.log(r)
    return jnp.exp(-decrement / PI * jnp.arctan2(jnp.full_like(decrement, PI), decrement))


def rigid_depth(pair: ImpactPair) -> Values:
    """Compute the depth per speed of rigid walls, that of kappa = 1; 0 of one beside a soft wall, which lends none."""
    return rigid_penetration(pair.r) if pair.rigid else jnp.zeros_like(pair.r)


@door
def membrane_work_rigid(v_in: Values, r: Values) -> Values:
    """Compute the energy per unit mass that a rigid wall takes from the ball: v_in^2 (1 - r^2)/2."""
    return 0.5 * v_in * v_in * (1 - r) * (1 + r)


# A contact with max(kappa, pi) duration below the reach is measured through its velocity's Hermite polynomial.
SHORT_REACH = 0.25
_MATCHED = 4  # derivatives of the velocity that the polynomial matches at either end, the velocity itself included


def _legendre_from_ends(parity: int) -> np.ndarray:
    """Make the matrix from scaled derivatives at +1 of an even (0) or odd (1) polynomial to Legendre coefficients.

    P_n^(j)(1) = (n + j)!/(2^j j! (n - j)!). Rows times sqrt(2/(2n + 1)), so that squares add up to the integral.
    """
    degrees = [parity + 2 * n for n in range(_MATCHED)]
    slopes = [
        [math.comb(n + j, 2 * j) * math.factorial(2 * j) / (2**j * math.factorial(j)) for n in degrees]
        for j in range(_MATCHED)
    ]
    return np.sqrt([[2 / (2 * n + 1)] for n in degrees]) * np.linalg.inv(slopes)


_EVEN, _ODD = _legendre_from_ends(0), _legendre_from_ends(1)


def short_contact_work(
    kappa: Values, mu: Values, ends: tuple[list[Values], list[Values]], z: tuple[Values, Values], duration: Values
) -> Values:
    """Compute mu int w'^2 of a short contact, without cancellation: a sum of squares of Legendre coefficients.

    Args:
        kappa, mu: The pair's.
        ends: The forcing and its derivatives at onset and at exit.
        z: Velocity w' at onset and at exit.
        duration: Time from onset to exit.
    """
    half = 0.5 * duration
    jets = []
    for force, speed in zip(ends, z, strict=True):
        # Derivatives by the equation of motion, times half^j; w = 0 at either end.
        before, now, scale, jet = jnp.zeros_like(speed), speed, half, [speed]
        for drive in force:
            before, now = now, scale * drive - (mu * half) * now - (kappa * half) ** 2 * before
            scale = scale * half
            jet.append(now)
        jets.append(jet)
    sums = [last + first for first, last in zip(*jets, strict=True)]
    differences = [last - first for first, last in zip(*jets, strict=True)]
    # At +1 a derivative of even order of the polynomial's even part is half the sum of the ends', one of odd order half
    # their difference; with the odd part it is the other way round.
    even, odd = ([(sums, differences)[(j + parity) % 2][j] for j in range(_MATCHED)] for parity in (0, 1))
    squares = [
        sum(float(weight) * value for weight, value in zip(row, part, strict=True)) ** 2
        for matrix, part in ((_EVEN, even), (_ODD, odd))
        for row in 0.5 * matrix
    ]
    return mu * (half * sum(squares))


def _long_work(
    kappa: Values, mu: Values, force: tuple[Values, ...], turn: tuple[Values, ...], z: tuple[Values, Values]
) -> Values:
    """Compute what `membrane_work` does by its closed form, which cancels in short contacts.

    Args:
        kappa, mu: The pair's.
        force: The forcing c cos(pi s) - q sin(pi s) - g as c, q and its value at the onset, c - g.
        turn: Sine, cosine, versine and lag of the duration.
        z: Velocity w' at onset and at exit.
    """
    (c, q, onset), (sin_s, cos_s, versine, lag), (z_in, z_out) = force, turn, z
    cos_f = onset * sin_s + 0.5 * (c * (lag - sin_s * versine) - q * sin_s * sin_s)
    sin_f = onset * versine - 0.5 * (c * versine * versine + q * (lag + sin_s * versine))
    cos_side, sin_side = cos_f / PI - (cos_s * z_out - z_in), sin_f / PI - sin_s * z_out
    stiffness, loss = (kappa - PI) * (kappa + PI), mu * PI
    square = stiffness * stiffness + loss * loss
    drift = c * (stiffness * sin_side + loss * cos_side) + q * (stiffness * cos_side - loss * sin_side)
    # At the undamped resonance (square = 0) the answer is zero by mu.
    return 0.5 * (z_in - z_out) * (z_in + z_out) + PI * drift / jnp.where(square > 0, square, 1.0)


def long_contact_work(
    kappa: Values, mu: Values, force: tuple[Values, ...], turn: tuple[Values, ...], z: tuple[Values, Values]
) -> Values:
    """Compute what `membrane_work` does of contacts that are not short and whose forcing is known: half the arithmetic.

    Args:
        kappa, mu: The pair's.
        force: The forcing c cos(pi s) - q sin(pi s) - g as c, q and its value at the onset, c - g.
        turn: The time s from onset to exit, of which max(kappa, pi) s is at least `SHORT_REACH`; sin and cos of pi s.
        z: Velocity w' at onset and at exit.
    """
    s, sine, cosine = turn
    # Versine and lag are as exact as the forcing here: what they add to a short contact's work is little.
    turned = sine, cosine, 1 - cosine, PI * s - sine
    return jnp.where(mu > 0, _long_work(kappa, mu, force, turned, z), 0.0)


@door
@once
def membrane_work(
    kappa: Values,
    mu: Values,
    gamma: Values,
    side: Values,
    t_in: Values,
    duration: Values,
    v_in: Values,
    v_out: Values,
) -> Values:
    """Compute the energy W per unit mass that a whole soft contact gives to the membrane, in squared units of u'.

    W = mu int w'^2 ds = (v_in^2 - v_out^2)/2 - int f' w ds, where w is the penetration and f = c cos(pi s) -
    q sin(pi s) - g its forcing at elapsed time s. With J_c, J_s = int (cos, sin)(pi s) w ds the last integral is
    -pi (c J_s + q J_c), and the equation of motion times cos or sin, integrated by parts, gives

        (kappa^2 - pi^2) J_c + mu pi J_s = int cos f ds - [cos w'],
        (kappa^2 - pi^2) J_s - mu pi J_c = int sin f ds - [sin w'].

    This cancels in short contacts, so those take mu int w'^2 itself, with the polynomial in s that has the derivatives
    of w' at both ends.

    Args:
        kappa, mu, gamma: The pair's, mu >= 0.
        side: +1 right, -1 left.
        t_in: Phase of onset.
        duration: Time from onset to exit.
        v_in, v_out: Signed velocities u' there, those of an exact contact (w = 0 at both ends).

    Returns:
        W >= 0; exactly 0 at mu = 0 (r = 1). Relative error of about eps kappa/mu, near kappa = pi eps (kappa/mu)^2: at
        worst 7e-12 for r < 0.98, 2e-7 at r = 0.9999 on the resonance.

    Source: physics.md, "Energy and power"; both forms against quadrature in test_energy.py.
    """
    side = jnp.asarray(side, v_in.dtype)
    sin_0, cos_0 = phasor(t_in)
    turn = half_turn(duration)
    sin_s, cos_s, _, _ = turn
    c, q, steady = side * cos_0, side * sin_0, side * gamma
    z_in, z_out = side * v_in, side * v_out
    onset = c - steady
    work_long = _long_work(kappa, mu, (c, q, onset), turn, (z_in, z_out))

    short = jnp.maximum(kappa, PI) * duration < SHORT_REACH
    sin_e, cos_e = c * sin_s + q * cos_s, c * cos_s - q * sin_s
    ends = (
        [onset, -PI * q, -(PI**2) * c],
        [cos_e - steady, -PI * sin_e, -(PI**2) * cos_e],
    )
    work_short = short_contact_work(kappa, mu, ends, (z_in, z_out), jnp.where(short, duration, 0.0))
    work = jnp.where(short, work_short, work_long)
    # Exactly zero without damping, with the derivative in mu kept.
    return jnp.where(mu > 0, work, work - lax.stop_gradient(work))


@door
def energy_ratio(energy: Values, work: Values) -> Values:
    """Divide energy taken out by energy put in, E_j/W_j: 0 where nothing is taken out, inf where nothing was put in."""
    some = work > 0
    ratio = jnp.where(some, energy / jnp.where(some, work, 1.0), jnp.inf)
    return jnp.where(energy == 0, 0.0, ratio)


@door
def admissible(device: Harvester, energy: Values, work: Values, depth: Values) -> Bool[Array, "..."]:
    """Return whether an impact is admissible: E_j <= energy_ratio_limit W_j, and the penetration is within its limit.

    Args:
        energy: E_j [J].
        work: W_j [J], the result of `membrane_work` times m_b speed_unit^2.
        depth: Largest penetration [m].
    """
    limit: Any = device.depth_limit
    return (energy <= device.energy_ratio_limit * work) & (depth <= limit)
