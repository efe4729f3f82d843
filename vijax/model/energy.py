"""Energy of an impact: energy E_j harvested by the membrane's capacitance, energy W_j given by the ball, admissibility.

    E_j = V^2/2 (C_max + C_T)/(C_min + C_T) (C_max - C_min),   C = eps_M A_s^2/(w0 pi R0^2),          Eqs. (30)-(34)
    W_j = mu int w'^2 ds over the contact (per unit mass, in squared units of u').

An impact is admissible if E_j <= energy_ratio_limit W_j and its penetration is within the limit. Source: the paper's
equations with the corrections of physics.md.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.flow import phasor, sin_cos_versine_lag
from vijax.model.pair import ImpactPair
from vijax.model.units import QuantityLike
from vijax.runtime import validation
from vijax.runtime.arrays import Values
from vijax.runtime.compilation.xla import reuse_trace
from vijax.runtime.public_api import public_api
from vijax.runtime.tiles import elementwise

PI = math.pi


@public_api
def stretch(device: Harvester, depth: Values) -> Values:
    """Compute the relative growth A_s/(pi R0^2) - 1 of the area A_s of a membrane at penetration `depth` [m].

    With lengths in units of R0, h = r_b - depth and S^2 = 1 + h^2 - r_b^2 (the tangent from the rim to the ball):
    cos(alpha) = (r_b h + S)/(1 + h^2), and A_s/(pi R0^2) - 1 = (1 - cos)/cos (1 - r_b^2 (1 - cos)).

    Source: Eqs. (30)-(31) with r_b sin(alpha) for the printed r_b cos(alpha), so that the area is continuous at 0.
    """
    R0: Any = device.R0
    # Lengths in units of R0: ball radius, and penetration x (0 before the ball touches).
    ball = device.r_b / R0
    # A negative depth, by rounding at a slow onset, counts as no penetration.
    x = jnp.where(depth < 0, 0.0, depth) / R0
    tangent = jnp.sqrt(1 + x * (x - 2 * ball))
    reach = 1 + (ball - x) ** 2
    # 1 - cos(alpha) = rise/(over reach), without cancellation: 1 - cos itself has no correct digit below depth 1e-8 R0.
    rise = x * x * (tangent * (1 + tangent) + ball * (2 * ball - x))
    over = (1 + tangent) ** 2
    # Both quotients are combined over one denominator, because a division costs as much as all other operations
    # together.
    cos_reach, common = ball * (ball - x) + tangent, over * reach
    return rise * (common - ball * ball * rise) / (over * cos_reach * common)


def _rest_capacitance(device: Harvester) -> Values:
    """Compute the capacitance of the undeformed membrane [F]."""
    eps_M: Any = device.eps_M
    R0: Any = device.R0
    w0: Any = device.w0
    # Plate capacitor: area pi R0^2, distance of the electrodes w0.
    return jnp.asarray(eps_M * PI * R0**2 / w0)


@public_api
def capacitance(device: Harvester, depth: Values) -> Values:
    """Compute the capacitance [F] of a membrane that a ball has entered by `depth` [m].

    C_M = eps_M A_s^2/(w0 pi R0^2): the volume is constant, so the membrane becomes thinner as its area grows.

    Source: Eqs. (30)-(33), with the area of `stretch`.
    """
    return _rest_capacitance(device) * (1 + stretch(device, depth)) ** 2


@public_api
def harvested_energy(device: Harvester, depth: QuantityLike) -> Values:
    """Compute the energy E_j [J] of an impact with largest penetration `depth`, in metres or a quantity of pint.

    E = (C_max + C_T)/(C_min + C_T) (C_max - C_min) V^2/2, with full relative accuracy down to depth 0, where E and its
    gradient vanish.

    Raises:
        ValueError: If `device` is not a `Harvester`, or a depth is not a number (traced depths are not checked).

    Source: Eq. (34).
    """
    # The result is the energy at one wall, so that the constants of both walls must be equal.
    if check_device(device).has_unequal_walls:
        raise ValueError("device must have equal walls, as device.at(1) or device.at(-1) has; got walls that differ")
    metres: Any = units.plain_number("depth", depth)
    if validation.is_concrete(metres):
        numbers = validation.validate_numbers("depth", metres, nonempty=False)
        # Lists become float arrays; numbers and arrays keep their type, which sets the precision of the result.
        metres = jnp.asarray(numbers, float) if isinstance(metres, list | tuple) else metres
    return elementwise(_harvested, device, metres)


@reuse_trace
def _harvested(device: Harvester, depth: Values) -> Values:
    V: Any = device.V
    # C_max - C_min = C_min ((1 + growth)^2 - 1) = C_min growth (2 + growth), which does not cancel at small depth.
    growth = stretch(device, depth)
    least = _rest_capacitance(device)
    gain = least * growth * (2 + growth)
    # The quotient 1/(C_min + C_T) depends on the device only, so that one division suffices for all impacts.
    return (0.5 * V**2) * gain * (1 + gain * (1 / (least + device.C_T)))


@public_api
def rigid_penetration(r: Values) -> Values:
    """Compute the factor chi of the largest penetration |v_in| chi/omega0 of a contact without forcing.

    chi = exp(ln r/pi arctan(-pi/ln r)): depth [m] = |v_in| [m/s] chi/omega0, or |v| chi/kappa in units of u. The energy
    of an impact on a rigid wall is computed from this penetration, as if the wall were a membrane of frequency omega0.

    Source: Eq. (35), with atan2, so that chi = 1 at r = 1.
    """
    decrement = 0.0 - jnp.log(r)
    # arctan2 is pi/2 at r = 1, where the quotient pi/0 is undefined.
    return jnp.exp(-decrement / PI * jnp.arctan2(jnp.full_like(decrement, PI), decrement))


def rigid_depth(pair: ImpactPair) -> Values:
    """Compute the depth of an impact on a rigid wall per impact speed, for kappa = 1; 0 if the other wall is soft."""
    # A rigid wall opposite to a soft wall has no membrane, so that its impacts have depth 0 and harvest nothing.
    return rigid_penetration(pair.r) if pair.rigid else jnp.zeros_like(pair.r)


@public_api
def membrane_work_rigid(v_in: Values, r: Values) -> Values:
    """Compute the energy per unit mass that an impact on a rigid wall dissipates: v_in^2 (1 - r^2)/2."""
    # The product is factored, because 1 - r^2 would lose digits near r = 1.
    return 0.5 * v_in * v_in * (1 - r) * (1 + r)


# If max(kappa, pi) * duration is below SHORT_REACH, the work is the integral of the Hermite polynomial of w', because
# the closed form that is used for longer contacts would lose digits by cancellation.
SHORT_REACH = 0.25
_MATCHED = 4  # orders 0 to 3 of derivatives of w' that the polynomial matches at each end


def _legendre_from_ends(parity: int) -> np.ndarray:
    """Return the matrix from scaled derivatives at +1 of an even (0) or odd (1) polynomial to Legendre coefficients.

    P_n^(j)(1) = (n + j)!/(2^j j! (n - j)!). Each row is scaled by sqrt(2/(2n + 1)), so that the sum of squared
    coefficients is the integral of the squared polynomial over [-1, 1].
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
        kappa, mu: Frequency and damping of the pair.
        ends: The forcing and its first two derivatives at onset and at exit.
        z: Velocity w' at onset and at exit.
        duration: Time from onset to exit.
    """
    # The contact maps to [-1, 1]: each derivative scales with half the duration.
    half = 0.5 * duration
    jets = []
    for force, speed in zip(ends, z, strict=True):
        # Scaled derivatives half^j w^(j + 1) by the equation of motion w'' = f - mu w' - kappa^2 w; w = 0 at both ends.
        before, now, scale, jet = jnp.zeros_like(speed), speed, half, [speed]
        for drive in force:
            before, now = now, scale * drive - (mu * half) * now - (kappa * half) ** 2 * before
            scale = scale * half
            jet.append(now)
        jets.append(jet)
    sums = [last + first for first, last in zip(*jets, strict=True)]
    differences = [last - first for first, last in zip(*jets, strict=True)]
    # Even part of the polynomial: its derivative of even order at +1 is half the sum of both ends' derivatives, its
    # derivative of odd order is half their difference. For the odd part, sum and difference swap.
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
    """Compute `membrane_work` by its closed form, which loses digits by cancellation in short contacts.

    Args:
        kappa, mu: Frequency and damping of the pair.
        force: The forcing c cos(pi s) - q sin(pi s) - g as c, q and its value at the onset, c - g.
        turn: Sine, cosine, versine (1 - cos) and lag (pi s - sin) of pi times the duration.
        z: Velocity w' at onset and at exit.
    """
    (c, q, onset), (sin_s, cos_s, versine, lag), (z_in, z_out) = force, turn, z
    # cos_f, sin_f: pi times the integrals of cos(pi s) f and sin(pi s) f. cos_side, sin_side: right-hand sides of the
    # two linear equations for J_c and J_s in `membrane_work`.
    cos_f = onset * sin_s + 0.5 * (c * (lag - sin_s * versine) - q * sin_s * sin_s)
    sin_f = onset * versine - 0.5 * (c * versine * versine + q * (lag + sin_s * versine))
    cos_side, sin_side = cos_f / PI - (cos_s * z_out - z_in), sin_f / PI - sin_s * z_out
    # Factored so that kappa^2 - pi^2 keeps its digits near the resonance kappa = pi.
    stiffness, loss = (kappa - PI) * (kappa + PI), mu * PI
    square = stiffness * stiffness + loss * loss
    drift = c * (stiffness * sin_side + loss * cos_side) + q * (stiffness * cos_side - loss * sin_side)
    # At the undamped resonance square = 0; any finite quotient is allowed, because mu = 0 makes the final result zero.
    return 0.5 * (z_in - z_out) * (z_in + z_out) + PI * drift / jnp.where(square > 0, square, 1.0)


def long_contact_work(
    kappa: Values, mu: Values, force: tuple[Values, ...], turn: tuple[Values, ...], z: tuple[Values, Values]
) -> Values:
    """Compute `membrane_work` of contacts that are not short and have known forcing, with half of its arithmetic.

    Args:
        kappa, mu: Frequency and damping of the pair.
        force: The forcing c cos(pi s) - q sin(pi s) - g as c, q and its value at the onset, c - g.
        turn: The time s from onset to exit, where max(kappa, pi) s is at least `SHORT_REACH`; sin and cos of pi s.
        z: Velocity w' at onset and at exit.
    """
    s, sine, cosine = turn
    # Direct differences are accurate enough, because the contact is not short and the forcing has the same rounding
    # error.
    turned = sine, cosine, 1 - cosine, PI * s - sine
    return jnp.where(mu > 0, _long_work(kappa, mu, force, turned, z), 0.0)


@public_api
@reuse_trace
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

    W = mu int w'^2 ds = (v_in^2 - v_out^2)/2 - int f' w ds, where w is the penetration and f = c cos(pi s) - q sin(pi
    s) - g its forcing at elapsed time s. With J_c, J_s = int (cos, sin)(pi s) w ds the last integral is -pi (c J_s + q
    J_c), and the equation of motion times cos or sin, integrated by parts, gives

        (kappa^2 - pi^2) J_c + mu pi J_s = int cos f ds - [cos w'],
        (kappa^2 - pi^2) J_s - mu pi J_c = int sin f ds - [sin w'].

    This form loses digits by cancellation in short contacts. For short contacts the function integrates mu w'^2 of the
    polynomial in s that matches the derivatives of w' at both ends.

    Args:
        kappa, mu, gamma: Frequency, damping and gravity of the pair, mu >= 0.
        side: +1 right, -1 left.
        t_in: Phase of onset.
        duration: Time from onset to exit.
        v_in, v_out: Signed velocities u' at onset and exit of an exact contact (w = 0 at both ends).

    Returns:
        W >= 0; exactly 0 at mu = 0 (r = 1). The relative error is about eps kappa/mu, and about eps (kappa/mu)^2 near
        the resonance kappa = pi; the largest observed errors are 7e-12 for r < 0.98 and 2e-7 at r = 0.9999 on the
        resonance.

    Source: physics.md, "Energy and power"; both forms against quadrature in test_energy.py.
    """
    side = jnp.asarray(side, v_in.dtype)
    sin_0, cos_0 = phasor(t_in)
    turn = sin_cos_versine_lag(duration)
    sin_s, cos_s, _, _ = turn
    # Forcing of the penetration with its clock started at the onset: c cos(pi s) - q sin(pi s) - steady.
    c, q, steady = side * cos_0, side * sin_0, side * gamma
    z_in, z_out = side * v_in, side * v_out
    onset = c - steady
    work_long = _long_work(kappa, mu, (c, q, onset), turn, (z_in, z_out))

    short = jnp.maximum(kappa, PI) * duration < SHORT_REACH
    # The forcing phase at exit, by the addition theorem; then f, f' and f'' at both ends.
    sin_e, cos_e = c * sin_s + q * cos_s, c * cos_s - q * sin_s
    ends = (
        [onset, -PI * q, -(PI**2) * c],
        [cos_e - steady, -PI * sin_e, -(PI**2) * cos_e],
    )
    # Long contacts pass duration 0, so that the unused branch of `where` cannot overflow and its gradient stays finite.
    work_short = short_contact_work(kappa, mu, ends, (z_in, z_out), jnp.where(short, duration, 0.0))
    work = jnp.where(short, work_short, work_long)
    # Exactly zero without damping, while the derivative with respect to mu is kept.
    return jnp.where(mu > 0, work, work - lax.stop_gradient(work))


@public_api
def energy_ratio(energy: Values, work: Values) -> Values:
    """Compute E_j/W_j, energy harvested over energy given: 0 if E_j = 0, inf if W_j <= 0 < E_j."""
    positive = work > 0
    # The inner `where` avoids a division by zero, which would also make the gradient NaN.
    ratio = jnp.where(positive, energy / jnp.where(positive, work, 1.0), jnp.inf)
    return jnp.where(energy == 0, 0.0, ratio)


@public_api
def admissible(device: Harvester, energy: Values, work: Values, depth: Values) -> Bool[Array, "..."]:
    """Return whether an impact is admissible: E_j <= energy_ratio_limit W_j, and the penetration is within its limit.

    Args:
        device: The device.
        energy: E_j [J].
        work: W_j [J], the result of `membrane_work` times m_b speed_unit^2.
        depth: Largest penetration [m].
    """
    # Comparisons with NaN are False, so that a failed impact is not admissible.
    limit: Any = device.depth_limit
    return (energy <= device.energy_ratio_limit * work) & (depth <= limit)
