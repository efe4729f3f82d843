"""Constants of the walls for the fast step: values of a cell that no impact changes, and bounds for its certificates.

A program holds `RigidWall` or `SoftWall`; the type is known when the program is traced.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Bool

from vijax.impact.fast.fast_gravity_flight import GravityConstants, gravity_constants
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import Lane
from vijax.model import energy
from vijax.model.flow import PI, Membrane, membrane
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import Sides
from vijax.runtime.arrays import AnyArray

MARGIN = 1e-3  # In single precision, a comparison of two values closer than this counts as undecided.
# Longest time from the deepest point to the exit, times omega1, for the certificate `SoftWall.lift`. With gravity many
# contacts take longer; for them `SoftWall.long_lift` holds up to LONG_REACH.
DEEP_REACH = 2.6
LONG_REACH = 3.0


class RigidWall(eqx.Module):
    """Constants of a rigid wall."""

    half: Lane
    r: Lane
    chi: Lane  # Largest depth per unit of speed of the membrane contact with the same restitution and kappa = 1.
    gravity: GravityConstants | None  # None without gravity.


class SteadyExit(eqx.Module):
    """Time when the steady response of a membrane to gravity and forcing falls through zero.

    If the oscillation about the steady response has decayed, the ball leaves the membrane at about this time.
    """

    phase: Lane  # Phase of the forcing towards the wall at that time.
    arc: Lane  # Time from the last minimum of the steady response until that time.
    rate: Lane  # Size of the rate of the steady response at that time.
    force_cos: Lane  # cos and sin of the phase of the forcing towards the wall at that time
    force_sin: Lane


class SoftWall(eqx.Module):
    """Constants of a soft wall that its contacts share."""

    half: Lane
    r: Lane
    kappa: Lane
    zeta: Lane
    omega1: Lane
    gain_in: Lane  # Steady response per unit of forcing: the part in phase with the forcing.
    gain_out: Lane  # Steady response per unit of forcing: the part a quarter period behind the forcing.
    span: Lane  # pi/omega1, the duration of the free contact (the contact without forcing)
    cos_span: Lane  # cos and sin of pi times the span; cos_middle and sin_middle: of pi times half the span
    sin_span: Lane
    cos_middle: Lane
    sin_middle: Lane
    root_r: Lane
    hop: Lane  # if the cubic Taylor polynomial of w has its zero before this time, half the span is the reference time
    crest: Lane  # time of the free contact's crest
    cos_crest: Lane
    sin_crest: Lane
    crest_decay: Lane
    steep: Lane  # If the speed is above this, w' is certified to have its first zero near the crest without forcing.
    lift: Lane  # If -w'' at the crest is above this times the bound of f', w' stays negative until the exit.
    long_lift: Lane | None  # Like `lift`, for exits up to LONG_REACH after the crest; None without gravity.
    certifiable: Bool[AnyArray, " lane"]
    gravity: GravityConstants | None  # None without gravity.
    steady_exit: SteadyExit | None  # None if the program does not certify contacts that gravity prolongs.


Wall = RigidWall | SoftWall
TwoWalls = Wall | Sides
"""One record for equal walls, otherwise one per wall; `half` and `gravity` are equal in both."""


def prepare_walls(pair: ImpactPair, *, gravity_regime: GravityRegime = GravityRegime.NONE) -> TwoWalls:
    """Return the constants of the fast step for every cell."""
    if pair.has_unequal_walls:
        return Sides(
            *(_prepare(pair.at(side), pair.rigid or pair.rigid_side == side, gravity_regime) for side in (-1, 1))
        )
    return _prepare(pair, pair.rigid, gravity_regime)


def _prepare(pair: ImpactPair, rigid: bool, gravity_regime: GravityRegime) -> Wall:
    """Return the constants of one wall; `pair` has two equal walls of this kind."""
    no_gravity = gravity_regime is GravityRegime.NONE
    gravity = None if no_gravity else gravity_constants(pair.gamma)
    if rigid:
        return RigidWall(0.5 * pair.d, pair.r, chi=energy.rigid_depth(pair), gravity=gravity)
    wall = membrane(pair)
    kappa, zeta, omega1 = wall.kappa, wall.zeta, wall.omega1
    square = kappa * kappa
    # The steady response per unit of forcing is 1/(stiffness + i loss).
    stiffness, loss = square - PI**2, 2 * zeta * PI
    size = stiffness * stiffness + loss * loss
    span, theta = PI / omega1, jnp.arctan2(omega1, zeta)
    crest = theta / omega1
    # Discriminant as in `fast_contact._guess`, for zero forcing and unit speed.
    bend = zeta * zeta - (2 / 3) * (4 * zeta * zeta - square)
    steep, lift, long_lift = _certificates(wall, theta)
    return SoftWall(
        half=0.5 * pair.d,
        r=pair.r,
        kappa=kappa,
        zeta=zeta,
        omega1=omega1,
        gain_in=stiffness / size,
        gain_out=loss / size,
        span=span,
        cos_span=jnp.cos(PI * span),
        sin_span=jnp.sin(PI * span),
        cos_middle=jnp.cos(0.5 * PI * span),
        sin_middle=jnp.sin(0.5 * PI * span),
        root_r=jnp.sqrt(pair.r),
        # 0.8 of the duration of the free contact by the cubic Taylor polynomial of w
        hop=jnp.where(bend > 0, 1.6 / (jnp.sqrt(jnp.maximum(bend, 0.0)) + zeta), 0.0),
        crest=crest,
        cos_crest=jnp.cos(PI * crest),
        sin_crest=jnp.sin(PI * crest),
        crest_decay=jnp.exp(-zeta * crest),
        steep=steep if no_gravity else steep * (1 + jnp.abs(pair.gamma)),
        lift=lift,
        long_lift=None if no_gravity else long_lift,
        # Near resonance the steady response and the free part are large and nearly cancel, so digits are lost.
        certifiable=(size > 1.0) & (pair.r > 1e-2),
        gravity=gravity,
        steady_exit=None
        if gravity_regime is not GravityRegime.STRONG
        else _steady_exit(stiffness, loss, jnp.abs(pair.gamma) / square),
    )


def _certificates(wall: Membrane, theta: Lane) -> tuple[Lane, Lane, Lane]:
    """Return the bounds `steep`, `lift` and `long_lift` of `SoftWall`, from which the sign of w' is certified.

    They hold for a forcing of at most 1. For a forcing of at most 1 + |gamma|, `steep` is multiplied by 1 + |gamma|.
    h is the impulse response of the membrane, H its integral, and v the speed at the onset.

    - steep: w' stays positive while v h'(s) > h(s) (Duhamel's formula with h' > 0). A speed above `steep` ensures this
      up to s_a = theta/(2 omega1), half the time of the crest without forcing. It also ensures kappa^2 w(s_a) >= 1, so
      that w' then falls until its zero.
    - lift: from the zero of w' on, -w' starts with the slope V = -w'' and is driven by at most max f'. -w' stays
      positive while V h > max f' H. The ratio h/H falls with time, because h is log-concave.
    """
    zeta, omega1 = wall.zeta, wall.omega1
    square = wall.kappa * wall.kappa

    def response(x):  # h, h' and H at omega1 s = x
        decay = jnp.exp(-zeta / omega1 * x)
        h, slope = decay * jnp.sin(x) / omega1, decay * (jnp.cos(x) - zeta / omega1 * jnp.sin(x))
        return h, slope, (1 - slope - 2 * zeta * h) / square

    h_a, slope_a, static_a = response(0.5 * theta)
    h_d, _, static_d = response(jnp.full_like(theta, DEEP_REACH))
    h_e, _, static_e = response(jnp.full_like(theta, LONG_REACH))
    steep = (1 + MARGIN) * jnp.maximum(h_a / slope_a, (1 / square + static_a) / h_a)
    return steep, (1 + MARGIN) * static_d / h_d, (1 + MARGIN) * static_e / h_e


def _steady_exit(stiffness: Lane, loss: Lane, rest: Lane) -> SteadyExit:
    """Return the time when a steady response about the constant penetration `rest` falls through 0.

    Amplitude and phase lag of the steady response are the modulus and argument of 1/(stiffness + i loss).
    """
    amplitude = 1 / jnp.hypot(stiffness, loss)
    level = jnp.clip(rest / amplitude, 0.0, 1.0)
    turn = jnp.arccos(-level) * (1 / PI)
    phase = turn + jnp.arctan2(loss, stiffness) * (1 / PI)
    rate = PI * amplitude * jnp.sqrt((1 - level) * (1 + level))
    return SteadyExit(phase, turn + 1, rate, jnp.cos(PI * phase), jnp.sin(PI * phase))
