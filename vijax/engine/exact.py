"""Exact event-driven engine: next wall crossing, the contact or the reset there, and the state after it.

The careful form: every search brackets the first root by a certificate before it iterates, so that no crossing, graze
or early exit is missed in any regime. `quick.py` does the regular impacts faster and declines the others.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from vijax.model import energy, flow
from vijax.model.flow import PI, Force, Membrane
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.runtime.xla import once, share

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

_SOLVE_TRIPS = 120  # bisection alone needs 2 x 53; Newton ends most after 6
_ARRIVED = 2.0**-30  # relative step of the approach after which Newton's last one is exact
PATIENCE = 20_000  # stages (about free half cycles) of one contact; only r = 1 comes near


def _snap(dtype: Any) -> float:
    """Two event times closer than this are one: a few units in the last place of a period."""
    return 16 * float(jnp.finfo(dtype).eps)


# --- roots ----------------------------------------------------------------------------------------


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(residual: Callable, root: Scalar, args: Any) -> Scalar:
    """`root` as a function of `args` by residual(root, args) = 0: value unchanged, derivatives of every order right.

    The tangent rule calls itself on the root, so second derivatives are right too (one Newton step would not do).
    """
    return root


@implicit_root.defjvp
def _implicit_root_jvp(residual, primals, tangents):
    root, args = primals
    root = implicit_root(residual, root, args)
    _, moved = jax.jvp(lambda a: residual(root, a), (args,), (tangents[1],))
    _, slope = jax.jvp(lambda x: residual(x, args), (root,), (jnp.ones_like(root),))
    return root, -moved / slope


def bracketed_root(function: Callable, low: Scalar, high: Scalar, guess: Scalar, wanted: Flag) -> Scalar:
    """The root in [low, high] of a function positive at low, not positive at high: Newton inside a bracket.

    A Newton step that leaves the bracket, or a bracket that does not halve in two trips, falls back to bisection.
    `function(x)` returns value and derivative. `low` itself may be a root (a flight or contact begins there).
    """
    eps = jnp.finfo(low.dtype).eps

    def unfinished(carry):
        trip, low, high, x, step, _ = carry
        return wanted & (trip < _SOLVE_TRIPS) & (jnp.abs(step) > eps * jnp.abs(x)) & (high - low > eps * jnp.abs(high))

    def shrink(carry):
        trip, low, high, x, _, width = carry
        value, slope = share(function(x))
        low, high = jnp.where(value > 0, x, low), jnp.where(value > 0, high, x)
        steep = slope != 0
        newton = x - value / jnp.where(steep, slope, 1.0)
        # A Newton step of a few roundings has arrived: the next one would only follow the rounding of the function.
        arrived = (value == 0) | (steep & (jnp.abs(newton - x) <= 8 * eps * jnp.abs(x)))
        check = trip % 3 == 2
        inside = steep & (newton > low) & (newton < high) & ~(check & (high - low > 0.5 * width))
        ahead = jnp.where(inside | arrived, newton, 0.5 * (low + high))
        ahead = jnp.where(value == 0, x, ahead)
        step = jnp.where(arrived, 0.0, ahead - x)
        return trip + 1, low, high, ahead, step, jnp.where(check, high - low, width)

    guess = jnp.where((guess > low) & (guess < high), guess, 0.5 * (low + high))
    start = (jnp.int32(0), low, high, guess, high - low, high - low)
    return lax.while_loop(unfinished, shrink, start)[3]


class Spell(eqx.Module):
    """A stretch of constant sign of a forcing: its sign and when it ends."""

    positive: Flag
    end: Scalar


def _half_width(force: Force) -> Scalar:
    """Half the length of the positive stretch of c cos - q sin - g; 0 or 1 where the sign never changes."""
    amplitude = jnp.hypot(force.c, force.q)
    level = force.g / jnp.where(amplitude > 0, amplitude, 1.0)
    level = jnp.where(amplitude > 0, level, jnp.where(force.g < 0, -1.0, 1.0))
    return jnp.arccos(jnp.clip(level, -1.0, 1.0)) / PI


@once
def _spell(force: Force, s: Scalar) -> Spell:
    """The sign of the forcing just after s, and the end of that stretch; an end within rounding of s counts as past."""
    half = _half_width(force)
    x = s + jnp.arctan2(force.q, force.c) / PI
    x = x - 2 * jnp.round(0.5 * x)  # the positive stretch is |x| < half
    inside = jnp.abs(x) < half
    left = jnp.where(inside, half - x, jnp.where(x < 0, -half - x, 2 - half - x))
    over = left < _snap(s.dtype) * (1 + jnp.abs(s))
    length = jnp.where(inside, 2 - 2 * half, 2 * half)  # of the next stretch
    constant = (half <= 0) | (half >= 1)
    left = jnp.where(constant, jnp.inf, jnp.where(over, left + length, left))
    positive = jnp.where(constant, half >= 1, inside ^ over)
    return Spell(positive, s + left)


# --- the first return of a forced oscillator to zero ----------------------------------------------


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
    """Time until the unforced oscillator at (w, z) would return to zero: less than half a free cycle.

    At the root itself w may come out below zero by rounding: that is zero, not the beginning of another cycle.
    """
    w = jnp.maximum(w, 0.0)
    return (PI - jnp.arctan2(m.omega1 * w, z + m.zeta * w)) / m.omega1


def _amplitude(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """Largest homogeneous part from time s on: it only decays."""
    sin_s, cos_s, _, _ = flow.half_turn(s)
    free = w - (steady.c * cos_s - steady.q * sin_s - steady.g)
    rate = z + PI * (steady.c * sin_s + steady.q * cos_s)
    return jnp.hypot(free, (rate + m.zeta * free) / m.omega1)


def _envelope_end(m: Membrane, steady: Force, w: Scalar, z: Scalar, s: Scalar) -> Scalar:
    """A time up to which the steady response alone keeps w positive: inf if for ever, s if nothing can be said."""
    bound = _amplitude(m, steady, w, z, s) * (1 + _snap(s.dtype))
    spell = _spell(Force(steady.c, steady.q, steady.g + bound), s)
    return jnp.where(jnp.isfinite(bound) & spell.positive, spell.end, s)


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
    """First s in (0, limit) with w(s) = 0 of the forced oscillator that starts at w0 >= 0, moving up or held up.

    inf if there is none; NaN if `patience` stages do not decide it.

    Write e^(zeta s) w = phi q with phi the free solution through the present state. While the forcing is positive q
    only grows: no zero before phi's own. While it is negative q only falls: at most one zero before phi's, and
    certainly one by then. So stage by stage either a stretch is certified free of zeros or a bracket holds exactly
    one. Where the oscillation has decayed, the steady response carries many free half cycles at once.
    """
    steady = flow.steady_response(m, force)

    def advance(search: _Search) -> _Search:
        s, spell = search.s, search.spell
        free = s + _free_end(m, search.w, search.z)
        envelope = _envelope_end(m, steady, search.w, search.z, s)
        stretch = jnp.minimum(free, spell.end)
        leap = envelope > stretch
        ahead = jnp.minimum(jnp.where(leap, envelope, stretch), limit)
        ahead, free, leap = share((ahead, free, leap))
        never = ~jnp.isfinite(ahead)
        w, z = flow.oscillate(m, force, w0, z0, jnp.where(never, s, ahead))
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
            spell=share(_spell(force, ahead)),
            running=~(bracketed | arrived | never),
            bracketed=bracketed,
            stage=search.stage + 1,
        )

    zero, no = jnp.zeros_like(w0), jnp.zeros_like(wanted)
    start = _Search(zero, w0, z0, zero, _spell(force, zero), wanted, no, jnp.int32(0))
    found = lax.while_loop(lambda search: search.running & (search.stage < patience), advance, start)
    # From rest on the wall against a negative push the contact is a parabola of length 2 z0/|push|.
    push = jnp.minimum(force.at(zero) - m.mu * z0, -jnp.finfo(w0.dtype).tiny)
    guess = jnp.where(found.s == 0, -2 * z0 / push, zero)
    exact = bracketed_root(
        lambda s: flow.oscillate(m, force, w0, z0, s), found.s, found.high, guess, wanted & found.bracketed
    )
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
    eps = jnp.finfo(w0.dtype).eps
    slope = force.slope()
    zero, no = jnp.zeros_like(w0), jnp.zeros_like(wanted)
    rising = (z0 > 0) | ((z0 == 0) & (force.at(zero) > m.kappa * m.kappa * w0))

    def visit(v: _Visit) -> _Visit:
        first, s, seen = v.number == 0, v.s, v.seen
        w, z = flow.oscillate(m, force, w0, z0, s)
        settled = _amplitude(m, steady, w, z, s) <= eps * (jnp.abs(steady.c) + jnp.abs(steady.q) + jnp.abs(w))
        seeking = v.going & (first | ~settled)
        rate = force.later(s).at(zero) - m.mu * z - m.kappa * m.kappa * w
        z = jnp.where(s == 0, z, 0.0)  # A turning point's own w' is zero, not its rounding error.
        later = slope.later(s)
        sought = jax.tree.map(lambda x, slope: jnp.where(first, x, v.sign * slope), (force, w0, z0), (later, z, rate))
        limit = jnp.where(first, jnp.inf, seen.exit - s)
        ahead = s + first_return(m, *sought, seeking, patience, limit)
        # An undamped contact that lasts for ever has no last turning point, nor may it have a largest penetration.
        endless = first & jnp.isinf(ahead) & (m.zeta == 0)
        lost = seeking & (jnp.isnan(ahead) | endless)
        going = seeking & jnp.where(first, ~lost, ahead < seen.exit)
        seen = _compared(seen, s, w, s > 0, (s > 0) & (v.sign > 0))
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
    seen = end.seen
    # The steady response is highest at this phase and lowest half a period later: each once, the first still ahead.
    known = -jnp.arctan2(steady.q, steady.c) / PI
    for when, low in ((known, no), (known + 1, ~no)):
        ahead = when + 2 * jnp.ceil(0.5 * (end.s - when))
        there = end.settled & (ahead > 0) & (ahead < seen.exit)
        w, _ = flow.oscillate(m, force, w0, z0, jnp.where(there, ahead, 0.0))
        seen = _compared(seen, ahead, w, there, there & low)
    return eqx.tree_at(lambda t: t.lost, seen, end.going | seen.lost)


def _compared(seen: Turns, s: Scalar, w: Scalar, turns: Flag, rises: Flag) -> Turns:
    """The turning points seen, with one more where it `turns`: a minimum where it `rises` after."""
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
    """The first return of w to zero (see `first_return`), and when w is largest before.

    NaN for the crest if `patience` turning points do not get there, or if there is no telling the exit.
    """
    seen = turning_points(m, force, w0, z0, wanted, patience)
    return seen.exit, jnp.where(seen.lost, jnp.nan, seen.crest)


# --- the next wall crossing of a flight -----------------------------------------------------------


class _Scan(eqx.Module):
    """Search for the next wall: none on (0, s]; then the wall and a bracket of the crossing."""

    s: Scalar
    v: Scalar
    turn: Scalar  # next zero of the acceleration
    side: Scalar
    low: Scalar
    high: Scalar


def next_turn(force: Force, s: Scalar) -> Scalar:
    """The next zero of a flight's acceleration after s."""
    return _spell(force, s).end


LONGEST_PIECE = 1.0  # of a flight that is looked at at once, where the acceleration has no zero


def monotone_piece(
    gamma: Scalar, force: Force, t0: Scalar, v0: Scalar, s: Scalar, v: Scalar, end: Scalar, wanted: Flag
) -> tuple[Scalar, Flag, Scalar]:
    """The velocity at the end of a piece without a zero of the acceleration; whether and when the ball turns on it.

    Args:
        gamma, t0, v0: Of the flight; `force` is its `flow.flight_force`.
        s, v: Where the piece begins, and the velocity there.
        end: Where it ends.
        wanted: Whether to look for the turn.
    """

    def velocity(s):
        return flow.flight(gamma, t0, v0, s)[1]

    v_end = velocity(end)
    turns = v * v_end < 0
    up = jnp.where(v > 0, 1.0, -1.0)
    turn = bracketed_root(
        lambda s: (up * velocity(s), up * force.at(s)), s, end, jnp.where(turns, s, end), turns & wanted
    )
    return v_end, turns, turn


def next_wall(
    gamma: Scalar, room: tuple[Scalar, Scalar], t0: Scalar, v0: Scalar, horizon: Scalar, wanted: Flag
) -> tuple[Scalar, Scalar]:
    """Time to the first wall crossing and its side (0: none before `horizon`).

    Between zeros of the acceleration (analytic) the velocity is monotone, so each velocity zero is bracketed; between
    those the position is monotone, so each crossing is bracketed. `room` holds the room to the left and right wall.
    """
    force = flow.flight_force(gamma, t0)

    def scan(c: _Scan) -> _Scan:
        end = jnp.minimum(c.turn, c.s + LONGEST_PIECE)
        v_end, turns, turn = monotone_piece(gamma, force, t0, v0, c.s, c.v, end, wanted)
        middle = jnp.where(turns, turn, end)
        heading = jnp.where(c.v == 0, jnp.sign(v_end), jnp.sign(c.v))
        first = _beyond(gamma, room, t0, v0, heading, middle)
        second = _beyond(gamma, room, t0, v0, jnp.sign(v_end), end)
        side = jnp.where(first != 0, first, second)
        low, high = jnp.where(first != 0, c.s, middle), jnp.where(first != 0, middle, end)
        return _Scan(end, v_end, next_turn(force, end), side, low, high)

    zero = jnp.zeros_like(v0)
    start = _Scan(zero, v0, next_turn(force, zero), zero, zero, zero)
    found = lax.while_loop(lambda c: wanted & (c.side == 0) & (c.s < horizon), scan, start)
    distance = jnp.where(found.side > 0, room[1], room[0])

    def gap(s):
        rise, v = flow.flight(gamma, t0, v0, s)
        return distance - found.side * rise, -found.side * v

    hit = wanted & (found.side != 0)
    return bracketed_root(gap, found.low, found.high, 0.5 * (found.low + found.high), hit), found.side


def _beyond(gamma, room, t0, v0, heading, s):
    """`heading` if the ball, moving that way, is past the wall there at time s, else 0."""
    rise, _ = flow.flight(gamma, t0, v0, s)
    past = jnp.where(heading > 0, rise > room[1], rise < -room[0])
    return jnp.where(past & (heading != 0), heading, 0.0)


# --- one step -------------------------------------------------------------------------------------


class Outcome(eqx.Module):
    """What one step did: the state after it, the impact (side 0: none), and how long it flew and stayed on the wall."""

    state: State
    impact: Impact
    flight: Scalar
    stay: Scalar
    stuck: Flag  # a rigid wall held the ball until release
    quiet: Flag  # no wall within the horizon: the state is the start's
    permanent: Flag  # the contact never ends: the state is that of its onset


def stick_speed(dtype: Any) -> float:
    """Exit speed below which a chattering ball counts as stuck: 1e-9 in float64, else by the root of eps."""
    return 1e-9 * math.sqrt(jnp.finfo(dtype).eps / jnp.finfo(jnp.float64).eps)


_STICK_SHARE = 1e-3  # the rest of the chatter must last less than this share of the time to release


def _soft_contact(
    pair: ImpactPair,
    wall: Membrane,
    side: Scalar,
    t: Scalar,
    w0: Scalar,
    z0: Scalar,
    wanted: Flag,
    deep: bool,
    patience: int | Array,
):
    """Duration (inf: for ever), outward speed -w' at the exit, and largest penetration of a contact."""
    force = flow.contact_force(pair.gamma, side, t)
    args = (wall, force, w0, z0)
    frozen = lax.stop_gradient(args)
    if deep:
        duration, when = exit_and_crest(*frozen, wanted, patience)
    else:
        duration = first_return(*frozen, wanted, patience)
    ends = wanted & jnp.isfinite(duration)
    duration = jnp.where(ends, implicit_root(_penetration, jnp.where(ends, duration, 1.0), args), duration)
    _, z = flow.oscillate(*args, jnp.where(ends, duration, 0.0))
    if not deep:
        return duration, -z, jnp.full_like(z, jnp.nan)
    turned = wanted & (when > 0)
    when = jnp.where(turned, implicit_root(_penetration_rate, jnp.where(turned, when, 1.0), args), when)
    depth, _ = flow.oscillate(*args, when)
    return duration, -z, depth


def _penetration(s, args):
    return flow.oscillate(*args, s)[0]


def _penetration_rate(s, args):
    return flow.oscillate(*args, s)[1]


def _crossing(s, args):
    gamma, side, distance, t0, v0 = args
    return distance - side * flow.flight(gamma, t0, v0, s)[0]


def _rigid_contact(pair: ImpactPair, side: Scalar, t: Scalar, speed: Scalar, held: Flag):
    """Outward speed after a rigid impact, whether it sticks, and for how long (inf: for ever).

    A chatter is a geometric series of bounces; what is left of it lasts 2 v/(a (1 - r)).
    """
    force = flow.contact_force(pair.gamma, side, t)
    push = force.at(jnp.zeros_like(t))
    spell = _spell(lax.stop_gradient(force), jnp.zeros_like(t))
    out = pair.r * speed
    chatter = 2 * out / jnp.where(push > 0, push, 1.0) / jnp.maximum(1 - pair.r, jnp.finfo(t.dtype).tiny)
    tired = (out < stick_speed(t.dtype)) & (push > 0) & (chatter < _STICK_SHARE * spell.end) & (pair.r < 1)
    stuck = (tired | held) & spell.positive
    release = jnp.where(jnp.isfinite(spell.end), spell.end, 1.0)
    release = jnp.where(jnp.isfinite(spell.end), implicit_root(lambda s, f: f.at(s), release, force), spell.end)
    return jnp.where(stuck, 0.0, out), stuck, jnp.where(stuck, release, 0.0)


def step(
    pair: ImpactPair,
    state: State,
    horizon: Scalar,
    *,
    deep: bool = True,
    patience: int | Array = PATIENCE,
    rolled: bool = False,
) -> Outcome:
    """Fly to the next wall, go through the contact there, and leave it: one impact.

    Args:
        pair: One cell (scalars). `kappa=None` is the rigid wall; its depth is |v_in| chi(r), that of kappa = 1.
        state: In flight, or in contact from the start (a contact without onset: the impact has side 0).
        horizon: Time beyond which no onset is looked for.
        deep: Whether to look for the greatest depth (and the work); NaN else.
        patience: Stages that a contact may take to be decided; if they do not do, its `stay` or depth is NaN.
        rolled: For programs that are differentiated; see `flow.Membrane`.

    Differentiable in pair and state, forward and reverse, to any order: event times by the implicit function.
    """
    held = state.mode != 0
    room = (0.5 * pair.d + state.u, 0.5 * pair.d - state.u)
    wanted = ~held & (horizon > 0)
    sought = lax.stop_gradient((pair.gamma, room, state.t, state.v, horizon))
    flight, side = next_wall(*sought, wanted)
    hit = wanted & (side != 0)
    side = jnp.where(held, state.mode.astype(flight.dtype), jnp.where(hit, side, 1.0))
    args = (pair.gamma, side, jnp.where(side > 0, room[1], room[0]), state.t, state.v)
    flight = jnp.where(hit, implicit_root(_crossing, jnp.where(hit, flight, 1.0), args), 0.0)
    _, v_in = flow.flight(pair.gamma, state.t, state.v, flight)
    t, periods = flow.wrap_phase(state.t + flight)
    meets = hit | held
    if pair.kappa is None:
        out, stuck, stay = _rigid_contact(pair, side, t, side * v_in, held)
        depth = side * v_in * energy.rigid_penetration(pair.r)
        work = energy.membrane_work_rigid(v_in, pair.r)
    else:
        w0 = jnp.where(held, side * state.u - 0.5 * pair.d, 0.0)
        stay, out, depth = _soft_contact(
            pair, flow.membrane(pair, rolled=rolled), side, t, w0, side * v_in, meets, deep, patience
        )
        stuck = jnp.zeros_like(held)
        ends = jnp.isfinite(stay)
        work = energy.membrane_work(
            pair.kappa, pair.mu, pair.gamma, side, t, jnp.where(ends, stay, 1.0), v_in, -side * out
        )
    permanent = meets & jnp.isinf(stay)
    ends = meets & ~permanent
    n = state.n + periods.astype(state.n.dtype)
    leave, more = flow.wrap_phase(t + jnp.where(ends, stay, 0.0))
    after = State(
        u=jnp.where(ends, 0.5 * side * pair.d, state.u),
        v=jnp.where(ends, -side * out, state.v),
        t=jnp.where(ends, leave, state.t),
        n=jnp.where(ends, n + more.astype(n.dtype), state.n),
        mode=jnp.where(ends, 0, state.mode),
    )
    counted = jnp.where(hit, side, 0.0).astype(state.mode.dtype)
    impact = Impact(n=n, t=t, side=counted, v_in=v_in, v_out=-side * out, depth=depth, duration=stay, work=work)
    return Outcome(after, impact, flight, stay, stuck & ends, wanted & ~hit, permanent)


def start_mode(pair: ImpactPair, u: Scalar, v: Scalar, t: Scalar) -> Scalar:
    """Contact side (0: none) of a start: inside a soft wall; on a wall by the velocity, at rest by the acceleration.

    A rigid wall holds only a ball that rests on it and is pushed against it. Where the acceleration is zero, or as good
    as that, it counts as what it is about to be: a ball that is set free for 1e-16 of a period has no impact.
    """
    side = jnp.where(u > 0, 1.0, -1.0).astype(u.dtype)
    gap = 0.5 * pair.d - side * u
    pressed = _spell(flow.contact_force(pair.gamma, side, t), jnp.zeros_like(t)).positive
    resting = (gap == 0) & (v == 0) & pressed
    held = resting if pair.kappa is None else (gap < 0) | resting | ((gap == 0) & (side * v > 0))
    return jnp.where(held, side, 0.0)


def tangent(pair: ImpactPair, outcome: Outcome) -> Float[Array, "2 2"]:
    """Tangent map of one step in (du, du') at fixed times, from flight to flight, saltations included.

    A stuck ball forgets how it came: the zero matrix.
    """
    if pair.kappa is None:
        push = flow.acceleration(pair.gamma, outcome.impact.t)
        contact = flow.rigid_matrix(pair.r, push, outcome.impact.v_in)
        contact = jnp.where(outcome.stuck, 0.0, contact)
    else:
        contact = flow.contact_matrix(flow.membrane(pair), outcome.stay)
    return contact @ flow.flight_matrix(outcome.flight)
