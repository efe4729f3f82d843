"""Dry friction along the capsule: which way the ball slides, when it sticks, and when it is torn loose.

Coulomb's law, as an acceleration over the forcing's amplitude: the capsule holds a ball at rest while what drives it is
no more than the friction, and brakes one that slides by all of it, as gravity would that turns with the motion. `ode`
stops a ball at every turning, to see whether it goes back, goes on, or sticks. While it sticks time is all that passes,
so that when it is torn loose has a closed form.

Source: Coulomb; the device with friction: Athanasouli, Yurchenko, Kuske, arXiv 2502.12288.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp

from vijax.engine.dense_output import SolverState
from vijax.engine.ode_events import FIRST_STEP, OdeCarry, Trial
from vijax.model.flow import PI
from vijax.model.pair import Real
from vijax.runtime.arrays import Flag, Scalar, present


class Grip(NamedTuple):
    """The grip of the capsule on a ball that sticks: how long it holds, and which way the ball slides then."""

    wait: Scalar
    way: Scalar


_PAST = 16  # roundings by which the moment of release may seem to be over when a ball comes to rest at it


def onward(drive: Scalar, friction: Real) -> Scalar:
    """Say which way a ball at rest begins to slide; 0 if it sticks.

    Args:
        drive: What accelerates it but for friction, in the direction of the displacement.
        friction: The friction.
    """
    return jnp.where(jnp.abs(drive) <= friction, 0.0, jnp.sign(drive))


def grip(t: Scalar, push: Scalar, friction: Scalar) -> Grip:
    """Say how long a ball at rest sticks, inf if it does for ever, and which way it slides then.

    The drive is cos(pi t) + push: friction cannot hold it where the cosine is below one level, or above another.

    Args:
        t: The phase, in [0, 2].
        push: What does not change while it sticks: gravity, and the membrane.
        friction: The friction.
    """
    low, high = -friction - push, friction - push
    fall = jnp.where(low > -1, _until(_phase(low) - t), jnp.inf)
    rise = jnp.where(high < 1, _until(2 - _phase(high) - t), jnp.inf)
    return Grip(jnp.minimum(fall, rise), jnp.where(fall <= rise, -1.0, 1.0))


def _phase(level: Scalar) -> Scalar:
    """Find where in [0, 1] cos(pi t) is at a level, or nearest to it; both sides of a `where` are differentiated."""
    inside = jnp.abs(level) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, level, 0.0)) / PI, jnp.where(level < 0, 1.0, 0.0))


def _until(ahead: Scalar) -> Scalar:
    """Bring a time to a phase into [0, 2), one that rounding has past to 0."""
    wait = jnp.mod(ahead, 2.0)
    return jnp.where(wait > 2 - _PAST * jnp.finfo(wait.dtype).eps, 0.0, wait)


def rubbed(
    m: OdeCarry, new: OdeCarry, trial: Trial, turns: Flag, grasp: Grip, drive: Scalar, friction: Real
) -> OdeCarry:
    """Give a carry after a step the way in which its ball slides then.

    Args:
        m, new: The carry before the step and after it.
        trial: The step.
        turns: Whether the ball has come to rest at its end.
        grasp: The grip before it.
        drive: What accelerates a ball at rest at the end of the step, but for friction.
        friction: The friction.
    """
    before = present(m.slip)
    torn = (before == 0) & trial.passes & (trial.h >= grasp.wait)
    after = jnp.where(turns, onward(drive, friction), jnp.where(torn, grasp.way, before))
    y = new.y
    if y.tangent is not None:
        # The saltation of a turning: a ball that sticks forgets how fast its neighbour is.
        old, gone = drive - friction * before, drive - friction * after
        jump = jnp.where(turns & (after != 0), gone / jnp.where(old == 0, 1.0, old), jnp.where(turns, 0.0, 1.0))
        a, b, c, d = y.tangent
        y = SolverState(y.x, y.z, y.work, (a, b, jump * c, jump * d))
    # One that is torn loose is hardly driven at first: a second turning within its step would be rounding.
    first = jnp.full_like(new.h, FIRST_STEP)
    return replace(
        new,
        y=y,
        slip=after,
        h=jnp.where(torn, first, new.h),
        full=jnp.where(torn, first, new.full),
        cut=new.cut | torn,
    )
