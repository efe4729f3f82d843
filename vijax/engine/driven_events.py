"""What a step of a driven motion meets: nothing for certain, or exactly one event, which further steps close in on.

An event is where something falls through 0: the gap to a wall in flight, the penetration at an exit, its rate at the
deepest point of a contact. `taylor` says what is certain of a step, `driven` makes the steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from vijax.engine import taylor
from vijax.engine.forcing import Draws
from vijax.engine.roots import converged_step, householder, implicit_root
from vijax.engine.taylor import Rates
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.xla import share

# An event that steps close in on: none, the wall on a side (its sign), the exit, the deepest point of a contact.
NONE, EXIT, CREST = 0.0, 2.0, 3.0
# Share of the time between two knots: what is shorter is where rounding holds an event from being certain, and is taken
# as it comes.
_SHORTEST = 1e-13
# Roundings of a penetration within which a ball has come to rest.
_ROUNDING = 64


class DrivenCarry(eqx.Module):
    """The carry of a lane: where the ball is and when, the event it closes in on, what its contact has seen."""

    x: Scalar  # displacement in flight, penetration in contact
    z: Scalar  # its rate
    k: Scalar  # knots passed since the start of period 0
    s: Scalar  # time since the last one
    n: Int[Array, ""]
    mode: Int[Array, ""]
    trial: Scalar  # length of the next step, at most
    event: Scalar
    bracket: Scalar  # time within which the event lies
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Flag
    v_in: Scalar
    depth: Scalar
    work: Scalar | None
    left_t: Scalar
    left_n: Int[Array, ""]
    tangent: tuple[Scalar, ...] | None
    draws: "Draws | None"
    steps: Int[Array, ""]


class Ahead(NamedTuple):
    """What is certain of a step: nothing happens on it, or exactly the one event does."""

    clear: Flag
    event: Scalar


def look(held: Flag, sprung: Flag, deep: bool, half: Scalar, most: Scalar, now: Rates, end: Rates, s: Scalar) -> Ahead:
    """Tell what is certain of the next s, where nothing is being closed in on; `most` bounds the fourth derivative.

    Of a ball that is held, but not `sprung` by a membrane, what falls to 0 at its exit is not a penetration.
    """
    # What may come down to 0: the gaps to both walls in flight, the penetration in contact. A ball that flies back from
    # a little beyond a wall, where a search has put it, is on the wall.
    room, room_left = half - now.x, half + now.x
    gap = jnp.where(now.z < 0, jnp.maximum(room, 0.0), room), -now.z, -now.a, -now.j
    first: Any = share(tuple(jnp.where(held, f, g) for f, g in zip(now, gap, strict=False)))
    left = jnp.where(now.z > 0, jnp.maximum(room_left, 0.0), room_left), now.z, now.a, now.j
    open_first, open_left = taylor.above(first, most, s), held | taylor.above(left, most, s)
    open_first, open_left, falls = share((open_first, open_left, taylor.falling(first[1:], most, s)))
    # A gap that falls all the way makes the other one grow.
    closes = falls & (jnp.where(held, end.x, half - end.x) <= 0)
    closes_left = ~held & taylor.falling(left[1:], most, s) & (half + end.x <= 0)
    event = jnp.where(closes, jnp.where(held, EXIT, 1.0), jnp.where(closes_left, -1.0, NONE))
    clear = open_first & open_left
    if deep:
        # A contact's deepest point is stopped at: w' must keep its sign, or fall from above 0 to below it.
        slows = taylor.steady_sign((now.a, now.j), most, s)
        rises = taylor.falling((-now.z, -now.a, -now.j), most, s)
        # Of a ball that has come to rest inside all but rounding is gone, of which nothing is certain.
        moves = s * (jnp.abs(now.z) + s * (jnp.abs(now.a) + s * (jnp.abs(now.j) + s * most)))
        rests = moves < _ROUNDING * jnp.finfo(s.dtype).eps * now.x
        crest = sprung & clear & slows & ~rests & (now.z > 0) & (end.z <= 0)
        clear = clear & (~sprung | slows | rises | falls | rests) & ~crest
        event = jnp.where(crest, CREST, event)
    return Ahead(clear, event)


class Decision(NamedTuple):
    """What a step does, its event and its lengths.

    Attributes:
        goes: It moves the ball; else it is tried again, shorter.
        lands: It ends at the event, `delay` after its end.
    """

    goes: Flag
    lands: Flag
    event: Scalar
    delay: Scalar
    trial: Scalar
    bracket: Scalar


def residual(event: Scalar, half: Scalar, end: Rates) -> tuple[Scalar, ...]:
    """Give what falls through 0 at the event, and its derivatives, at the end of a step."""
    zero = jnp.zeros_like(end.x)
    toward = jnp.where(event == EXIT, 1.0, -event)
    wall = (jnp.where(event == EXIT, 0.0, half) + toward * end.x, *(toward * f for f in end[1:]))
    crest = (end.z, end.a, end.j, end.snap, zero)
    return tuple(jnp.where(event == CREST, f, g) for f, g in zip(crest, wall, strict=True))


def choose(
    m: DrivenCarry, half: Scalar, kappa: Scalar, ahead: Ahead, end: Rates, f: tuple[Scalar, ...], s: Scalar, gap: Values
) -> Decision:
    """Decide what becomes of a step.

    Args:
        m: The carry before it.
        half: Half of the gap.
        kappa: Of the membrane that the ball is in; 0 in flight.
        ahead: What is certain; of a lane that closes in, the event that it closes in on.
        end, f: Where the step ends, and the `residual` there.
        s, gap: Its length, and the time between two knots.
    """
    eps = jnp.finfo(s.dtype).eps
    closing = m.event != NONE
    event, within = ahead.event, jnp.where(closing, m.bracket, s)
    short = s < _SHORTEST * gap
    known = event != NONE
    ahead_of = f[0] > 0
    toward = share(householder(*f[:4]))
    step, small = jnp.abs(toward), converged_step(eps)
    near = (step * jnp.abs(f[2]) < small * jnp.abs(f[1])) & (step * jnp.maximum(kappa, 1.0) < small)
    near = near & (s + toward > 0)
    # A bracket that rounding does not let close any more ends where it is.
    worn = known & (within < 4 * eps * gap)
    lands = known & (near | worn)
    delay = jnp.where(lands & near, toward, 0.0)
    # Of a piece too short for any certainty the end tells: outside the ball has arrived, inside it goes on.
    forced = ~known & short
    out = _outside(m, half, end)
    lands = lands | (forced & (out != NONE))
    event = jnp.where(forced, out, event)
    lands, event = share((lands, event))
    goes = lands | (ahead.clear & ~closing) | (forced & ~lands) | (known & ahead_of & ~lands)
    left = jnp.where(ahead_of, within - s, s)
    guess = jnp.where(ahead_of, toward, s + toward)
    inside = (guess > 0) & (guess < left)
    next_try = jnp.where(inside, guess, 0.5 * left)
    trial = jnp.where(known & ~lands, next_try, jnp.where(lands, jnp.inf, jnp.where(goes, 2 * s, 0.5 * s)))
    return Decision(goes, lands, event, delay, trial, jnp.where(known & ~lands, left, 0.0))


def _outside(m: DrivenCarry, half: Scalar, end: Rates) -> Scalar:
    """Say which event the end of a step lies beyond, by its sign alone."""
    flown = jnp.where(end.x >= half, 1.0, jnp.where(end.x <= -half, -1.0, NONE))
    return jnp.where(m.mode != 0, jnp.where(end.x <= 0, EXIT, NONE), flown)


class StepEnd(NamedTuple):
    """Where a step ends, an event at its end included.

    Attributes:
        there: Displacement and derivatives, as the motion before sees them.
        x, z: Displacement and velocity as the motion after sees them: exactly on the wall, or at rest at a crest.
        length: Of the step, its delay included.
        crossed, exits, crest: Which event it was.
        toward: The wall that was met, by its sign.
    """

    there: Rates
    x: Scalar
    z: Scalar
    length: Scalar
    delay: Scalar
    crossed: Flag
    exits: Flag
    crest: Flag
    toward: Scalar


def land(choice: Decision, half: Scalar, side: Scalar, s: Scalar, end: Rates, f: tuple[Scalar, ...]) -> StepEnd:
    """End a step: where it is, or at the event `delay` later. The time of an event is a function of where that is."""
    usable = choice.lands & (f[1] != 0)
    safe = (f[0], jnp.where(usable, f[1], -1.0), *f[2:])
    delay = jnp.where(usable, implicit_root(lambda s, of: taylor.closed(of, s), choice.delay, safe), choice.delay)
    there = end.after(jnp.where(choice.lands, delay, 0.0))
    crossed, exits = choice.lands & (jnp.abs(choice.event) == 1), choice.lands & (choice.event == EXIT)
    crest = choice.lands & (choice.event == CREST)
    toward = jnp.where(choice.event < 0, -1.0, 1.0).astype(half.dtype)
    x = jnp.where(crossed, 0.0, jnp.where(exits, side * half, there.x))
    z = jnp.where(crossed, toward * there.z, jnp.where(exits, side * there.z, jnp.where(crest, 0.0, there.z)))
    return StepEnd(there, x, z, s + delay, delay, crossed, exits, crest, toward)
