"""Crest of a contact: its time, its depth, and the certificate that w rises once before it and falls once after it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.fast.fast_contact_motion import (
    ContactCourse,
    ContactEntry,
    ContactState,
    Reference,
    at_reference,
    contact_state_at,
    course_at,
    higher_derivatives,
    in_reach,
)
from vijax.impact.fast.fast_walls import DEEP_REACH, LONG_REACH, MARGIN, SoftWall
from vijax.impact.impact import Lane
from vijax.impact.roots import converged_step, converges, correction, householder
from vijax.model.flow import PI
from vijax.runtime.compilation.xla import materialise, materialised

# Longest step to the crest in single precision, in units of 1/omega1, for which its Taylor polynomials hold.
_STEP = 0.15
# Tolerance of the last step to the crest, as a fraction of the tolerance of the last step to the exit. With 1/8 the
# error of the depth is at most three roundings. A larger value loses digits of the depth; a smaller one declines more
# lanes.
_CREST_STEP = 1 / 8


@materialised
def _crest_course(wall: SoftWall, entry: ContactEntry) -> ContactCourse:
    """Return the contact relative to the crest time of the free contact, the contact without forcing.

    At this time cos and sin of omega1 s are zeta/kappa and omega1/kappa.
    """
    cosine, sine = materialise((wall.zeta / wall.kappa, wall.omega1 / wall.kappa))
    return course_at(entry, Reference(wall.crest, wall.cos_crest, wall.sin_crest, cosine, sine, wall.crest_decay))


class FirstCrest(eqx.Module):
    """First zero of w', and certificates that w rises before it and falls after it."""

    s: Lane  # Time relative to the crest of the contact without forcing.
    push: Lane  # w'' at the crest.
    jerk: Lane  # w''' at the crest.
    first: Bool[Array, " lane"]  # The zero is converged, and w is certified to rise until then.
    only: Bool[Array, " lane"]  # w is certified to have no other extremum before the exit.
    highest: Bool[Array, " lane"] | None  # w is certified to stay below this height; None if it is not needed.


class _CrestPoint(eqx.Module):
    """A zero of w' in single precision: its time relative to the crest without forcing, and the state at the zero."""

    s: Lane
    w: Lane  # Penetration without the response to gravity.
    force: Lane  # Periodic part of the forcing.
    push: Lane  # w''
    jerk: Lane  # w'''
    drive: Lane  # Derivative of the forcing.
    converged: Bool[Array, " lane"]


def _certify_highest(wall: SoftWall, at: _CrestPoint) -> Bool[Array, " lane"]:
    """Certify that in a contact that gravity prolongs, w stays below its first crest, over any number of oscillations.

    A free contact is a contact without forcing; it lasts pi/omega1.

    Let S be the steady response, w - S the swing, and a the envelope of the swing at the crest; its rate there is -S'.
    Let h be the impulse response of the membrane, H its integral, and M a bound of |S''|.

    - After a time y, S has risen by at most S' y, plus M y^2/2 unless S is positive, hence concave, on the whole
      interval. The swing has changed by -S' h(y) and by -kappa^2 H(y) times its value at the crest. Both (y - h)/H and
      y^2/H increase with y. So w is below its crest for half a free contact if it is below it at the end of that time.
    - After that the swing falls until it is negative. Its next maximum is r^2 times its last one. The last one is at
      most a/(1 - c (tan f + c)), where c = zeta/omega1 and f is the phase of the swing at the crest. The next maximum
      is also below r a.
    - The maximum after the next one is smaller by another r^2, and occurs later than three free contacts after the
      crest.
    - S is at most its amplitude. If S falls at the crest, it is at most its value there. If S rises at the crest and
      still rises three free contacts later, S is until then at most its value at that time.
    """
    # Forcing a quarter period behind, from its derivative; S and S' follow from both components.
    quadrature = -at.drive * (1 / PI)
    steady = wall.gain_in * at.force + wall.gain_out * quadrature
    across = wall.gain_out * at.force - wall.gain_in * quadrature
    rate = PI * across
    swing = at.w - steady
    swing_across = (wall.zeta * swing - rate) / wall.omega1
    envelope = jnp.sqrt(swing * swing + swing_across * swing_across)
    # Bound of the further rise of the steady response S: 0 if S falls at the crest, otherwise its amplitude minus its
    # value at the crest.
    climb = jnp.where(rate > 0, jnp.sqrt(steady * steady + across * across) - steady, 0.0)
    later = steady * wall.cos_middle + across * wall.sin_middle
    concave = (steady > 0) & (later > 0)
    # M, the bound of |S''|.
    bend = jnp.where(concave, 0.0, PI**2 * (jnp.abs(wall.gain_in) + jnp.abs(wall.gain_out)))
    half, decay, tilt = materialise((0.5 * wall.span, wall.zeta / wall.omega1, jnp.abs(swing_across)))
    # Rise of S within half a free contact, minus the gain of the swing. h = sqrt(r)/omega1 at that time.
    steady_rise = jnp.maximum(rate, 0.0) * (half - wall.root_r / wall.omega1) + 0.5 * bend * half * half
    falls = (1 + MARGIN) * steady_rise < swing * (1 - decay * wall.root_r)
    slip = decay * (tilt / swing + decay)
    ratio = jnp.where(slip < 1 - wall.r, wall.r * wall.r / (1 - slip), wall.r)
    next_maximum = jnp.maximum(ratio * envelope, wall.root_r * tilt)
    # Triple-angle formulas: cos and sin of pi times three free contacts.
    cosine = wall.cos_span * (4 * wall.cos_span * wall.cos_span - 3)
    sine = wall.sin_span * (3 - 4 * wall.sin_span * wall.sin_span)
    rising = (rate > 0) & (across * cosine - steady * sine > 0) & (3 * wall.span < 1)
    soon = jnp.where(rising, steady * (cosine - 1) + across * sine, climb)
    bound = jnp.maximum(soon + next_maximum, climb + wall.r * wall.r * next_maximum)
    return falls & (swing > (1 + MARGIN) * bound)


def _rough_crest_point(
    wall: SoftWall, course: ContactCourse, hop: tuple[Bool[Array, " lane"], Lane], rounds: int
) -> _CrestPoint:
    """Return the zero of w' in single precision, by an iteration of `rounds` Householder steps.

    The iteration starts at the crest of the contact without forcing, or for a short contact at the approximate crest in
    `hop`. As for the exit in `fast_contact`, a step on the Taylor polynomial corrects the last Householder step. Taylor
    polynomials also provide the state at the crest. The returned time is 0 if an argument of the polynomials for sine
    and exponential leaves their range.
    """
    free = at_reference(wall, course)
    short, rise = hop
    s = materialise(jnp.where(short, rise - wall.crest, _toward(wall, free)))
    reached = in_reach(wall, s)
    for _ in range(rounds - 1):
        s = materialise(s + _toward(wall, materialise(contact_state_at(wall, course, jnp.where(reached, s, 0.0)))))
        reached = reached & in_reach(wall, s)
    at = materialise(contact_state_at(wall, course, jnp.where(reached, s, 0.0)))
    snap, fifth = materialise(higher_derivatives(wall, at))
    step = materialise(householder(at.rate, at.push, at.jerk, snap))
    missed = materialise(correction(step, (at.rate, at.push, at.jerk, snap, fifth)))
    step, s = materialise((step + missed, s + step + missed))
    converged = converges(step, wall.omega1, at.push, at.jerk, _STEP) & (at.push < 0)
    converged = converged & converges(missed, wall.omega1, at.push, at.jerk, MARGIN)
    reached = reached & in_reach(wall, s)
    # Rotation of the forcing by the small last step, by Taylor series.
    turn = PI * step
    sine, cosine = turn * (1 - turn * turn * (1 / 6)), 1 - 0.5 * turn * turn
    return _CrestPoint(
        jnp.where(reached, s, 0.0),
        at.w + step * (at.rate + step * (0.5 * at.push + step * (1 / 6) * at.jerk)),
        at.force * cosine + at.drive * sine * (1 / PI),
        at.push + step * (at.jerk + step * (0.5 * snap + step * (1 / 6) * fifth)),
        at.jerk + step * (snap + step * 0.5 * fifth),
        at.drive * cosine - PI * at.force * sine,
        reached & converged,
    )


def _toward(wall: SoftWall, at: ContactState) -> Lane:
    """Return the Householder step towards a zero of w'."""
    return householder(at.rate, at.push, at.jerk, higher_derivatives(wall, at)[0])


@materialised
def rough_crest(
    wall: SoftWall,
    entry: ContactEntry,
    hop: tuple[Bool[Array, " lane"], Lane],
    end: tuple[Lane, Lane, Lane],
    deep: bool,
) -> FirstCrest:
    """Return the first crest of w, and certify that it is the only extremum of w before the exit.

    The time of the crest is relative to the crest of the free contact, the contact without forcing. All values are in
    single precision; a comparison of two values closer than `MARGIN` counts as not certified.

    Args:
        wall, entry: Wall and onset in single precision.
        hop: True if the contact ends long before the free one, and the time of its crest in that case.
        end: Duration of the contact, and f' and f at the exit.
        deep: If True, the depth is needed. In the regime of strong gravity a second iteration then locates crests that
            are far from the crest of the free contact.

    w' obeys the equation of w with the forcing f', the derivative of the forcing f. Write e^(zeta s) w' = phi q, where
    phi is the solution without forcing: q rises while f' > 0 and falls while f' < 0. If f' is negative at the crest, w'
    has only this one zero until then. After the crest, -w' > 0 has no zero while f' < 0. If f' is positive at the exit,
    -w' has at most one zero, so it has none if -w' > 0 at the exit. In addition, a minimum of w needs a positive
    forcing. If these signs do not decide, the bounds `SoftWall.steep` and `SoftWall.lift` may decide. All of this holds
    while f' changes its sign at most once, that is for half a period. Without gravity the whole contact must be shorter
    than half a period.
    """
    duration, exit_drive, exit_force = end
    course = _crest_course(wall, entry)
    at = materialise(_rough_crest_point(wall, course, hop, 2 if deep and wall.steady_exit is not None else 1))
    when = wall.crest + at.s
    way = duration - when
    falls, pulled, is_brief = at.drive <= -MARGIN, at.force <= -MARGIN, duration < 1 - MARGIN
    first = falls & ((entry.force_sin >= 0) | ((entry.force > 0) & (course.force_sin >= MARGIN)))
    if entry.pressure is None:
        first = (is_brief & (first | ((entry.force <= 0) & pulled))) | (entry.speed > wall.steep)
        only = is_brief & (falls | (exit_drive > MARGIN) | (pulled & (exit_force <= -MARGIN)))
    else:
        # Gravity into the wall makes the forcing positive for more than half a period, gravity out of the wall for
        # less. If the forcing is negative at both ends of an interval shorter than half a period, it can be positive
        # inside only in the second case, and only if f' is positive at the start and negative at the end.
        inward = entry.pressure >= 0
        pulled = at.force + entry.pressure <= -MARGIN
        first_pulled = pulled & (inward | (entry.force_sin >= 0) | (at.drive >= MARGIN))
        only_pulled = pulled & inward & (exit_force + entry.pressure <= -MARGIN)
        if wall.steady_exit is not None:
            # While the forcing is into the wall and rises, w' has no zero before the free crest. Its falling zeros are
            # the time of a free contact apart, so a zero near the free crest is the first one.
            first = first | ((entry.force >= MARGIN) & (entry.force_sin <= -MARGIN) & (at.drive >= MARGIN))
        first = ((when < 1 - MARGIN) & (first | ((entry.force <= 0) & first_pulled))) | (entry.speed > wall.steep)
        only = (way < 1 - MARGIN) & (falls | (exit_drive > MARGIN) | only_pulled)
    # While the periodic part of the forcing is positive, f' falls, so f' at the crest bounds it.
    positive = (at.force > MARGIN) & (exit_force > MARGIN) & is_brief
    if entry.pressure is not None:
        # Once f' is negative it stays negative for half a period.
        positive = (at.force > MARGIN) & ((exit_force > MARGIN) | (exit_drive < -MARGIN)) & (way < 1 - MARGIN)
    most = jnp.where(positive, jnp.maximum(at.drive, 0.0) + MARGIN, PI)
    only = only | ((-at.push > most * wall.lift) & (wall.omega1 * way < DEEP_REACH))
    if wall.long_lift is not None:
        only = only | ((-at.push > most * wall.long_lift) & (wall.omega1 * way < LONG_REACH))
    if entry.pressure is not None:
        # A forcing that is never positive allows no minimum of w.
        outwards = entry.pressure < -1
        first, only = first | outwards, only | outwards
    inside = (wall.omega1 * way > MARGIN) & (way < (1 - MARGIN) * wall.span)
    highest = _certify_highest(wall, at) if deep and wall.steady_exit is not None else None
    first = at.converged & first & (wall.omega1 * when > MARGIN)
    return FirstCrest(at.s, at.push, at.jerk, first, only & inside, highest)


def deepest(wall: SoftWall, entry: ContactEntry, crest: FirstCrest) -> tuple[Lane, Bool[Array, " lane"]]:
    """Return the largest depth, and whether the crest in single precision was close enough for full precision.

    Because w' = 0 at the crest, w + h w'/2 with Newton's step h to the crest has an error of order h^3 only.
    """
    at = contact_state_at(wall, _crest_course(wall, entry), crest.s.astype(entry.speed.dtype))
    # Only these two values are stored: each stored value costs a pass over memory.
    depth, rate = materialise((entry.penetration(at), at.rate))
    step = materialise(-rate.astype(crest.push.dtype) / crest.push)
    close = _CREST_STEP * converged_step(jnp.finfo(depth.dtype).eps)
    near = converges(step, wall.omega1.astype(step.dtype), crest.push, crest.jerk, close)
    return depth + 0.5 * step.astype(depth.dtype) * rate, near
