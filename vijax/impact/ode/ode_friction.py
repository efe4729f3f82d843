"""Dry friction along the capsule: direction of sliding, sticking, and release.

Coulomb's law, as an acceleration over the forcing's amplitude. The capsule holds a ball at rest while the driving force
is not larger than the friction. It brakes a sliding ball by the full friction, which acts as a gravity that reverses
with the motion. `ode` stops a ball at each zero of the velocity and decides whether it reverses, continues or sticks.
While it sticks only the time advances, so its release has a closed form.

Source: Coulomb; the device with friction: Athanasouli, Yurchenko, Kuske, arXiv 2502.12288.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp

from vijax.impact.ode.dense_output import SolverState
from vijax.impact.ode.ode_events import FIRST_STEP, OdeCarry, Trial
from vijax.model.flow import PI
from vijax.model.pair import Real
from vijax.runtime.arrays import Flag, Scalar, not_none


class Sticking(NamedTuple):
    """Sticking of a ball in the capsule: the time until its release, and the direction of sliding after it."""

    duration: Scalar
    direction: Scalar


_PAST = 16  # A release that seems to have passed by less than this number of roundings takes place now.


def slip_direction(drive: Scalar, friction: Real) -> Scalar:
    """Return the direction of sliding, -1 or +1, of a ball at rest that is released; 0 if it sticks.

    Args:
        drive: Acceleration of the ball without friction, along the displacement.
        friction: Largest acceleration by friction, divided by the forcing's amplitude.
    """
    return jnp.where(jnp.abs(drive) <= friction, 0.0, jnp.sign(drive))


def sticking_from(t: Scalar, push: Scalar, friction: Scalar) -> Sticking:
    """Return how long a ball at rest sticks (inf: for ever), and the direction of sliding after its release.

    The driving acceleration is cos(pi t) + push. The ball is released once |cos(pi t) + push| exceeds `friction`.

    Args:
        t: The phase, in [0, 2].
        push: Constant part of the driving acceleration while the ball sticks: gravity, and the membrane's force.
        friction: Largest acceleration by friction, divided by the forcing's amplitude.
    """
    low, high = -friction - push, friction - push
    fall = jnp.where(low > -1, _until(_phase(low) - t), jnp.inf)
    rise = jnp.where(high < 1, _until(2 - _phase(high) - t), jnp.inf)
    return Sticking(jnp.minimum(fall, rise), jnp.where(fall <= rise, -1.0, 1.0))


def _phase(level: Scalar) -> Scalar:
    """Return the phase in [0, 1] where cos(pi t) is at a level, or nearest to it.

    The argument of arccos is 0 outside [-1, 1], because both branches of `where` are differentiated.
    """
    inside = jnp.abs(level) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, level, 0.0)) / PI, jnp.where(level < 0, 1.0, 0.0))


def _until(ahead: Scalar) -> Scalar:
    """Return a time difference modulo 2, in [0, 2); if it is 2 to rounding, return 0."""
    wait = jnp.mod(ahead, 2.0)
    return jnp.where(wait > 2 - _PAST * jnp.finfo(wait.dtype).eps, 0.0, wait)


def update_slip(
    m: OdeCarry, new: OdeCarry, trial: Trial, turns: Flag, sticking: Sticking, drive: Scalar, friction: Real
) -> OdeCarry:
    """Return the carry after a step with the new direction of sliding.

    Args:
        m, new: The carry before the step and after it.
        trial: The step.
        turns: True if the ball comes to rest at the end of the step.
        sticking: Sticking time before the step.
        drive: Acceleration without friction of a ball at rest at the end of the step.
        friction: Largest acceleration by friction, divided by the forcing's amplitude.
    """
    before = not_none(m.slip)
    released = (before == 0) & trial.passes & (trial.h >= sticking.duration)
    after = jnp.where(turns, slip_direction(drive, friction), jnp.where(released, sticking.direction, before))
    y = new.y
    if y.tangent is not None:
        # Saltation at a zero of the velocity: dv is multiplied by the ratio of the accelerations after and before it.
        # If the ball sticks, dv becomes 0.
        old_drive, new_drive = drive - friction * before, drive - friction * after
        jump = jnp.where(
            turns & (after != 0), new_drive / jnp.where(old_drive == 0, 1.0, old_drive), jnp.where(turns, 0.0, 1.0)
        )
        a, b, c, d = y.tangent
        y = SolverState(y.x, y.z, y.work, (a, b, jump * c, jump * d))
    # Just after a release the acceleration nearly vanishes. In a first step longer than FIRST_STEP, rounding would show
    # a second zero of the velocity.
    first_step = jnp.full_like(new.h, FIRST_STEP)
    return replace(
        new,
        y=y,
        slip=after,
        h=jnp.where(released, first_step, new.h),
        full=jnp.where(released, first_step, new.full),
        cut=new.cut | released,
    )
