"""What a finished round says of its candidate: Newton's correction of where it began, and whether that is the orbit."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from vijax.batch.cell import TANGENT_SCALE, Candidate, Cell, Lane, Mask, Settings
from vijax.batch.recurrence import grain, recurrence, settled
from vijax.engine.method import Method, braked_by, waves_of
from vijax.model.waves import drift
from vijax.runtime.arrays import present

# Newton rounds on one candidate, each an orbit long. The digits double in each: what has none after so many is no
# orbit. Of a late cell, whose periods are spent, more: near a pitchfork, from as far off as the motion still is, the
# first steps go but a third of the way.
_ROUNDS, _LATE_ROUNDS = 8, 16
# Newton's steps of a late cell together move the ball by less than this (the gap is d wide), and are at most so many
# times as long as the way that they lead: with more of either they pass by the orbit that the motion comes to.
_LATE_REACH, _DETOUR = 0.1, 2.0
# A late cell that is followed comes nearer to its orbit by at least this power of the multiplier: not by the first, as
# multipliers differ a little where the motion is.
_PACE = 0.5
# The orbit of a late cell attracts by at least so much a round: otherwise it may be at its bifurcation.
_MARGIN = 1e-6
_SHORT = 8  # longest period, in forcing periods, of an orbit whose surroundings are taken to be wide
# Solving for Newton's step multiplies rounding. A step that stalls has arrived for that reason up to this multiple of
# the tolerance, and above it for another.
_GAIN = 1e3
# Newton's second step is below this part of the first one where the ball was within the orbit's reach.
_WITHIN = 0.3


class Correction(NamedTuple):
    """What a finished round says of the orbit that it followed.

    Attributes:
        size: Newton's correction of the round's start, |u| + |v|; inf where the round tells nothing.
        u, v: Its components.
        largest: Modulus of the largest Floquet multiplier.
        gain: How many times larger a rounding of the round's end is in the correction.
        miss: How far the round's end is from its start, |u| + |v|.
    """

    size: Lane
    u: Lane
    v: Lane
    largest: Lane
    gain: Lane
    miss: Lane


class Verdict(NamedTuple):
    """What becomes of cells that have flown a round; each is one of these.

    Attributes:
        good: The orbit is the attractor.
        again: Newton's method goes on, by another round.
        follow: It has arrived, but the motion had not: that is to be followed from where it was.
        approached: The motion was followed and comes nearer to the orbit, whose own round is then flown once more.
        bad: There is no orbit, or it is not what attracts the motion.
    """

    good: Mask
    again: Mask
    follow: Mask
    approached: Mask
    bad: Mask


def judge(settings: Settings, cell: Cell, newton: Correction, judged: Mask) -> Verdict:
    """Judge the cells that have flown their round."""
    c, size, least = present(cell.candidate), newton.size, grain(settings)
    flown = judged & (c.laps > 1)
    judged = judged & ~flown
    close, far = settled(size.dtype, least), jnp.where(c.late, _LATE_REACH, 1e3 * recurrence(size.dtype, least))
    # Rounding leaves of a step what it gains in solving. A step that shrinks slowly for any other reason is not there
    # yet: near a flip, where the motion after two turns is nearly what it was, Newton gains but a third a round.
    arrived = (size < close) | ((size < close * jnp.clip(newton.gain, 1.0, _GAIN)) & (size > 0.25 * c.last))
    # A long orbit attracts from so near that chaos may pass it within the recurrence and go on. There Newton's second
    # step is no shorter than the first: the orbit is a real one, but the ball is not on its way to it.
    astray = (c.period > _SHORT) & (c.rounds == 1) & (size > jnp.maximum(_WITHIN * c.last, close))
    astray = astray | (c.late & ~_straight(c, newton))
    confirmed = judged & arrived & (newton.largest < jnp.where(c.late, 1 - _MARGIN, 1 + 1e-6)) & ~astray
    rounds = jnp.where(c.late, _LATE_ROUNDS, _ROUNDS)
    # Where a bounded, contracting Newton step leads nowhere near, the recurrence was a coincidence.
    hopeless = arrived | astray | ~(size + c.moved < far) | (c.rounds >= rounds)
    follow = confirmed & c.late & ~c.followed
    approached = flown & _comes_nearer(cell, newton, _GAIN * close)
    return Verdict(
        good=confirmed & ~follow,
        again=judged & ~confirmed & ~hopeless,
        follow=follow,
        approached=approached,
        bad=(judged & ~confirmed & hopeless) | (flown & ~approached),
    )


def correction(cell: Cell, method: Method | None) -> Correction:
    """Compute Newton's correction of the round's start, by the tangent map of the round."""
    c, grown = present(cell.candidate), jnp.exp(present(cell.exponent) * math.log(TANGENT_SCALE))
    p, q, r, s = (entry * grown for entry in present(cell.tangent))
    # The round ended at an exit; fly on (or back) to the phase at which it began.
    rest = 2 * (c.base.n + c.laps * c.period - cell.ball.n) + (c.base.t - cell.ball.t)
    gamma = braked_by(method, cell.pair.gamma, cell.ball.v)
    rise, v = drift(waves_of(method, cell.ball.t), gamma, cell.ball.v, rest)
    # Times the flight's matrix, entry by entry: an accelerator has nothing slower than many products of small matrices.
    p, q = p + rest * r, q + rest * s
    miss_u, miss_v = cell.ball.u + rise - c.base.u, v - c.base.v
    a, b, e, d = 1 - p, -q, -r, 1 - s
    determinant = a * d - b * e
    safe = jnp.where(determinant == 0, jnp.nan, determinant)
    nudge_u, nudge_v = (d * miss_u - b * miss_v) / safe, (a * miss_v - e * miss_u) / safe
    gain = (jnp.abs(a) + jnp.abs(b) + jnp.abs(e) + jnp.abs(d)) / jnp.abs(safe)
    half_trace, product = 0.5 * (p + s), p * s - q * r
    spread = half_trace * half_trace - product
    largest = jnp.where(
        spread > 0, jnp.abs(half_trace) + jnp.sqrt(jnp.maximum(spread, 0.0)), jnp.sqrt(jnp.maximum(product, 0.0))
    )
    # A round that ends so long before or after its phase was none.
    off = jnp.where(jnp.abs(rest) < 0.05, 0.0, jnp.inf)
    size = jnp.abs(nudge_u) + jnp.abs(nudge_v) + off
    miss = jnp.abs(miss_u) + jnp.abs(miss_v) + off
    return Correction(jnp.where(jnp.isfinite(size), size, jnp.inf), nudge_u, nudge_v, largest, gain, miss)


def _straight(c: Candidate, newton: Correction) -> Mask:
    """Say whether Newton's steps lead from where the motion is, and contracts, to the orbit without turning back.

    If they do, no other orbit lies in between.
    """
    u, v = c.base.u + newton.u - c.origin.u, c.base.v + newton.v - c.origin.v
    return (c.moved + newton.size < _DETOUR * (jnp.abs(u) + jnp.abs(v))) & ((c.rounds > 0) | (newton.largest < 1))


def _comes_nearer(cell: Cell, newton: Correction, least: float) -> Mask:
    """Say whether a motion that was followed has come nearer to the orbit, at the pace of its multiplier or faster."""
    c = present(cell.candidate)
    before = jnp.abs(c.origin.u - c.base.u) + jnp.abs(c.origin.v - c.base.v)
    shrunk = jnp.exp(_PACE * c.laps * jnp.log(present(cell.multiplier)))
    return newton.miss < jnp.maximum(before * shrunk, least)
