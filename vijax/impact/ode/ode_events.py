"""Events of an adaptive step: a wall crossing, the deepest point of a contact, or a second zero of the velocity.

An event is detected on the dense output of a step (`detect_event`), and the step is tried again with its end near the
event. The Taylor polynomial at the new end closes the remaining distance (`locate_event`), so the state at the event
(`state_at_event`) has the order of the solver, not the order of the dense output. `ode` takes the steps.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.impact.method import save_decision
from vijax.impact.ode.dense_output import DenseOutput, SolverState, increasing_root
from vijax.model.walls.membrane import Wall
from vijax.runtime.arrays import Flag, Scalar

# First step, in half periods of the forcing; in a contact at most 0.1/kappa. The method chooses all later steps. A
# first step that is too long is rejected; one that is too short costs a few steps.
FIRST_STEP = 1e-3
# Longest step, in half periods: the forcing with gravity changes its sign at most once within it, except for |gamma|
# close to 1.
LONGEST = 0.25
# Longest time to an event, as a fraction of the repeated step, that the second-order Taylor polynomial closes. The
# error of the event is then 1e-13 of the step.
_CLOSED = 1e-4
_ATTEMPTS = 6  # After this number of attempts the end of the step counts as the event: rounding prevents progress.
# |aim| for a zero of the velocity, for example the deepest point of a contact. The sign of the aim is the sign of the
# velocity before the zero.
_CREST = 2.0


class OdeCarry(eqx.Module):
    """Carry of a lane: state and time of the ball, the next step, and the data of the present contact."""

    y: SolverState
    t: Scalar
    n: Int[Array, ""]
    mode: Int[Array, ""]
    h: Scalar
    full: Scalar  # length of the step after a step that was cut short
    other: Scalar  # length of the first step after the next change of mode
    cut: Flag  # the next step is cut short, to end at an event or between two zeros of the velocity
    aim: Scalar  # target of the cut: a wall (direction -1 or +1), or a zero of the velocity; 0 for none
    attempts: Int[Array, ""]
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Flag  # the contact has an onset within the run
    v_in: Scalar
    depth: Scalar
    exit_t: Scalar  # time of the last exit
    exit_n: Int[Array, ""]
    steps: Int[Array, ""]
    slip: Scalar | None = None  # direction of sliding, -1 or +1; 0: the ball sticks; None without friction


class Trial(eqx.Module):
    """A step that was tried: its end, whether its error is accepted, the next length, and its dense output."""

    h: Scalar
    t: Scalar
    y: SolverState
    f: SolverState
    passes: Flag
    h_next: Scalar
    dense: DenseOutput


class EventCandidate(eqx.Module):
    """Event that the dense output of a step detects: whether there is one, its theta, and its kind (`aim`)."""

    detected: Flag
    theta: Scalar
    aim: Scalar


def detect_event(
    dense: DenseOutput, in_contact: Flag, half: Scalar, deep: bool, untwisted: Flag, direction: Scalar | None = None
) -> EventCandidate:
    """Detect the first event of a step: a wall crossing, a crest of a contact, or a second zero of the velocity.

    If the velocity changes sign between the ends of the step, it has one zero. The position is monotone before and
    after this zero, so each crossing has a bracket, and the earlier crossing counts. Where the acceleration changes
    sign (at most once, because a step is at most LONGEST) the velocity has an extremum. If the velocity changes sign
    before the extremum and again after it, the step is cut at the extremum, so that each of the two steps has one zero
    of the velocity. `untwisted` is True for a step that was cut in this way. With friction the ball moves in one
    `direction`, and every zero of the velocity is an event.
    """
    unit, zero = jnp.ones_like(half), jnp.zeros_like(half)
    z0, z1, bend0, bend1 = dense.c1, dense.slope(unit), dense.c2, dense.curvature(unit)
    # From rest the ball moves in the direction of its velocity at the end of the step, since it turns at most once.
    heading = jnp.where(z0 == 0, jnp.sign(z1), jnp.sign(z0)) if direction is None else direction
    turns = heading * z1 < 0
    turning = increasing_root(lambda s: (-heading * dense.slope(s), -heading * dense.curvature(s)), zero, unit)
    rising = jnp.sign(bend1)
    extreme = increasing_root(lambda s: (rising * dense.curvature(s), rising * dense.third_derivative(s)), zero, unit)
    twice = (bend0 * bend1 < 0) & ~turns & ~untwisted & (heading * dense.slope(extreme) < 0)
    # Possible crossings: either wall in flight; in contact the surface w = 0, from above.
    surface = jnp.where(in_contact, 0.0, half)
    turn_theta = jnp.where(turns, turning, unit)
    first = (~in_contact | (heading < 0)) & (heading * dense.position(turn_theta) > surface)
    second = turns & ~first & (~in_contact | (heading > 0)) & (-heading * dense.position(unit) > surface)
    # Before the zero of the velocity the ball moves along `heading`, after it against `heading`. The position is
    # monotone on each of these two parts of the step, so each part holds at most one crossing.
    aim = jnp.where(first, heading, -heading)
    low, high = jnp.where(first, 0.0, turn_theta), jnp.where(first, turn_theta, 1.0)
    crossing = increasing_root(lambda s: (aim * dense.position(s) - surface, aim * dense.slope(s)), low, high)
    crest = turns & in_contact & (heading > 0) if deep else jnp.zeros_like(turns)
    if direction is not None:
        crest = turns & ~first
    return EventCandidate(
        twice | crest | first | second,
        jnp.where(twice, extreme, jnp.where(crest, turning, crossing)),
        jnp.where(twice, 0.0, jnp.where(crest, _CREST * heading, aim)),
    )


class EventHit(eqx.Module):
    """Event at the end of a step that was cut for it: its kind, its delay after the step, and the speed there."""

    onset: Flag
    exits: Flag
    crest: Flag
    delay: Scalar
    speed: Scalar  # Towards the wall at an onset, away from it at an exit.


def locate_event(m: OdeCarry, half: Scalar, trial: Trial) -> EventHit:
    """Locate the event after the end of the repeated step, to second order: aim (x + z s + push s^2/2) = wall.

    The residual r is the signed distance beyond the wall at the end of the step. The root is
    -2 r/(speed + sqrt(speed^2 - 2 push r)), and the speed there is the square root. If the ball turns just before the
    wall, there is no root and no event. Step lengths count as constants, so the derivatives are correct for the event.
    """
    in_contact, aim = m.mode != 0, lax.stop_gradient(m.aim)
    x, z, push = trial.y.x, trial.y.z, trial.f.z
    residual, speed, drive = aim * x - jnp.where(in_contact, 0.0, half), aim * z, aim * push
    square = speed * speed - 2 * drive * residual
    # Both branches of `where` are differentiated: where there is no root, the square root of 1 replaces it, because its
    # slope is finite.
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    denominator = speed + root
    has_root = ((square >= 0) | (residual > 0)) & ((root > 0) | (drive > 0))
    is_crest = (jnp.abs(aim) == _CREST) & (drive < 0)
    delay = jnp.where(
        is_crest, -z / jnp.where(is_crest, push, -1.0), -2 * residual / jnp.where(denominator > 0, denominator, jnp.inf)
    )
    near = trial.passes & ((jnp.abs(delay) <= _CLOSED * trial.h) | (m.attempts >= _ATTEMPTS))
    at_wall, crest = save_decision((near & has_root & (jnp.abs(aim) == 1), near & is_crest))
    return EventHit(at_wall & ~in_contact, at_wall & in_contact, crest, jnp.where(at_wall | crest, delay, 0.0), root)


def _ratio(change: Scalar, speed: Scalar) -> Scalar:
    """Return the jump of the acceleration divided by the speed of the crossing: the lower left saltation entry."""
    moving = speed != 0
    return jnp.where(moving, change / jnp.where(moving, speed, 1.0), 0.0)


def state_at_event(half: Scalar, side: Scalar, wall: Wall, trial: Trial, hit: EventHit) -> SolverState:
    """Return the state at the event of a step (at its end if there is none).

    Its coordinates belong to the motion after the event: penetration after an onset, displacement after an exit.
    """
    onset, exits, crest, delay, speed = hit.onset, hit.exits, hit.crest, hit.delay, hit.speed
    # First-order extrapolation over the delay. The position at a crest has a term of second order, and on a wall
    # position and velocity are set exactly.
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
