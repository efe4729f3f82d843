"""The careful search of a contact: when a forced oscillator first returns to zero, where it turns before."""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vijax.engine.forcing_sign import Spell, snap, spell_after
from vijax.engine.roots import bracketed_root
from vijax.model import flow
from vijax.model.flow import PI, Force, Membrane
from vijax.runtime.arrays import Flag, Scalar
from vijax.runtime.xla import once, search, share

_ARRIVED = 2.0**-30  # relative step of the approach after which Newton's last one is exact
PATIENCE = 20_000  # stages (about free half cycles) of one contact; only r = 1 comes near


class _Oscillator(NamedTuple):
    """The oscillator whose zeros are sought: membrane, forcing, steady response, and the state at time 0."""

    m: Membrane
    force: Force
    steady: Force
    w0: Scalar
    z0: Scalar

    def at(self, s: Scalar) -> tuple[Scalar, Scalar]:
        """Compute w and w' at time s."""
        return flow.oscillate(self.m, self.force, self.w0, self.z0, s)


class _Search(eqx.Module):
    """Search for the first zero of w > 0: none on (0, s]; then a bracket [s, high], or the root s itself."""

    s: Scalar
    w: Scalar
    z: Scalar
    high: Scalar
    spell: Spell
    running: Flag
    bracketed: Flag
    stage: Array


def _free_end(m: Membrane, w: Scalar, z: Scalar) -> Scalar:
    """Find when the unforced oscillator at (w, z) would return to zero: within less than half a free cycle.

    At the root itself w may come out below zero by rounding: that is zero, not the beginning of another cycle.
    """
    w = jnp.maximum(w, 0.0)
    return (PI - jnp.arctan2(m.omega1 * w, z + m.zeta * w)) / m.omega1


def _amplitude(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """Bound the homogeneous part from time s on: it only decays."""
    sin_s, cos_s = flow.phasor(s)
    free = w - (steady.c * cos_s - steady.q * sin_s - steady.g)
    rate = z + PI * (steady.c * sin_s + steady.q * cos_s)
    return jnp.hypot(free, (rate + m.zeta * free) / m.omega1)


def _envelope_end(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """Find a time up to which the steady response alone keeps w positive: inf if for ever, s if nothing can be said."""
    bound = _amplitude(m, steady, w, z, s) * (1 + snap(s.dtype))
    spell = spell_after(Force(steady.c, steady.q, steady.g + bound), s)
    return jnp.where(jnp.isfinite(bound) & spell.positive, spell.end, s)


def _advance(oscillator: _Oscillator, limit: Scalar | float, search: _Search) -> _Search:
    """Take the search of `first_return` a stage further: past a stretch free of zeros, or into a bracket of one."""
    s, spell = search.s, search.spell
    free = s + _free_end(oscillator.m, search.w, search.z)
    envelope = _envelope_end(oscillator.m, oscillator.steady, search.w, search.z, s)
    stretch = jnp.minimum(free, spell.end)
    leap = envelope > stretch
    ahead = jnp.minimum(jnp.where(leap, envelope, stretch), limit)
    ahead, free, leap = share((ahead, free, leap))
    never = ~jnp.isfinite(ahead)
    w, z = oscillator.at(jnp.where(never, s, ahead))
    falling = ~spell.positive & ~leap
    # A free half cycle under negative forcing ends below zero, whatever rounding says.
    bracketed = falling & ((w <= 0) | ((free <= spell.end) & (ahead < limit)))
    # The stages approach a root under positive forcing quadratically, from below.
    arrived = ~falling & ((w <= 0) | (ahead - s <= _ARRIVED * ahead)) & (ahead < limit)
    last = jnp.where((w > 0) & (z < 0), -w / jnp.where(z < 0, z, -1.0), 0.0)
    ahead = jnp.where(arrived, ahead + jnp.minimum(last, ahead - s), ahead)
    never = never | (~bracketed & ~arrived & (ahead >= limit))
    bracketed, arrived, never, ahead = share((bracketed, arrived, never, ahead))
    return _Search(
        s=jnp.where(bracketed, s, jnp.where(never, jnp.inf, ahead)),
        w=jnp.where(bracketed, search.w, w),
        z=jnp.where(bracketed, search.z, z),
        high=jnp.where(bracketed, ahead, search.high),
        spell=share(spell_after(oscillator.force, ahead)),
        running=~(bracketed | arrived | never),
        bracketed=bracketed,
        stage=search.stage + 1,
    )


@once
def first_return(
    m: Membrane,
    force: Force,
    w0: Scalar,
    z0: Scalar,
    wanted: Flag,
    patience: int | Array = PATIENCE,
    limit: Scalar | float = math.inf,
) -> Scalar:
    """Find the first zero of w in (0, limit) of the forced oscillator from w0 >= 0, moving up or held up.

    inf if there is none; NaN if `patience` stages do not decide it.

    Write e^(zeta s) w = phi q with phi the free solution through the present state. While the forcing is positive q
    only grows: no zero before phi's own. While it is negative q only falls: at most one zero before phi's, and
    certainly one by then. So stage by stage either a stretch is certified free of zeros or a bracket holds exactly
    one. Where the oscillation has decayed, the steady response carries many free half cycles at once.
    """
    oscillator = _Oscillator(m, force, flow.steady_response(m, force), w0, z0)
    zero, no = jnp.zeros_like(w0), jnp.zeros_like(wanted)
    start = _Search(zero, w0, z0, zero, spell_after(force, zero), wanted, no, jnp.int32(0))
    goes_on = lambda search: search.running & (search.stage < patience)  # noqa: E731
    found = search(goes_on, partial(_advance, oscillator, limit), start)
    # From rest on the wall against a negative push the contact is a parabola of length 2 z0/|push|.
    push = jnp.minimum(force.at(zero) - m.mu * z0, -jnp.finfo(w0.dtype).tiny)
    guess = jnp.where(found.s == 0, -2 * z0 / push, zero)
    exact = bracketed_root(oscillator.at, found.s, found.high, guess, wanted & found.bracketed)
    return jnp.where(found.running, jnp.nan, jnp.where(found.bracketed, exact, found.s))


class Turns(eqx.Module):
    """Where a contact is highest and lowest among the turning points inside it; a time is 0 where there is none.

    Attributes:
        exit: When the contact ends.
        crest, highest: When the penetration is largest, and how large.
        trough, lowest: When it is least at a minimum inside, and how large then; inf without a minimum.
        lost: The stages allowed did not do.
    """

    exit: Scalar
    crest: Scalar
    highest: Scalar
    trough: Scalar
    lowest: Scalar
    lost: Flag


class _Visit(eqx.Module):
    """A contact on its way: its exit first unless that is known, then every turning point up to it, in order.

    Attributes:
        number: How many searches were made; the exit is number 0.
        s, sign: When the last turning point was, and the sign of w' just after it.
        going: Whether there may be more.
        settled: Whether nothing but rounding is left of the oscillation, so that the steady response tells the rest.
        seen: The highest and lowest yet.
    """

    number: Array
    s: Scalar
    sign: Scalar
    going: Flag
    settled: Flag
    seen: Turns


def turning_points(
    m: Membrane,
    force: Force,
    w0: Scalar,
    z0: Scalar,
    wanted: Flag,
    patience: int | Array = PATIENCE,
    length: Scalar | None = None,
) -> Turns:
    """Visit every turning point of a contact, however many: none is lost between samples.

    They are zeros of w', which obeys the same equation, so that one compiled search finds them and the exit. Once the
    oscillation has decayed to rounding, what remains is the steady response, whose turning points are known.

    Args:
        m, force, w0, z0: As in `first_return`.
        wanted: Whether to look at all.
        patience: Stages of a search, and turning points, that are allowed.
        length: When the contact is to end, at the first return of w to zero or not; looked for unless given.
    """
    steady = flow.steady_response(m, force)
    contact = _Oscillator(m, force, steady, w0, z0)
    eps = jnp.finfo(w0.dtype).eps
    slope = force.slope()
    zero, no = jnp.zeros_like(w0), jnp.zeros_like(wanted)
    rising = (z0 > 0) | ((z0 == 0) & (force.at(zero) > m.kappa * m.kappa * w0))

    def visit(v: _Visit) -> _Visit:
        first, s, seen = v.number == 0, v.s, v.seen
        w, z = contact.at(s)
        settled = _amplitude(m, steady, w, z, s) <= eps * (jnp.abs(steady.c) + jnp.abs(steady.q) + jnp.abs(w))
        seeking = v.going & (first | ~settled)
        rate = force.later(s).at(zero) - m.mu * z - m.kappa * m.kappa * w
        z = jnp.where(s == 0, z, 0.0)  # A turning point's own w' is zero, not its rounding error.
        # The search wants a function that rises from zero: w' after a minimum, -w' after a maximum. As w' obeys w's own
        # equation, forced by the derivative of the forcing, its state is w' and w'', which is `rate`.
        later = slope.later(s)
        sought = jax.tree.map(lambda x, slope: jnp.where(first, x, v.sign * slope), (force, w0, z0), (later, z, rate))
        limit = jnp.where(first, jnp.inf, seen.exit - s)
        ahead = s + first_return(m, *sought, seeking, patience, limit)
        # An undamped contact that lasts for ever has no last turning point, nor may it have a largest penetration.
        endless = first & jnp.isinf(ahead) & (m.zeta == 0)
        lost = seeking & (jnp.isnan(ahead) | endless)
        going = seeking & jnp.where(first, ~lost, ahead < seen.exit)
        seen = compared(seen, s, w, s > 0, (s > 0) & (v.sign > 0))
        return _Visit(
            number=v.number + 1,
            s=jnp.where(going & ~first, ahead, s),
            sign=jnp.where(first, v.sign, -v.sign),
            going=going,
            settled=settled,
            seen=eqx.tree_at(lambda t: (t.exit, t.lost), seen, (jnp.where(first, ahead, seen.exit), lost)),
        )

    blank = Turns(zero if length is None else length, zero, w0, zero, jnp.full_like(w0, jnp.inf), no)
    sign = jnp.where(rising, 1.0, -1.0).astype(w0.dtype)
    start = _Visit(jnp.int32(length is not None), zero, sign, wanted, no, blank)
    end = lax.while_loop(lambda v: v.going & (v.number <= patience), visit, start)
    seen = _settled_turns(steady, end)
    return eqx.tree_at(lambda t: t.lost, seen, end.going | seen.lost)


def _settled_turns(steady: Force, end: _Visit) -> Turns:
    """Add the turning points of the steady response to those seen, where nothing else is left of the oscillation.

    It is highest at a phase and lowest half a period later: each once, the first still ahead.
    """
    size = jnp.hypot(steady.c, steady.q)
    highest = -jnp.arctan2(steady.q, steady.c) / PI
    seen = end.seen
    for when, w, rises in ((highest, size, False), (highest + 1, -size, True)):
        ahead = when + 2 * jnp.ceil(0.5 * (end.s - when))
        there = end.settled & (ahead > 0) & (ahead < seen.exit)
        seen = compared(seen, ahead, w - steady.g, there, there & rises)
    return seen


def compared(seen: Turns, s: Scalar, w: Scalar, turns: Flag, rises: Flag) -> Turns:
    """Add one turning point to those seen, where it `turns`: a minimum where it `rises` after."""
    higher, lower = turns & (w > seen.highest), rises & (w < seen.lowest)
    return Turns(
        exit=seen.exit,
        crest=jnp.where(higher, s, seen.crest),
        highest=jnp.where(higher, w, seen.highest),
        trough=jnp.where(lower, s, seen.trough),
        lowest=jnp.where(lower, w, seen.lowest),
        lost=seen.lost,
    )


def exit_and_crest(
    m: Membrane, force: Force, w0: Scalar, z0: Scalar, wanted: Flag, patience: int | Array = PATIENCE
) -> tuple[Scalar, Scalar]:
    """Find the first return of w to zero (see `first_return`), and when w is largest before.

    NaN for the crest if `patience` turning points do not get there, or if there is no telling the exit.
    """
    seen = turning_points(m, force, w0, z0, wanted, patience)
    return seen.exit, jnp.where(seen.lost, jnp.nan, seen.crest)
