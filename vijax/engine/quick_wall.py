"""Walls as the quick step needs them: constants of a cell that no impact changes, with bounds of its certificates.

`RigidWall` or `SoftWall`: which of them a program has is known when it is traced.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Bool

from vijax.engine.ground import Ground
from vijax.engine.impact import Lane
from vijax.engine.quick_inclined_flight import Incline, incline
from vijax.model import energy
from vijax.model.flow import PI, Membrane, membrane
from vijax.model.pair import ImpactPair
from vijax.model.sides import Sides
from vijax.runtime.arrays import AnyArray

DOUBT = 1e-3  # A sign or a bound that is closer is not trusted to single precision.
DEEP_REACH = 2.6  # The way from the deepest point to the exit is this long at most, in radians of omega1.
LONG_REACH = 3.0  # With gravity more contacts take longer than that; this is their bound.


class RigidWall(eqx.Module):
    """What an impact on a rigid wall needs and no impact changes."""

    half: Lane
    r: Lane
    chi: Lane  # The greatest depth per speed.
    incline: Incline | None  # None on level ground.


class Ebb(eqx.Module):
    """When and how fast a membrane under gravity and forcing, its swing gone, comes back to where a ball leaves it."""

    phase: Lane  # The phase of the forcing towards the wall.
    arc: Lane  # How long the membrane has been coming from the steady response's other extremum.
    rate: Lane
    force_cos: Lane  # The forcing then, as in `ContactEntry`.
    force_sin: Lane


class SoftWall(eqx.Module):
    """What the contact of a cell needs and no impact changes."""

    half: Lane
    r: Lane
    kappa: Lane
    zeta: Lane
    omega1: Lane
    gain_in: Lane  # The steady response per forcing, in phase.
    gain_out: Lane  # and a quarter turn behind
    span: Lane  # pi/omega1: the free contact
    cos_span: Lane
    sin_span: Lane
    cos_middle: Lane
    sin_middle: Lane
    root_r: Lane
    hop: Lane  # a contact whose cubic Taylor polynomial ends before this is expanded about half the span
    crest: Lane  # free time of greatest depth
    cos_crest: Lane
    sin_crest: Lane
    crest_decay: Lane
    steep: Lane  # The least speed at which w' is sure to have its first zero near the free crest.
    lift: Lane  # The least -w'' at the crest, per bound of f', that keeps w' negative until the exit.
    long_lift: Lane | None  # Likewise for a longer way; None on level ground.
    usable: Bool[AnyArray, " lane"]
    incline: Incline | None  # None on level ground.
    ebb: Ebb | None  # None where contacts that outlast the free one by far are not looked for.


Wall = RigidWall | SoftWall
TwoWalls = Wall | Sides
"""Of walls that differ one each: what no wall changes, `half` and `incline`, is the same in both."""


def prepare(pair: ImpactPair, *, ground: Ground = Ground.LEVEL) -> TwoWalls:
    """Compute the constants of the quick step for every cell."""
    if pair.unequal:
        return Sides(*(_prepare(pair.at(side), pair.rigid or pair.hard_wall == side, ground) for side in (-1, 1)))
    return _prepare(pair, pair.rigid, ground)


def _prepare(pair: ImpactPair, rigid: bool, ground: Ground) -> Wall:
    """Compute the constants of walls that are both alike."""
    level = ground is Ground.LEVEL
    slope = None if level else incline(pair.gamma)
    if rigid:
        return RigidWall(0.5 * pair.d, pair.r, chi=energy.rigid_depth(pair), incline=slope)
    wall = membrane(pair)
    kappa, zeta, omega1 = wall.kappa, wall.zeta, wall.omega1
    square = kappa * kappa
    stiffness, loss = square - PI**2, 2 * zeta * PI
    size = stiffness * stiffness + loss * loss
    span, theta = PI / omega1, jnp.arctan2(omega1, zeta)
    crest = theta / omega1
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
        hop=jnp.where(bend > 0, 1.6 / (jnp.sqrt(jnp.maximum(bend, 0.0)) + zeta), 0.0),  # 0.8 of the free contact's
        crest=crest,
        cos_crest=jnp.cos(PI * crest),
        sin_crest=jnp.sin(PI * crest),
        crest_decay=jnp.exp(-zeta * crest),
        steep=steep if level else steep * (1 + jnp.abs(pair.gamma)),
        lift=lift,
        long_lift=None if level else long_lift,
        # Near the resonance the steady response is large and cancels.
        usable=(size > 1.0) & (pair.r > 1e-2),
        incline=slope,
        ebb=None if ground is not Ground.STEEP else _ebb(stiffness, loss, jnp.abs(pair.gamma) / square),
    )


def _certificates(wall: Membrane, theta: Lane) -> tuple[Lane, Lane, Lane]:
    """Compute the size certificates of a contact: the constants `steep`, `lift` and `long_lift` of `SoftWall`.

    They are for a forcing of at most 1, or with gravity 1 + |gamma| and that many times the speed.

    While v h'(s) > h(s), up to s_a = theta/(2 omega1), half the free time of greatest depth, w' stays positive (Duhamel
    with h' > 0), and once kappa^2 w(s_a) >= 1 it falls until its zero ("steep"). From there -w' starts with slope
    V = -w'' and is driven by at most max f': it stays positive while V h > max f' H, H the integral of h ("lift"); h/H
    falls with time since h is log-concave.
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
    steep = (1 + DOUBT) * jnp.maximum(h_a / slope_a, (1 / square + static_a) / h_a)
    return steep, (1 + DOUBT) * static_d / h_d, (1 + DOUBT) * static_e / h_e


def _ebb(stiffness: Lane, loss: Lane, rest: Lane) -> Ebb:
    """Find where a steady response about `rest`, of the amplitude and lag of (stiffness, loss), falls through 0."""
    amplitude = 1 / jnp.hypot(stiffness, loss)
    level = jnp.clip(rest / amplitude, 0.0, 1.0)
    turn = jnp.arccos(-level) * (1 / PI)
    phase = turn + jnp.arctan2(loss, stiffness) * (1 / PI)
    rate = PI * amplitude * jnp.sqrt((1 - level) * (1 + level))
    return Ebb(phase, turn + 1, rate, jnp.cos(PI * phase), jnp.sin(PI * phase))
