"""Rigid walls of a driven motion: the ball rebounds, or sticks until the force on it changes sign.

A stuck ball leaves the wall when the force into the wall falls through 0. The steps of a stuck ball therefore apply the
certificates, which otherwise apply to the clearance, to this force.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from vijax.impact.exact.exact_step import STICK_SHARE, stick_speed
from vijax.impact.forcing import Forcing
from vijax.impact.taylor import taylor
from vijax.impact.taylor.driven_events import Decision, DrivenCarry, StepEnd
from vijax.impact.taylor.taylor import Oscillator, Push, Rates
from vijax.model import energy, flow
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import Sides, at_wall
from vijax.runtime.arrays import Flag, Scalar, select

# A force into the wall of at least -_NO_PUSH holds the ball on the wall. A stuck ball therefore stays on the wall while
# a record is zero, and at its release the force points away from the wall in spite of rounding.
_NO_PUSH = 1e-13
# Factor on the speed `stick_speed` below which a chattering ball may count as stuck. It is above 1 because
# displacements are measured from the middle of the gap, so a bounce of height 1e-16 is lost to rounding.
_SLOWER = 100


class DrivenWall(NamedTuple):
    """A wall of a driven motion: its membrane (all 0 if rigid), and the restitution coefficient if a wall is rigid."""

    spring: Oscillator
    r: Scalar | None


def driven_walls(pair: ImpactPair) -> DrivenWall | Sides:
    """Return the walls of a pair: one value if both are equal, otherwise one value per wall."""
    if pair.has_unequal_walls:
        return Sides(_wall(pair, -1), _wall(pair, 1))
    return _wall(pair, 1)


def _wall(pair: ImpactPair, side: int) -> DrivenWall:
    here = pair.at(side)
    if pair.is_rigid_at(side):
        zero = jnp.zeros_like(pair.d)
        return DrivenWall(Oscillator(zero, zero, zero, zero + jnp.inf), here.r)
    kappa = here._soft_kappa()
    spring = Oscillator(kappa, kappa * kappa, here.mu, taylor.REACH / kappa)
    return DrivenWall(spring, here.r if pair.rigid_side else None)


def watch_push(
    rests: Flag, push: Push, later: Push, forcing: Forcing, motion: tuple[Rates, Rates, Scalar]
) -> tuple[Rates, Rates, Scalar]:
    """Replace the penetration by the force into the wall in lanes where the ball is stuck.

    Args:
        rests: True for a ball that is stuck on a rigid wall.
        push, later: Force at the start and at the end of the step.
        forcing: Excitation that the force belongs to.
        motion: States at the start and at the end of the step, and a bound of the fourth derivative.
    """
    now, end, most = motion
    # The fastest harmonic sets the reach of a series, so its frequency bounds the two further derivatives.
    bound = forcing.curvature_bound * (taylor.REACH / forcing.reach) ** 2
    begins, ends = (_push_rates(of) for of in (push, later))
    return select(rests, (begins, ends, bound + jnp.zeros_like(most)), (now, end, most))


def _push_rates(push: Push) -> Rates:
    value, rate, bend, twist = push.derivatives()
    return Rates(value + _NO_PUSH, rate, bend, twist, push.fourth())


class RigidImpact(NamedTuple):
    """Result of an impact on a rigid wall.

    Attributes:
        bounces: The ball reaches the rigid wall and leaves it at once.
        sticks: The ball stays on the wall, because the rest of its chatter takes no time.
        depth: Depth of the equivalent membrane contact, Eq. (35).
        work: Energy given to the wall.
        tangent: Tangent map of the impact, row by row; 0 where the ball sticks, because its state no longer depends on
            the past.
    """

    bounces: Flag
    sticks: Flag
    depth: Scalar
    work: Scalar
    tangent: tuple[Scalar, ...]


def rigid_impact(
    pair: ImpactPair, walls: DrivenWall | Sides, step_end: StepEnd, push: Push, knot_spacing: Scalar
) -> tuple[RigidImpact, StepEnd]:
    """Compute the impact on a rigid wall at the end of a step, and the state of the ball after it.

    Args:
        pair: One cell.
        walls: Result of `driven_walls`.
        step_end: End of the step.
        push: Force in flight at the end of the step.
        knot_spacing: Time between two knots.

    A chatter is a geometric series of bounces. After a rebound at speed v, under an acceleration a into the wall, the
    rest of the chatter lasts 2 v/(a (1 - r)), as in `exact`.
    """
    toward, v_in = step_end.toward, step_end.before_event.z
    reaches = step_end.onset & pair.is_rigid_at(toward)
    r: Any = at_wall(walls, toward).r
    value, rate, *_ = (toward * of for of in push.derivatives())
    out = r * jnp.maximum(toward * v_in, 0.0)
    # `value` is the acceleration into the wall; a bounce at speed v lasts 2 v/value.
    chatter_time = 2 * out / jnp.where(value > 0, value, 1.0) / jnp.maximum(1 - r, jnp.finfo(out.dtype).tiny)
    # Time until the force may change sign, by its slope; at most one knot spacing, since later samples are unknown.
    turn_time = jnp.minimum(knot_spacing, value / jnp.where(rate < 0, -rate, value / knot_spacing))
    is_slow = out < _SLOWER * stick_speed(out.dtype)
    sticks = reaches & is_slow & (value > 0) & (chatter_time < STICK_SHARE * turn_time) & (r < 1)
    bounces = reaches & ~sticks
    wall = pair.at(toward)
    deep = toward * v_in * (energy.rigid_depth(wall) if pair.rigid else jnp.zeros_like(out))
    matrix = flow.rigid_matrix(r, toward * value, jnp.where(reaches, v_in, 1.0))
    tangent = tuple(jnp.where(sticks, 0.0, entry) for entry in matrix.ravel())
    x = jnp.where(bounces, toward * 0.5 * pair.d, step_end.x)
    z = jnp.where(bounces, -toward * out, jnp.where(sticks, 0.0, step_end.z))
    step_end = step_end._replace(x=x, z=z, onset=step_end.onset & ~bounces)
    work = energy.membrane_work_rigid(v_in, r)
    return RigidImpact(bounces, sticks, deep, work, tangent), step_end


def keep_at_rest(step_end: StepEnd, decision: Decision, rests: Flag) -> StepEnd:
    """Keep a stuck ball at its place, because its step holds the force into the wall instead of the penetration."""
    still = rests & decision.accepted
    return step_end._replace(x=jnp.where(still & ~step_end.exits, 0.0, step_end.x), z=jnp.where(still, 0.0, step_end.z))


def record_impact(
    m: DrivenCarry, impact: RigidImpact, step_end: StepEnd, when: tuple[Scalar, Any], rests: Flag
) -> DrivenCarry:
    """Record an impact on a rigid wall in the carry: onset and end coincide unless the ball sticks.

    `when` holds the phase and the period number at the end of the step.
    """
    t, n = when
    has_impact, tangent = impact.bounces | impact.sticks, m.tangent
    if tangent is not None:
        a, b, c, d = tangent
        p, q, r, s = impact.tangent
        # Matrix product: the map of the impact times the map up to it.
        product = (p * a + q * c, p * b + q * d, r * a + s * c, r * b + s * d)
        # The release of a stuck ball does not depend on its state. For a ball that is stuck at the start, the map
        # becomes zero here.
        was_stuck = rests & step_end.exits
        tangent = tuple(
            jnp.where(was_stuck, 0.0, jnp.where(has_impact, new, old))
            for new, old in zip(product, tangent, strict=True)
        )
    return replace(
        m,
        tangent=tangent,
        onset_t=jnp.where(has_impact, t, m.onset_t),
        onset_n=jnp.where(has_impact, n, m.onset_n),
        v_in=jnp.where(has_impact, step_end.before_event.z, m.v_in),
        depth=jnp.where(has_impact, impact.depth, m.depth),
        work=None if m.work is None else jnp.where(has_impact, impact.work, m.work),
    )
