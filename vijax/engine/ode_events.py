"""What a step of an adaptive method meets: a wall, the deepest point of a contact, or a second turning of the velocity.

The dense output of a step shows whether anything is there (`look`): the step is then tried again, up to there. What it
misses by is closed by its Taylor polynomial (`land`), so that the state at the event (`meet`) has the order of the
solver and not that of the dense output. `ode` makes the steps.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.engine.dense_output import Dense, SolverState, root
from vijax.engine.method import decided
from vijax.model.membrane import Wall
from vijax.runtime.arrays import Flag, Scalar

# The first step, in half periods of the forcing; in a contact at most 0.1/kappa. The method chooses all others: a
# longer one is refused where it is too long, a shorter one costs a few steps.
FIRST_STEP = 1e-3
LONGEST = 0.25  # longest step: the acceleration changes its sign at most once within it, but for |gamma| close to 1
_CLOSED = 1e-4  # of the repeated step: the Taylor polynomial of second order closes what is less, to 1e-13 of the step
_ATTEMPTS = 6  # repeats after which a crossing is taken as it is: rounding holds it from closing
_CREST = 2.0  # an aim that is no wall, times the way that leads there: the deepest point of a contact, a turning


class OdeCarry(eqx.Module):
    """The carry of a lane: where the ball is, the step it will try, and what its contact has seen so far."""

    y: SolverState
    t: Scalar
    n: Int[Array, ""]
    mode: Int[Array, ""]
    h: Scalar
    full: Scalar  # step to go on with after one that was cut short
    other: Scalar  # step to go on with after the next change of mode
    cut: Flag  # this step was cut short, to end at an event or before a second turning
    aim: Scalar  # the event it was cut for: a wall in the direction -1 or +1, or a turning; 0 for none
    attempts: Int[Array, ""]
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Flag  # the contact had an onset
    v_in: Scalar
    depth: Scalar
    left_t: Scalar  # when the ball left a wall last
    left_n: Int[Array, ""]
    steps: Int[Array, ""]
    slip: Scalar | None = None  # the way in which the ball slides, -1 or +1; 0: it sticks; None without friction


class Trial(eqx.Module):
    """A step that was tried: where it leads, whether its error lets it pass, and the length to try next."""

    h: Scalar
    t: Scalar
    y: SolverState
    f: SolverState
    passes: Flag
    h_next: Scalar
    dense: Dense


class Sight(eqx.Module):
    """What the dense output of a step shows: whether to try it shorter, how much, and the event it should end at."""

    seen: Flag
    theta: Scalar
    aim: Scalar


def look(dense: Dense, held: Flag, half: Scalar, deep: bool, untwisted: Flag, way: Scalar | None = None) -> Sight:
    """Find the first wall crossing of a step, the crest of a contact before it, or a second turning of the velocity.

    A velocity that changes sign between the ends turns once; the position is monotone up to there and from there on,
    so each crossing is bracketed, and of two the earlier is found. Where the acceleration changes sign (at most once,
    as a step is at most LONGEST) the velocity is extreme: if it has changed sign there and back, the step is cut at
    that place, and the next look sees one turning at a time (`untwisted`: it was cut so). With friction the ball moves
    one `way`, and every turning is an event.
    """
    one, zero = jnp.ones_like(half), jnp.zeros_like(half)
    z0, z1, bend0, bend1 = dense.c1, dense.rate(one), dense.c2, dense.bend(one)
    # From rest the ball goes where its velocity at the end of the step points, for it turns at most once within one.
    heading = jnp.where(z0 == 0, jnp.sign(z1), jnp.sign(z0)) if way is None else way
    turns = heading * z1 < 0
    turning = root(lambda s: (-heading * dense.rate(s), -heading * dense.bend(s)), zero, one)
    rising = jnp.sign(bend1)
    extreme = root(lambda s: (rising * dense.bend(s), rising * dense.jerk(s)), zero, one)
    twice = (bend0 * bend1 < 0) & ~turns & ~untwisted & (heading * dense.rate(extreme) < 0)
    # What may be met: either wall in flight, and in contact the membrane's rest from above.
    wall = jnp.where(held, 0.0, half)
    middle = jnp.where(turns, turning, one)
    first = (~held | (heading < 0)) & (heading * dense.place(middle) > wall)
    second = turns & ~first & (~held | (heading > 0)) & (-heading * dense.place(one) > wall)
    # Up to the turning the position is monotone, and so it is from there on: either part holds one crossing or none.
    aim = jnp.where(first, heading, -heading)
    low, high = jnp.where(first, 0.0, middle), jnp.where(first, middle, 1.0)
    crossing = root(lambda s: (aim * dense.place(s) - wall, aim * dense.rate(s)), low, high)
    crest = turns & held & (heading > 0) if deep else jnp.zeros_like(turns)
    if way is not None:
        crest = turns & ~first
    return Sight(
        twice | crest | first | second,
        jnp.where(twice, extreme, jnp.where(crest, turning, crossing)),
        jnp.where(twice, 0.0, jnp.where(crest, _CREST * heading, aim)),
    )


class Landing(eqx.Module):
    """Whether a step that was cut for an event has met it, how much later in time it is, and the speed there."""

    onset: Flag
    exits: Flag
    crest: Flag
    delay: Scalar
    speed: Scalar  # towards the wall at an onset, away from it at an exit


def land(m: OdeCarry, half: Scalar, trial: Trial) -> Landing:
    """Close the gap that the repeated step leaves, to second order: aim (x + z s + push s^2/2) = wall.

    The root is -2 gap/(speed + sqrt(speed^2 - 2 push gap)), and the speed there is that square root. A ball that turns
    just before the wall has none, and has not met it. Derivatives are those of the true event: the lengths of steps are
    constants to them.
    """
    held, aim = m.mode != 0, lax.stop_gradient(m.aim)
    x, z, push = trial.y.x, trial.y.z, trial.f.z
    gap, speed, drive = aim * x - jnp.where(held, 0.0, half), aim * z, aim * push
    square = speed * speed - 2 * drive * gap
    # Both sides of a `where` are differentiated: where there is no root that of 1 is taken, whose slope is finite.
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    both = speed + root
    real = ((square >= 0) | (gap > 0)) & ((root > 0) | (drive > 0))
    tops = (jnp.abs(aim) == _CREST) & (drive < 0)
    delay = jnp.where(tops, -z / jnp.where(tops, push, -1.0), -2 * gap / jnp.where(both > 0, both, jnp.inf))
    near = trial.passes & ((jnp.abs(delay) <= _CLOSED * trial.h) | (m.attempts >= _ATTEMPTS))
    met, crest = decided((near & real & (jnp.abs(aim) == 1), near & tops))
    return Landing(met & ~held, met & held, crest, jnp.where(met | crest, delay, 0.0), root)


def _ratio(change: Scalar, speed: Scalar) -> Scalar:
    """Jump of the acceleration over the speed of crossing: the one entry of a soft saltation matrix."""
    moving = speed != 0
    return jnp.where(moving, change / jnp.where(moving, speed, 1.0), 0.0)


def meet(half: Scalar, side: Scalar, wall: Wall, trial: Trial, landing: Landing) -> SolverState:
    """Find the state at the event that a step has met (at its end, if none), in coordinates of the spell after it."""
    onset, exits, crest, delay, speed = landing.onset, landing.exits, landing.crest, landing.delay, landing.speed
    y = jax.tree.map(lambda value, slope: value + delay * slope, trial.y, trial.f)
    top = y.x + 0.5 * delay * delay * trial.f.z
    x = jnp.where(onset, 0.0, jnp.where(exits, side * half, jnp.where(crest, top, y.x)))
    z = jnp.where(onset, speed, jnp.where(exits, -side * speed, jnp.where(crest, 0.0, y.z)))
    tangent = None
    if y.tangent is not None:
        a, b, c, d = y.tangent
        zero = jnp.zeros_like(speed)
        jump = jnp.where(onset, _ratio(wall(zero, speed), speed), 0.0)
        jump = jnp.where(exits, _ratio(wall(zero, -speed), speed), jump)
        tangent = (a, b, c + jump * a, d + jump * b)
    return SolverState(x, z, None if y.work is None else jnp.where(onset, 0.0, y.work), tangent)
