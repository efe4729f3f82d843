"""Multiple shooting: a periodic orbit as the root of closed forms, one set of equations per impact.

The unknowns of an impact are its onset time, its speed into the wall and how long the contact lasts; its equations say
that the penetration is back at zero then, and that the flight after it meets the next impact in place and speed. No
crossing is searched for, so the equations are smooth wherever an impact sits in the period, through folds, and through
grazing. What they do not say is that nothing happens in between: that is for the impact map to verify.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import contacts, flights
from vijax.runtime import ring_solve
from vijax.runtime.arrays import AnyArray
from vijax.runtime.ring_solve import Ring
from vijax.runtime.xla import each

Knots = Float[Array, "impact 3"]
"""Onset time, speed into the wall (> 0) and contact time of each impact."""

_MOST_ITERATIONS = 80  # A damped search ends after these; a neighbour's orbit needs 4 or 5.
_LAST_STEP = 1e-9  # a Newton step this small is the last: the next one would be its square
_FLOOR = 1e-12  # residual at which rounding may keep a search from improving
_LEAST_PACE = 1e-4  # share of Newton's step below which the search has stalled


class Sequence(eqx.Module):
    """Which walls an orbit meets, and how it closes.

    Attributes:
        side: Wall of each impact, -1 or +1; 0 pads to a common width.
        span: Time after which it closes: 2 p for period p, p for a mirror-symmetric orbit closed half way.
        mirrored: Whether it closes onto its mirror image (gamma = 0, p odd).
    """

    side: Int[AnyArray, "*orbit impact"]
    span: Float[AnyArray, "*orbit"]
    mirrored: Bool[AnyArray, "*orbit"]

    @property
    def real(self) -> Bool[AnyArray, "*orbit impact"]:
        """Say which impacts are there."""
        return self.side != 0


class LinearisedEquations(NamedTuple):
    """The equations at a guess: what is missing, and how it changes with every knot (and a parameter, last).

    With w' at the end of every contact, which they hold, and its derivatives in the knot.
    """

    gap: Float[Array, " equation"]
    ring: Ring
    rate: Float[Array, " impact"]
    rate_slope: Float[Array, "impact 3"]

    @property
    def slope(self) -> Float[Array, "equation unknown"]:
        """Give the derivatives as one matrix."""
        return self.ring.dense


class _ImpactEquations(NamedTuple):
    """The equations of a contact and the flight after it, and w' at its end; each in the joint knots."""

    value: Float[Array, "3"]
    slope: Float[Array, "3 5"]
    rate: Float[Array, ""]
    rate_slope: Float[Array, "3"]


def _pieces(pair: ImpactPair, side, onward, knot: Float[Array, "5"]) -> _ImpactEquations:
    """Compute the equations of one contact and the flight after it to the wall `onward`, and their derivatives.

    `knot` ends with the next time and speed. Divided by the contact's length, and by the flight's where it returns to
    its wall: no trivial root at length zero.
    """
    t, speed, stay, next_t, next_speed = knot
    contact = contacts.end(pair, side, t, speed, stay)
    leave, length, out = t + stay, next_t - t - stay, side * contact.rate
    rise, v = flights.flown(pair, leave, out, length)
    # In (onset, speed, stay, next onset, next speed): how each end of the flight moves.
    unit = jnp.eye(5, dtype=knot.dtype)
    d_leave, d_next, d_next_speed = unit[0] + unit[2], unit[3], unit[4]
    d_out = side * jnp.pad(contact.rate_slope, (0, 2))
    push = flights.acceleration(pair, leave)
    d_rise = v * d_next + length * d_out - (out + length * push) * d_leave
    d_v = flights.acceleration(pair, next_t) * d_next + d_out - push * d_leave
    back = side == onward
    place = jnp.where(back, rise / length, rise - onward * pair.d)
    d_place = jnp.where(back, (d_rise - rise / length * (d_next - d_leave)) / length, d_rise)
    value = jnp.stack([contact.place, place, onward * v - next_speed])
    slope = jnp.stack([jnp.pad(contact.place_slope, (0, 2)), d_place, onward * d_v - d_next_speed])
    return _ImpactEquations(value, slope, contact.rate, contact.rate_slope)


def _following(sequence: Sequence):
    """Find the impact after each, its wall, and whether the orbit closes there."""
    width = sequence.side.shape[0]
    index = jnp.arange(width, dtype=jnp.int32)
    closes = index == sequence.real.sum(dtype=jnp.int32) - 1
    after = jnp.where(closes | ~sequence.real, 0, index + 1)
    wall = sequence.side[after] * jnp.where(closes & sequence.mirrored, -1, 1)
    return after, wall, closes


def joined_knots(sequence: Sequence, knots: Knots, onward: Knots | None = None):
    """Give wall, next wall and joint knots of every impact; harmless numbers where there is none.

    The orbit closes onto its own first impact, or leads to that of a next turn where one is given.
    """
    after, wall, closes = _following(sequence)
    later = jnp.where(closes, sequence.span, 0.0)
    follow = knots[after, :2]
    if onward is not None:
        follow = jnp.where(closes[:, None], onward[0, :2], follow)
    joined = jnp.concatenate([knots, (follow[:, 0] + later)[:, None], follow[:, 1:]], axis=1)
    real = sequence.real
    blank = jnp.array([0.0, 1.0, 0.5, 1.0, 1.0], knots.dtype)
    side = jnp.where(real, sequence.side, 1).astype(knots.dtype)
    return side, jnp.where(real, wall, -1).astype(knots.dtype), jnp.where(real[:, None], joined, blank)


def gap(pair: ImpactPair, sequence: Sequence, knots: Knots, onward: Knots | None = None) -> Float[Array, " 3*impact"]:
    """Compute what is missing to an orbit: zero at one, and where there is no impact.

    Args:
        onward: Knots of the next turn, a span earlier than they come, where they differ from those of this one.
    """
    side, wall, joined = joined_knots(sequence, knots, onward)
    pieces = each(partial(_pieces, pair))(side, wall, joined).value
    return jnp.where(sequence.real[:, None], pieces, 0.0).reshape(-1)


def linearise(pair: ImpactPair, sequence: Sequence, knots: Knots, *moved: ImpactPair) -> LinearisedEquations:
    """Compute the equations and their derivatives in the knots, block by block: each involves two neighbours only.

    Args:
        moved: Changes of the pair along parameters, whose derivatives become the last columns.
    """
    side, wall, joined = joined_knots(sequence, knots)

    def parts(pair):
        piece = each(partial(_pieces, pair))(side, wall, joined)
        return piece.value, piece[1:]

    def along(change):
        return jax.jvp(parts, (pair,), (change,), has_aux=True)

    if moved:
        # All in one: equations that each derivative computed anew would be most of what is compiled of a curve.
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *moved)
        pieces, changes, (blocks, *rates) = jax.vmap(along, out_axes=(None, -1, None))(together)
    else:
        pieces, (blocks, *rates) = parts(pair)
        changes = jnp.zeros((*pieces.shape, 0), knots.dtype)
    real, dtype = sequence.real[:, None, None], knots.dtype
    # Where there is no impact the identity keeps the matrix regular, and the step there zero.
    ring = Ring(
        here=jnp.where(real, blocks[..., :3], jnp.eye(3, dtype=dtype)),
        there=jnp.where(real, jnp.pad(blocks[..., 3:], ((0, 0), (0, 0), (0, 1))), 0.0),
        closes=_following(sequence)[2],
        beside=jnp.where(real, changes, 0.0),
        below=jnp.zeros((0, *pieces.shape), dtype),
        corner=jnp.zeros((0, len(moved)), dtype),
    )
    return LinearisedEquations(jnp.where(sequence.real[:, None], pieces, 0.0).reshape(-1), ring, *rates)


class Departure(NamedTuple):
    """The end of each contact and the impact that is to follow it."""

    side: Float[AnyArray, " impact"]
    speed: Float[Array, " impact"]  # away from the wall
    t: Float[Array, " impact"]
    next_side: Float[Array, " impact"]
    next_t: Float[Array, " impact"]
    next_speed: Float[Array, " impact"]
    next_stay: Float[Array, " impact"]


def departures(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Departure:
    """Say how each contact ends, and where the flight after it is to lead."""
    side, _, joined = joined_knots(sequence, knots)
    rate = each(lambda side, knot: contacts.end(pair, side, *knot[:3]).rate)(side, joined)
    return _departure(sequence, knots, rate)


def _departure(sequence: Sequence, knots: Knots, rate: Float[Array, " impact"]) -> Departure:
    side, wall, joined = joined_knots(sequence, knots)
    t, _, stay, next_t, next_speed = joined.T
    return Departure(side, -rate, t + stay, wall, next_t, next_speed, knots[_following(sequence)[0], 2])


def measured(
    pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]
) -> tuple[Float[Array, " orbit"], Departure]:
    """Find the largest violation of the equations by each of a batch, and how its contacts end.

    Where the ends of contacts are uncertain by more than the violation, it is that.
    """
    return jax.vmap(_measured)(pair, sequence, knots)


def _measured(pair: ImpactPair, sequence: Sequence, knots: Knots) -> tuple[Float[Array, ""], Departure]:
    side, wall, joined = joined_knots(sequence, knots)
    piece = each(partial(_pieces, pair))(side, wall, joined)
    missing = jnp.where(sequence.real[:, None], jnp.abs(piece.value), 0.0).max()
    return jnp.maximum(missing, _uncertainty(pair, sequence, knots)), _departure(sequence, knots, piece.rate)


def _uncertainty(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Float[Array, ""]:
    """Estimate by how much the ends of contacts are off beyond rounding, at most."""
    side, _, joined = joined_knots(sequence, knots)
    each_end = jax.vmap(lambda side, knot: contacts.uncertainty(pair, side, *knot[:3]))(side, joined)
    return jnp.where(sequence.real, each_end, 0.0).max()


def possible(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Bool[Array, ""]:
    """Say whether every speed, contact and flight is longer than nothing."""
    side, _, joined = joined_knots(sequence, knots)
    t, speed, stay, next_t, _ = joined.T
    touches = (stay > 0) | pair.hard(side)
    return ((speed > 0) & touches & (next_t - t - stay > 0)).all()


class _Descent(eqx.Module):
    """Newton's search of a batch.

    Attributes:
        knots, step: Where each is, and the full step from there.
        missing, rate: How much is missing there, and w' at the end of every contact.
        pace: The share of the step to try.
        going: Whether a step is tried for less to be missing.
        arrived: Whether the last step has been taken.
        iteration: How many trips there were.
    """

    knots: Float[Array, "orbit impact 3"]
    step: Float[Array, "orbit impact 3"]
    missing: Float[Array, " orbit"]
    rate: Float[Array, "orbit impact"]
    pace: Float[Array, " orbit"]
    going: Bool[Array, " orbit"]
    arrived: Bool[Array, " orbit"]
    iteration: Int[Array, ""]

    @property
    def arrives(self) -> Bool[Array, " orbit"]:
        """Say of which searches the last step is to be taken."""
        close = (self.missing < jnp.inf) & ((_size(self.step) <= _LAST_STEP) | (self.missing < _FLOOR))
        return ~self.going & ~self.arrived & close


def _size(step: Float[Array, "orbit impact 3"]) -> Float[Array, " orbit"]:
    return jnp.abs(step).max(axis=(1, 2))


def _step(linear: LinearisedEquations) -> Knots:
    """Compute Newton's step."""
    step, _ = ring_solve.solve(linear.ring, linear.gap.reshape(-1, 3, 1), jnp.zeros((0, 1), linear.gap.dtype))
    return step[..., 0]


class Solution(NamedTuple):
    """What Newton's search of a batch came to.

    Attributes:
        knots: Of each orbit.
        residual: Its largest violation of the equations; inf where the search stalled, or left what is possible.
        departure: How its contacts end.
    """

    knots: Float[Array, "orbit impact 3"]
    residual: Float[Array, " orbit"]
    departure: Departure


# optimistix in its place (`python benchmarks/newton.py`): Newton without damping takes 1.1 to 1.2 times as long near
# orbits and finds a third fewer from random guesses; the dogleg finds about as many, in 1.3 to 3.4 times the time.
def newton(
    pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"], max_iterations: int = _MOST_ITERATIONS
) -> Solution:
    """Search a batch of orbits by damped Newton: a step that does not shorten what is missing is halved.

    What is missing after the last step, which is taken however that is, is seen in the loop, too: the equations stand
    in the program once.

    Args:
        max_iterations: That a search may take before its last step, one evaluation each; the batch takes as many as its
            slowest search.
    """

    def advance(d: _Descent) -> _Descent:
        arrives = d.arrives
        trial = d.knots - jnp.where(arrives, 1.0, d.pace)[:, None, None] * d.step
        linear = jax.vmap(linearise)(pair, sequence, trial)
        step, missing = jax.vmap(_step)(linear), jnp.abs(linear.gap).max(axis=1)
        # NaN compares false: an overflow is a step too long.
        better = jax.vmap(possible)(pair, sequence, trial) & (missing < (1 - 0.25 * d.pace) * d.missing)
        better = d.going & better & jnp.isfinite(_size(step))
        pace = jnp.where(better, jnp.minimum(2 * d.pace, 1.0), 0.5 * d.pace)
        going = d.going & (pace > _LEAST_PACE) & ~(better & (_size(step) <= _LAST_STEP))
        there = better | arrives
        return _Descent(
            knots=jnp.where(there[:, None, None], trial, d.knots),
            step=jnp.where(better[:, None, None], step, d.step),
            missing=jnp.where(there, missing, d.missing),
            rate=jnp.where(there[:, None], linear.rate, d.rate),
            pace=jnp.where(d.going, pace, d.pace),
            going=going & (d.iteration + 1 < max_iterations),
            arrived=d.arrived | arrives,
            iteration=d.iteration + 1,
        )

    # The first trial is the guess itself.
    zero, far = jnp.zeros_like(knots), jnp.full(knots.shape[0], jnp.inf)
    start = _Descent(knots, zero, far, zero[..., 0], jnp.ones_like(far), far > 0, far < 0, jnp.int32(0))
    end = lax.while_loop(lambda d: (d.going | d.arrives).any(), advance, start)
    residual = jnp.maximum(end.missing, jax.vmap(_uncertainty)(pair, sequence, end.knots))
    arrived = end.arrived & jax.vmap(possible)(pair, sequence, end.knots)
    departure = jax.vmap(_departure)(sequence, end.knots, end.rate)
    return Solution(end.knots, jnp.where(arrived, residual, jnp.inf), departure)
