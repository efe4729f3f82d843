"""Robust search for the end and the turning points of a contact with a linear membrane.

A contact is the forced oscillator w'' + mu w' + kappa^2 w = f(s), where s is the time since the onset, w the
penetration, z = w', and f(s) = c cos(pi s) - q sin(pi s) - g the forcing into the wall (`flow.Force`). The contact ends
at the first zero of w > 0. Each stage of the search either certifies an interval without a zero or brackets exactly one
zero, so no early exit is missed (see `first_return` for the argument).
"""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vijax.impact.roots import bracketed_root
from vijax.impact.sign_intervals import SignInterval, event_tolerance, sign_interval_after
from vijax.model import flow
from vijax.model.flow import PI, Force, Membrane
from vijax.runtime.arrays import Flag, Scalar
from vijax.runtime.compilation.xla import materialise, reuse_trace, short_while_loop

_NEWTON_LIMIT = 2.0**-30  # Relative length of a stage below which one further Newton step gives the root to rounding.
# Limit of the stages of one contact; a stage is about half a cycle of the unforced membrane. Only contacts at r = 1
# come near this limit.
MAX_STAGES = 20_000


class _Oscillator(NamedTuple):
    """Forced oscillator of a contact: membrane, forcing, its steady response, and the state (w0, z0) at time 0."""

    m: Membrane
    force: Force
    steady: Force
    w0: Scalar
    z0: Scalar

    def at(self, s: Scalar) -> tuple[Scalar, Scalar]:
        """Return w and w' at time s."""
        return flow.oscillate(self.m, self.force, self.w0, self.z0, s)


class _Search(eqx.Module):
    """State of the search for the first zero of w > 0.

    While the search runs, there is no zero on (0, s], and (w, z) is the state at s. After the end of
    the search, the zero lies in [s, high] if `bracketed`; otherwise s is the zero, or inf if there is none.
    """

    s: Scalar
    w: Scalar
    z: Scalar
    high: Scalar
    interval: SignInterval
    running: Flag
    bracketed: Flag
    stage: Array


def _free_end(m: Membrane, w: Scalar, z: Scalar) -> Scalar:
    """Return the time after which the unforced oscillator at (w, z) returns to zero, at most half a free cycle.

    If rounding makes w negative at a root, w counts as zero. Otherwise the result would belong to the next cycle.
    """
    w = jnp.maximum(w, 0.0)
    # The free solution is a e^(-zeta s) sin(omega1 s + p) with tan p = omega1 w/(z + zeta w); it is zero at omega1 s =
    # pi - p.
    return (PI - jnp.arctan2(m.omega1 * w, z + m.zeta * w)) / m.omega1


def _amplitude(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """Return the amplitude at time s of the homogeneous part of w; it bounds this decaying part from s on."""
    sin_s, cos_s = flow.phasor(s)
    # Homogeneous part of w, and its rate below: w and z minus the steady response.
    free = w - (steady.c * cos_s - steady.q * sin_s - steady.g)
    rate = z + PI * (steady.c * sin_s + steady.q * cos_s)
    # The quadrature component of the free oscillation is (rate + zeta free)/omega1.
    return jnp.hypot(free, (rate + m.zeta * free) / m.omega1)


def _envelope_end(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """Return a time until which the steady response alone keeps w positive.

    The result is inf if w is certified to stay positive for ever, and s if nothing is certified.
    """
    # From s on, w is at least the steady response minus this bound. The tolerance covers rounding.
    bound = _amplitude(m, steady, w, z, s) * (1 + event_tolerance(s.dtype))
    interval = sign_interval_after(Force(steady.c, steady.q, steady.g + bound), s)
    return jnp.where(jnp.isfinite(bound) & interval.positive, interval.end, s)


def _advance(oscillator: _Oscillator, limit: Scalar | float, search: _Search) -> _Search:
    """Advance the search of `first_return` by one stage: skip an interval without a zero, or bracket a single zero."""
    s, interval = search.s, search.interval
    free = s + _free_end(oscillator.m, search.w, search.z)
    envelope = _envelope_end(oscillator.m, oscillator.steady, search.w, search.z, s)
    # No zero lies before the earlier of two times: the free solution's zero, and the next change of sign of the
    # forcing.
    clear_until = jnp.minimum(free, interval.end)
    # Once the oscillation is small, the bound by the steady response skips many free half cycles in one stage.
    by_envelope = envelope > clear_until
    ahead = jnp.minimum(jnp.where(by_envelope, envelope, clear_until), limit)
    ahead, free, by_envelope = materialise((ahead, free, by_envelope))
    no_zero = ~jnp.isfinite(ahead)
    w, z = oscillator.at(jnp.where(no_zero, s, ahead))
    falling = ~interval.positive & ~by_envelope
    # Under negative forcing a free half cycle ends at w < 0. This holds even if rounding gives w > 0.
    bracketed = falling & ((w <= 0) | ((free <= interval.end) & (ahead < limit)))
    # Under positive forcing the ends of the stages converge to the root quadratically from below.
    converged = ~falling & ((w <= 0) | (ahead - s <= _NEWTON_LIMIT * ahead)) & (ahead < limit)
    # The final Newton step. It cannot exceed the length of the stage before it.
    final_step = jnp.where((w > 0) & (z < 0), -w / jnp.where(z < 0, z, -1.0), 0.0)
    ahead = jnp.where(converged, ahead + jnp.minimum(final_step, ahead - s), ahead)
    no_zero = no_zero | (~bracketed & ~converged & (ahead >= limit))
    bracketed, converged, no_zero, ahead = materialise((bracketed, converged, no_zero, ahead))
    return _Search(
        s=jnp.where(bracketed, s, jnp.where(no_zero, jnp.inf, ahead)),
        w=jnp.where(bracketed, search.w, w),
        z=jnp.where(bracketed, search.z, z),
        high=jnp.where(bracketed, ahead, search.high),
        interval=materialise(sign_interval_after(oscillator.force, ahead)),
        running=~(bracketed | converged | no_zero),
        bracketed=bracketed,
        stage=search.stage + 1,
    )


@reuse_trace
def first_return(
    m: Membrane,
    force: Force,
    w0: Scalar,
    z0: Scalar,
    active: Flag,
    max_stages: int | Array = MAX_STAGES,
    limit: Scalar | float = math.inf,
) -> Scalar:
    """Return the first zero of w in (0, limit) of a contact from w0 >= 0.

    At time 0 the penetration is positive, or it is zero and about to rise. A zero at time 0 itself does not count.

    Write e^(zeta s) w = phi q, where phi is the free solution through the present state. While the forcing is positive,
    q only grows, so w has no zero before the first zero of phi. While the forcing is negative, q only falls, so w has
    at most one zero before the first zero of phi, and has exactly one if the forcing stays negative until then. Each
    stage therefore certifies an interval without a zero or brackets exactly one zero. Where the oscillation has
    decayed, the steady response covers many free half cycles in one stage.

    Args:
        m, force: Membrane, and forcing into the wall from time 0 on.
        w0, z0: Penetration and its rate at time 0.
        active: If False, nothing is searched and the result has no meaning.
        max_stages: Largest number of stages.
        limit: End of the searched interval.

    Returns:
        The time of the zero; inf if there is none; NaN if the search has not ended after `max_stages` stages.
    """
    oscillator = _Oscillator(m, force, flow.steady_response(m, force), w0, z0)
    zero, false = jnp.zeros_like(w0), jnp.zeros_like(active)
    start = _Search(zero, w0, z0, zero, sign_interval_after(force, zero), active, false, jnp.int32(0))
    is_running = lambda search: search.running & (search.stage < max_stages)  # noqa: E731
    result = short_while_loop(is_running, partial(_advance, oscillator, limit), start)
    # A contact from w = 0 under a negative force is a parabola to leading order. Its duration is 2 z0/|force|.
    push = jnp.minimum(force.at(zero) - m.mu * z0, -jnp.finfo(w0.dtype).tiny)
    guess = jnp.where(result.s == 0, -2 * z0 / push, zero)
    exact = bracketed_root(oscillator.at, result.s, result.high, guess, active & result.bracketed)
    return jnp.where(result.running, jnp.nan, jnp.where(result.bracketed, exact, result.s))


class TurningPoints(eqx.Module):
    """Extreme turning points of a contact. A time is 0 if there is no such turning point.

    Attributes:
        exit: Time when the contact ends.
        crest, highest: Time and value of the largest penetration.
        trough, lowest: Time and value of the smallest minimum inside the contact; the value is inf if there is no
            minimum.
        failed: True if the search did not end within the allowed number of stages.
    """

    exit: Scalar
    crest: Scalar
    highest: Scalar
    trough: Scalar
    lowest: Scalar
    failed: Flag


class _TurnVisit(eqx.Module):
    """State of a loop over all turning points of a contact: a pass finds the exit (if not given) or the next point.

    Attributes:
        number: Number of passes made; pass 0 finds the exit.
        s, sign: Time of the last turning point, and the sign of w' just after it.
        unfinished: True if there may be more turning points before the exit.
        decayed: True if the oscillation has decayed to rounding, so that only the steady response remains.
        record: Highest and lowest turning points so far.
    """

    number: Array
    s: Scalar
    sign: Scalar
    unfinished: Flag
    decayed: Flag
    record: TurningPoints


def turning_points(
    m: Membrane,
    force: Force,
    w0: Scalar,
    z0: Scalar,
    active: Flag,
    max_stages: int | Array = MAX_STAGES,
    contact_duration: Scalar | None = None,
) -> TurningPoints:
    """Find the highest and the lowest turning point of a contact by visiting all of them in order.

    Turning points are the zeros of w'. The rate w' obeys the equation of w with the forcing f', so one compiled search
    finds the turning points and the exit. Once the oscillation has decayed to rounding, the steady response remains;
    its turning points are closed-form.

    Args:
        m, force, w0, z0: As in `first_return`.
        active: If False, nothing is searched.
        max_stages: Limit of the stages of one search, and of the number of turning points.
        contact_duration: End of the contact, whether or not w is zero there; None searches for the first zero of w.
    """
    steady = flow.steady_response(m, force)
    contact = _Oscillator(m, force, steady, w0, z0)
    eps, slope = jnp.finfo(w0.dtype).eps, force.slope()
    zero, false = jnp.zeros_like(w0), jnp.zeros_like(active)
    rising = (z0 > 0) | ((z0 == 0) & (force.at(zero) > m.kappa * m.kappa * w0))

    def visit(v: _TurnVisit) -> _TurnVisit:
        """Find the exit in the first pass, else the next turning point, and record the present point."""
        first, s, record = v.number == 0, v.s, v.record
        w, z = contact.at(s)
        decayed = _amplitude(m, steady, w, z, s) <= eps * (jnp.abs(steady.c) + jnp.abs(steady.q) + jnp.abs(w))
        searching = v.unfinished & (first | ~decayed)
        rate = force.later(s).at(zero) - m.mu * z - m.kappa * m.kappa * w
        z = jnp.where(s == 0, z, 0.0)  # At a turning point w' is exactly zero; the evaluated value is a rounding error.
        # `first_return` needs a function that rises from zero: w' after a minimum, -w' after a maximum. Since w' obeys
        # the equation of w with the forcing f', its initial state is (w', w''), where w'' is `rate`.
        later = slope.later(s)
        problem = jax.tree.map(lambda x, slope: jnp.where(first, x, v.sign * slope), (force, w0, z0), (later, z, rate))
        limit = jnp.where(first, jnp.inf, record.exit - s)
        ahead = s + first_return(m, *problem, searching, max_stages, limit)
        # An undamped contact that never ends has no last turning point, and may have no largest penetration.
        endless = first & jnp.isinf(ahead) & (m.zeta == 0)
        failed = searching & (jnp.isnan(ahead) | endless)
        unfinished = searching & jnp.where(first, ~failed, ahead < record.exit)
        record = record_turning_point(record, s, w, s > 0, (s > 0) & (v.sign > 0))
        return _TurnVisit(
            number=v.number + 1,
            s=jnp.where(unfinished & ~first, ahead, s),
            sign=jnp.where(first, v.sign, -v.sign),
            unfinished=unfinished,
            decayed=decayed,
            record=eqx.tree_at(lambda t: (t.exit, t.failed), record, (jnp.where(first, ahead, record.exit), failed)),
        )

    exit_time = zero if contact_duration is None else contact_duration
    blank = TurningPoints(exit_time, zero, w0, zero, jnp.full_like(w0, jnp.inf), false)
    sign = jnp.where(rising, 1.0, -1.0).astype(w0.dtype)
    start = _TurnVisit(jnp.int32(contact_duration is not None), zero, sign, active, false, blank)
    end = lax.while_loop(lambda v: v.unfinished & (v.number <= max_stages), visit, start)
    record = _add_steady_turns(steady, end)
    return eqx.tree_at(lambda t: t.failed, record, end.unfinished | record.failed)


def _add_steady_turns(steady: Force, end: _TurnVisit) -> TurningPoints:
    """Add the turning points of the steady response to the record, if the oscillation has decayed to rounding.

    The steady response is highest at one phase and lowest half a period (time 1) later. The first of each after the end
    of the visit is added; all later ones have the same height.
    """
    # c cos(pi s) - q sin(pi s) is largest at pi s = -atan2(q, c).
    size = jnp.hypot(steady.c, steady.q)
    highest = -jnp.arctan2(steady.q, steady.c) / PI
    record = end.record
    for phase, w, is_minimum in ((highest, size, False), (highest + 1, -size, True)):
        ahead = phase + 2 * jnp.ceil(0.5 * (end.s - phase))
        inside = end.decayed & (ahead > 0) & (ahead < record.exit)
        record = record_turning_point(record, ahead, w - steady.g, inside, inside & is_minimum)
    return record


def record_turning_point(record: TurningPoints, s: Scalar, w: Scalar, is_turn: Flag, is_minimum: Flag) -> TurningPoints:
    """Return the record with one turning point added if `is_turn`; it is a minimum if `is_minimum`."""
    higher, lower = is_turn & (w > record.highest), is_minimum & (w < record.lowest)
    return TurningPoints(
        exit=record.exit,
        crest=jnp.where(higher, s, record.crest),
        highest=jnp.where(higher, w, record.highest),
        trough=jnp.where(lower, s, record.trough),
        lowest=jnp.where(lower, w, record.lowest),
        failed=record.failed,
    )


def exit_and_crest(
    m: Membrane, force: Force, w0: Scalar, z0: Scalar, active: Flag, max_stages: int | Array = MAX_STAGES
) -> tuple[Scalar, Scalar]:
    """Return the time of the first zero of w (see `first_return`) and the time of the largest penetration before it.

    The time of the largest penetration is NaN if `max_stages` turning points do not reach the exit, or if the exit is
    not decided.
    """
    record = turning_points(m, force, w0, z0, active, max_stages)
    return record.exit, jnp.where(record.failed, jnp.nan, record.crest)
