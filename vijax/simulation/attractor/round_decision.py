"""Decision about a finished round: Newton's correction of its start, and whether its orbit is the attractor.

A round maps its start x to F(x) at the same phase, one period of the orbit later, with the tangent map M. Newton's
correction is (I - M)^(-1) (F(x) - x). The orbit is accepted if the correction is below the tolerance and the largest
multiplier of M is at most 1.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from vijax.impact.method import Method, effective_gamma_of, waves_of
from vijax.model.forcing.waves import flight_motion
from vijax.runtime.arrays import not_none
from vijax.simulation.attractor.search_tolerances import orbit_tolerance, recurrence_tolerance, repeatability_of
from vijax.simulation.cell.cell import TANGENT_SCALE, Candidate, Cell, Lane, Mask, Settings

# Newton rounds on one candidate; each follows the orbit once. The number of correct digits doubles in each, so a
# candidate without convergence after this many is no orbit. Late cells, which have spent their periods, have more: near
# a pitchfork, at the distance of the motion, the first steps cover only a third of the remaining distance each.
_ROUNDS, _LATE_ROUNDS = 8, 16
# Limits for the Newton steps of a late cell: their sum must be below _LATE_REACH (in the units of u and d), and below
# _DETOUR times the distance between the start of the first step and the result. Beyond either limit the steps pass by
# the orbit that the motion approaches.
_LATE_REACH, _DETOUR = 0.1, 2.0
# The distance of a followed late cell from its orbit must shrink at least by the factor multiplier**(_APPROACH_EXPONENT
# * turns); a turn is one period of the orbit. The exponent is below 1, because the multipliers at the motion differ a
# little from the multipliers of the orbit.
_APPROACH_EXPONENT = 0.5
# The multiplier of a late cell's orbit must be below 1 by this margin; otherwise the orbit may be at its bifurcation.
_MARGIN = 1e-6
_SHORT_PERIOD = 8  # up to this period, in forcing periods, an orbit's region of attraction is assumed to be wide
# Solving for Newton's step amplifies rounding. If a step no longer shrinks and is below this multiple of the tolerance,
# rounding is the reason; above it there is another reason.
_GAIN = 1e3
# If the ball started in the region that the orbit attracts, Newton's second step is below this share of the first one.
_SECOND_STEP = 0.3


class Correction(NamedTuple):
    """Newton's correction for a finished round, and properties of the round's tangent map.

    Attributes:
        size: Newton's correction of the round's start, |u| + |v|; inf if the round is not usable.
        u, v: Components of the correction.
        largest: Modulus of the largest Floquet multiplier.
        gain: Amplification of a rounding error at the round's end in the correction.
        miss: Distance of the round's end from its start, |u| + |v|.
    """

    size: Lane
    u: Lane
    v: Lane
    largest: Lane
    gain: Lane
    miss: Lane


class RoundDecision(NamedTuple):
    """Decision about cells that have finished a round; exactly one mask is True for each such cell.

    Attributes:
        good: The orbit is the attractor.
        again: Newton's method continues with another round.
        follow: Newton's method has converged but the motion had not: follow the motion from the state of the search.
        approached: The followed motion approaches the orbit; the orbit's round is computed once more.
        bad: There is no orbit, or it does not attract the motion.
    """

    good: Mask
    again: Mask
    follow: Mask
    approached: Mask
    bad: Mask


def decide(settings: Settings, cell: Cell, newton_step: Correction, complete: Mask) -> RoundDecision:
    """Decide about the cells that have finished their round."""
    c, size, repeatability = not_none(cell.candidate), newton_step.size, repeatability_of(settings)
    followed = complete & (c.laps > 1)
    complete = complete & ~followed
    tolerance, reach = (
        orbit_tolerance(size.dtype, repeatability),
        jnp.where(c.late, _LATE_REACH, 1e3 * recurrence_tolerance(size.dtype, repeatability)),
    )
    # A converged step is limited by rounding: it no longer shrinks to a quarter, and it is below the tolerance times
    # the amplification `gain`. A step that shrinks slowly for another reason is not converged: near a flip, where the
    # motion after two turns is nearly unchanged, each Newton step covers only a third of the distance.
    arrived = (size < tolerance) | (
        (size < tolerance * jnp.clip(newton_step.gain, 1.0, _GAIN)) & (size > 0.25 * c.last_step)
    )
    # A long orbit attracts from a small region only, and chaos may pass it within the recurrence tolerance and leave
    # again. Then Newton's second step is no shorter than the first: the orbit exists, but the ball is not on its way to
    # it.
    astray = (c.period > _SHORT_PERIOD) & (c.rounds == 1) & (size > jnp.maximum(_SECOND_STEP * c.last_step, tolerance))
    astray = astray | (c.late & ~_straight(c, newton_step))
    confirmed = complete & arrived & (newton_step.largest < jnp.where(c.late, 1 - _MARGIN, 1 + 1e-6)) & ~astray
    rounds = jnp.where(c.late, _LATE_ROUNDS, _ROUNDS)
    # If Newton's steps are not finite or lead farther than `reach`, the recurrence was a coincidence.
    hopeless = arrived | astray | ~(size + c.step_sum < reach) | (c.rounds >= rounds)
    follow = confirmed & c.late & ~c.followed
    approached = followed & _comes_nearer(cell, newton_step, _GAIN * tolerance)
    return RoundDecision(
        good=confirmed & ~follow,
        again=complete & ~confirmed & ~hopeless,
        follow=follow,
        approached=approached,
        bad=(complete & ~confirmed & hopeless) | (followed & ~approached),
    )


def correction(cell: Cell, method: Method | None) -> Correction:
    """Compute Newton's correction of the round's start from the tangent map of the round."""
    c, scale = not_none(cell.candidate), jnp.exp(not_none(cell.exponent) * math.log(TANGENT_SCALE))
    p, q, r, s = (entry * scale for entry in not_none(cell.tangent))
    # The round ended at an exit from a contact: continue the flight (forwards or backwards) to the phase of the round's
    # start.
    rest = 2 * (c.round_start.n + c.laps * c.period - cell.ball.n) + (c.round_start.t - cell.ball.t)
    gamma = effective_gamma_of(method, cell.pair.gamma, cell.ball.v)
    rise, v = flight_motion(waves_of(method, cell.ball.t), gamma, cell.ball.v, rest)
    # Multiply by the flight's matrix [[1, rest], [0, 1]] entry by entry: many products of small matrices are the
    # slowest operation of an accelerator.
    p, q = p + rest * r, q + rest * s
    miss_u, miss_v = cell.ball.u + rise - c.round_start.u, v - c.round_start.v
    # I - M, solved by Cramer's rule.
    a, b, e, d = 1 - p, -q, -r, 1 - s
    determinant = a * d - b * e
    divisor = jnp.where(determinant == 0, jnp.nan, determinant)
    step_u, step_v = (d * miss_u - b * miss_v) / divisor, (a * miss_v - e * miss_u) / divisor
    gain = (jnp.abs(a) + jnp.abs(b) + jnp.abs(e) + jnp.abs(d)) / jnp.abs(divisor)
    # Multipliers of the 2 x 2 map from trace and determinant; a complex pair has the modulus sqrt(det).
    half_trace, product = 0.5 * (p + s), p * s - q * r
    discriminant = half_trace * half_trace - product
    largest = jnp.where(
        discriminant > 0,
        jnp.abs(half_trace) + jnp.sqrt(jnp.maximum(discriminant, 0.0)),
        jnp.sqrt(jnp.maximum(product, 0.0)),
    )
    # A round that ends 0.05 or more from the phase of its start did not close.
    open_round = jnp.where(jnp.abs(rest) < 0.05, 0.0, jnp.inf)
    size = jnp.abs(step_u) + jnp.abs(step_v) + open_round
    miss = jnp.abs(miss_u) + jnp.abs(miss_v) + open_round
    return Correction(jnp.where(jnp.isfinite(size), size, jnp.inf), step_u, step_v, largest, gain, miss)


def _straight(c: Candidate, newton_step: Correction) -> Mask:
    """Return True where Newton's steps lead straight from the motion to the orbit, and the motion contracts.

    If they do, no other orbit lies in between. "Straight": the sum of the steps is below _DETOUR times the distance.
    """
    u, v = c.round_start.u + newton_step.u - c.search_ball.u, c.round_start.v + newton_step.v - c.search_ball.v
    return (c.step_sum + newton_step.size < _DETOUR * (jnp.abs(u) + jnp.abs(v))) & (
        (c.rounds > 0) | (newton_step.largest < 1)
    )


def _comes_nearer(cell: Cell, newton_step: Correction, smallest: float) -> Mask:
    """Return True where a followed motion has approached the orbit as fast as its multiplier predicts, or faster."""
    c = not_none(cell.candidate)
    before = jnp.abs(c.search_ball.u - c.round_start.u) + jnp.abs(c.search_ball.v - c.round_start.v)
    shrunk = jnp.exp(_APPROACH_EXPONENT * c.laps * jnp.log(not_none(cell.multiplier)))
    return newton_step.miss < jnp.maximum(before * shrunk, smallest)
