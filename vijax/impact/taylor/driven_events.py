"""Events of a driven motion: a step is certified free of events, or certified to hold exactly one event.

An event is the zero of a residual that falls through 0: the clearance to a wall in flight, the penetration at an exit,
or the rate of the penetration at the deepest point of a contact. `taylor` provides the bounds, this module decides
whether a step is accepted, and `driven` takes the steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from vijax.impact.forcing import Draws
from vijax.impact.roots import converged_step, householder, implicit_root
from vijax.impact.taylor import taylor
from vijax.impact.taylor.taylor import Rates
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.compilation.xla import materialise

# Code of the event that a lane approaches: none, the exit, or the deepest point of a contact. The code of a wall
# crossing is the side of the wall, -1 or +1.
NONE, EXIT, CREST = 0.0, 2.0, 3.0
# Fraction of the knot spacing. On a step shorter than this, rounding prevents a certificate, and the signs of the
# clearances (or of the penetration) at the end of the step decide.
_SHORTEST = 1e-13
# A ball that moves by less than this number of roundings of its penetration is at rest.
_ROUNDING = 64


class DrivenCarry(eqx.Module):
    """Carry of a lane: state and time of the ball, the event that it approaches, data of the present contact."""

    x: Scalar  # Displacement in flight, penetration in contact.
    z: Scalar  # Time derivative of x.
    k: Scalar  # Knots passed since the start of period 0.
    s: Scalar  # Time since the last knot.
    n: Int[Array, ""]
    mode: Int[Array, ""]
    trial: Scalar  # Upper bound of the length of the next step.
    event: Scalar
    bracket: Scalar  # The event lies within this time.
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Flag
    v_in: Scalar
    depth: Scalar
    work: Scalar | None
    exit_t: Scalar
    exit_n: Int[Array, ""]
    tangent: tuple[Scalar, ...] | None
    draws: "Draws | None"
    steps: Int[Array, ""]


class StepCertificate(NamedTuple):
    """Certificate of a step: `clear` if it holds no event, otherwise the code of its only event.

    If neither is certified, `clear` is False and `event` is `NONE`.
    """

    clear: Flag
    event: Scalar


def certify_step(
    in_contact: Flag, in_membrane: Flag, deep: bool, half: Scalar, most: Scalar, now: Rates, end: Rates, s: Scalar
) -> StepCertificate:
    """Return the certificate of a step of length s for a lane that approaches no event yet.

    `most` bounds the fourth derivative of the displacement on the step. For a ball stuck on a rigid wall (`in_contact`
    but not `in_membrane`) the states hold the force into the wall, which falls to 0 at the exit, not a penetration.
    """
    # Quantities that may fall to 0: the clearances to both walls in flight, the penetration in contact. If an event
    # search has left the ball slightly beyond a wall and it moves away from the wall, its clearance counts as 0.
    clearance_right, clearance_left = half - now.x, half + now.x
    approach = jnp.where(now.z < 0, jnp.maximum(clearance_right, 0.0), clearance_right), -now.z, -now.a, -now.j
    first: Any = materialise(tuple(jnp.where(in_contact, f, g) for f, g in zip(now, approach, strict=False)))
    second = jnp.where(now.z > 0, jnp.maximum(clearance_left, 0.0), clearance_left), now.z, now.a, now.j
    first_positive, second_positive = (
        taylor.certify_positive(first, most, s),
        in_contact | taylor.certify_positive(second, most, s),
    )
    first_positive, second_positive, falls = materialise(
        (first_positive, second_positive, taylor.certify_negative(first[1:], most, s))
    )
    # If one clearance falls on the whole step, the other one grows, so at most one of them closes.
    closes = falls & (jnp.where(in_contact, end.x, half - end.x) <= 0)
    closes_second = ~in_contact & taylor.certify_negative(second[1:], most, s) & (half + end.x <= 0)
    event = jnp.where(closes, jnp.where(in_contact, EXIT, 1.0), jnp.where(closes_second, -1.0, NONE))
    clear = first_positive & second_positive
    if deep:
        # The deepest point of a contact is an event. On a certified step w' keeps its sign, or falls from positive to
        # negative once.
        slows = taylor.certify_constant_sign((now.a, now.j), most, s)
        rises = taylor.certify_negative((-now.z, -now.a, -now.j), most, s)
        # For a ball at rest inside the membrane only rounding remains, and no certificate is possible.
        moves = s * (jnp.abs(now.z) + s * (jnp.abs(now.a) + s * (jnp.abs(now.j) + s * most)))
        rests = moves < _ROUNDING * jnp.finfo(s.dtype).eps * now.x
        crest = in_membrane & clear & slows & ~rests & (now.z > 0) & (end.z <= 0)
        clear = clear & (~in_membrane | slows | rises | falls | rests) & ~crest
        event = jnp.where(crest, CREST, event)
    return StepCertificate(clear, event)


class Decision(NamedTuple):
    """Decision on a step: whether it is accepted, its event, and the next lengths.

    Attributes:
        accepted: The step moves the ball; otherwise it is tried again with a shorter length.
        reaches_event: The step ends at the event, `delay` after its own end.
        event: The event that the lane approaches; `NONE` without one.
        delay: Time from the end of the step to the event.
        trial: Upper bound of the length of the next step.
        bracket: The event lies within this time after the step; 0 without an event.
    """

    accepted: Flag
    reaches_event: Flag
    event: Scalar
    delay: Scalar
    trial: Scalar
    bracket: Scalar


def residual(event: Scalar, half: Scalar, end: Rates) -> tuple[Scalar, ...]:
    """Return the residual of an event and its first four derivatives at the end of a step."""
    zero = jnp.zeros_like(end.x)
    toward = jnp.where(event == EXIT, 1.0, -event)
    # The clearance is half - side x, so toward = -side. At an exit the residual is the penetration.
    wall = (jnp.where(event == EXIT, 0.0, half) + toward * end.x, *(toward * f for f in end[1:]))
    crest = (end.z, end.a, end.j, end.snap, zero)
    return tuple(jnp.where(event == CREST, f, g) for f, g in zip(crest, wall, strict=True))


def decide_step(
    m: DrivenCarry,
    half: Scalar,
    kappa: Scalar,
    certificate: StepCertificate,
    end: Rates,
    f: tuple[Scalar, ...],
    s: Scalar,
    knot_spacing: Values,
) -> Decision:
    """Decide a step.

    Args:
        m: Carry before the step.
        half: Half of the gap, d/2.
        kappa: Stiffness of the membrane that the ball is in; 0 in flight.
        certificate: Certificate of the step. If the lane already approaches an event, its `event` is that event.
        end, f: State at the end of the step, and the `residual` there.
        s, knot_spacing: Length of the step, and time between two knots.
    """
    eps = jnp.finfo(s.dtype).eps
    closing = m.event != NONE
    event, within = certificate.event, jnp.where(closing, m.bracket, s)
    short = s < _SHORTEST * knot_spacing
    has_event = event != NONE
    before_zero = f[0] > 0
    toward = materialise(householder(*f[:4]))
    step, small = jnp.abs(toward), converged_step(eps)
    # The Householder step converges if it is small beside the residual's curvature and beside the time scale 1/kappa.
    near = (step * jnp.abs(f[2]) < small * jnp.abs(f[1])) & (step * jnp.maximum(kappa, 1.0) < small)
    near = near & (s + toward > 0)
    # If rounding prevents a bracket from closing further, its end counts as the event.
    bracket_exhausted = has_event & (within < 4 * eps * knot_spacing)
    reaches_event = has_event & (near | bracket_exhausted)
    delay = jnp.where(reaches_event & near, toward, 0.0)
    # On a step too short for a certificate the signs at its end decide: if the end lies beyond an event, the event is
    # placed at the end of the step; otherwise the motion continues.
    forced = ~has_event & short
    end_event = _outside(m, half, end)
    reaches_event = reaches_event | (forced & (end_event != NONE))
    event = jnp.where(forced, end_event, event)
    reaches_event, event = materialise((reaches_event, event))
    accepted = (
        reaches_event
        | (certificate.clear & ~closing)
        | (forced & ~reaches_event)
        | (has_event & before_zero & ~reaches_event)
    )
    # The residual is positive before the event. Its sign at the end of the step halves the bracket.
    remaining = jnp.where(before_zero, within - s, s)
    guess = jnp.where(before_zero, toward, s + toward)
    inside = (guess > 0) & (guess < remaining)
    next_try = jnp.where(inside, guess, 0.5 * remaining)
    trial = jnp.where(
        has_event & ~reaches_event, next_try, jnp.where(reaches_event, jnp.inf, jnp.where(accepted, 2 * s, 0.5 * s))
    )
    return Decision(accepted, reaches_event, event, delay, trial, jnp.where(has_event & ~reaches_event, remaining, 0.0))


def _outside(m: DrivenCarry, half: Scalar, end: Rates) -> Scalar:
    """Return the event that has passed at the end of a step, from signs at the end alone; `NONE` without one."""
    flight_event = jnp.where(end.x >= half, 1.0, jnp.where(end.x <= -half, -1.0, NONE))
    return jnp.where(m.mode != 0, jnp.where(end.x <= 0, EXIT, NONE), flight_event)


class StepEnd(NamedTuple):
    """End of a step, including an event at the end.

    Attributes:
        before_event: Displacement and derivatives in the coordinates of the motion before the event.
        x, z: Displacement and velocity in the coordinates after the event: exactly on the wall, or at rest at a crest.
        length: Length of the step including its delay.
        delay: Time from the end of the step to the event.
        onset, exits, crest: Kind of the event.
        toward: Side of the wall that was reached, -1 or +1.
    """

    before_event: Rates
    x: Scalar
    z: Scalar
    length: Scalar
    delay: Scalar
    onset: Flag
    exits: Flag
    crest: Flag
    toward: Scalar


def end_step(decision: Decision, half: Scalar, side: Scalar, s: Scalar, end: Rates, f: tuple[Scalar, ...]) -> StepEnd:
    """End a step at its own end, or at the event `delay` later.

    Derivatives include the dependence of the event time on the state, by the implicit function theorem.
    """
    # At a grazing the slope is 0 and the implicit derivative is infinite; the delay then counts as a constant.
    usable = decision.reaches_event & (f[1] != 0)
    safe = (f[0], jnp.where(usable, f[1], -1.0), *f[2:])
    delay = jnp.where(
        usable, implicit_root(lambda s, of: taylor.residual_at(of, s), decision.delay, safe), decision.delay
    )
    before_event = end.after(jnp.where(decision.reaches_event, delay, 0.0))
    onset, exits = (
        decision.reaches_event & (jnp.abs(decision.event) == 1),
        decision.reaches_event & (decision.event == EXIT),
    )
    crest = decision.reaches_event & (decision.event == CREST)
    toward = jnp.where(decision.event < 0, -1.0, 1.0).astype(half.dtype)
    x = jnp.where(onset, 0.0, jnp.where(exits, side * half, before_event.x))
    z = jnp.where(
        onset, toward * before_event.z, jnp.where(exits, side * before_event.z, jnp.where(crest, 0.0, before_event.z))
    )
    return StepEnd(before_event, x, z, s + delay, delay, onset, exits, crest, toward)
