"""Multiple shooting: a periodic orbit as the root of closed-form equations, three per impact.

The unknowns of an impact are its onset time, its speed into the wall and its contact duration. Its equations: the
penetration is zero at the end of the contact, and the flight after it reaches the next impact in position and speed
(Eqs. (28)-(29) of the paper solve the same for one sequence). The equations contain no search for wall crossings, so
that they are smooth for every position of an impact in the period, also at folds and grazings. They do not exclude
further wall crossings between the impacts; the impact map checks this.
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
from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation.xla import map_lanes
from vijax.runtime.numerics import ring_solve
from vijax.runtime.numerics.ring_solve import BlockRing

ImpactUnknowns = Float[Array, "impact 3"]
"""Unknowns of each impact: onset time, speed into the wall (> 0) and contact duration."""

_MOST_ITERATIONS = 80  # limit of a damped search; 4 or 5 suffice from an orbit at neighbouring parameters
_LAST_STEP = 1e-9  # after a Newton step this small the next one, about its square, is the last
_FLOOR = 1e-12  # residual near rounding, which may prevent any further decrease
_LEAST_FRACTION = 1e-4  # fraction of Newton's step below which the search has stalled


class Sequence(eqx.Module):
    """Walls of the impacts of an orbit, and how it closes.

    Attributes:
        side: Wall of each impact, -1 or +1; 0 pads to a common width.
        span: Time that the stored impacts cover: 2 p for an orbit of period p, or p if `mirrored`.
        mirrored: Whether the impacts are half of a symmetric orbit; its other half is their mirror image (gamma = 0, p
            odd).
    """

    side: Int[AnyArray, "*orbit impact"]
    span: Float[AnyArray, "*orbit"]
    mirrored: Bool[AnyArray, "*orbit"]

    @property
    def real(self) -> Bool[AnyArray, "*orbit impact"]:
        """Mask of the impacts that are not padding."""
        return self.side != 0


class LinearisedEquations(NamedTuple):
    """The equations at a guess, with their derivatives.

    Attributes:
        residuals: Residuals of the equations.
        ring: Derivatives in the unknowns of all impacts in cyclic block form; derivatives in parameters are its last
            columns.
        rate, rate_slope: w' at the end of every contact, and its derivatives in the unknowns of the impact. They are
            by-products of the equations.
    """

    residuals: Float[Array, " equation"]
    ring: BlockRing
    rate: Float[Array, " impact"]
    rate_slope: Float[Array, "impact 3"]

    @property
    def slope(self) -> Float[Array, "equation unknown"]:
        """Return the derivatives as one dense matrix."""
        return self.ring.dense


class _ImpactEquations(NamedTuple):
    """The equations of a contact and the flight after it.

    Attributes:
        value: Residuals: scaled penetration at the end of the contact, deviation in position and speed at the next
            onset.
        slope: Derivatives in (onset, speed, contact duration, next onset, next speed).
        rate, rate_slope: w' at the end of the contact, and its derivatives in the first three.
    """

    value: Float[Array, "3"]
    slope: Float[Array, "3 5"]
    rate: Float[Array, ""]
    rate_slope: Float[Array, "3"]


def _pieces(pair: ImpactPair, side, next_side, unknowns: Float[Array, "5"]) -> _ImpactEquations:
    """Compute the equations of one contact and the flight after it to the wall `next_side`, and their derivatives.

    The first equation is divided by the contact duration. If the flight returns to the same wall, the second equation
    is divided by the flight duration. This removes the trivial roots at duration zero.

    Args:
        pair: Parameters of one cell.
        side, next_side: Walls of this impact and of the next.
        unknowns: Onset, speed and contact duration of this impact, onset and speed of the next.
    """
    t, speed, contact_duration, next_t, next_speed = unknowns
    contact = contacts.end(pair, side, t, speed, contact_duration)
    exit_t, flight_duration, exit_velocity = t + contact_duration, next_t - t - contact_duration, side * contact.rate
    rise, v = flights.advance_flight(pair, exit_t, exit_velocity, flight_duration)
    # Derivatives in (onset, speed, contact duration, next onset, next speed) of the start, the end and the exit
    # velocity of the flight.
    unit = jnp.eye(5, dtype=unknowns.dtype)
    d_leave, d_next, d_next_speed = unit[0] + unit[2], unit[3], unit[4]
    d_out = side * jnp.pad(contact.rate_slope, (0, 2))
    # A later end adds displacement at the final velocity v. A later start removes the exit velocity and the velocity
    # gained by the initial acceleration over the flight.
    push = flights.acceleration(pair, exit_t)
    d_rise = v * d_next + flight_duration * d_out - (exit_velocity + flight_duration * push) * d_leave
    d_v = flights.acceleration(pair, next_t) * d_next + d_out - push * d_leave
    returns_to_wall = side == next_side
    place = jnp.where(returns_to_wall, rise / flight_duration, rise - next_side * pair.d)
    d_place = jnp.where(
        returns_to_wall, (d_rise - rise / flight_duration * (d_next - d_leave)) / flight_duration, d_rise
    )
    value = jnp.stack([contact.scaled_penetration, place, next_side * v - next_speed])
    slope = jnp.stack([jnp.pad(contact.scaled_penetration_slope, (0, 2)), d_place, next_side * d_v - d_next_speed])
    return _ImpactEquations(value, slope, contact.rate, contact.rate_slope)


def _following(sequence: Sequence):
    """Return for each impact the index and the wall of the next impact, and whether the orbit closes there."""
    width = sequence.side.shape[0]
    index = jnp.arange(width, dtype=jnp.int32)
    closes = index == sequence.real.sum(dtype=jnp.int32) - 1
    after = jnp.where(closes | ~sequence.real, 0, index + 1)
    wall = sequence.side[after] * jnp.where(closes & sequence.mirrored, -1, 1)
    return after, wall, closes


def joined_unknowns(sequence: Sequence, impact_unknowns: ImpactUnknowns, next_turn: ImpactUnknowns | None = None):
    """Return wall, next wall and joint unknowns of every impact.

    The joint unknowns are the three of the impact, and the next onset and speed. Padding has (0, 1, 0.5, 1, 1), at
    which the equations are finite.

    The orbit closes onto its own first impact, or onto the first impact of `next_turn` if specified.
    """
    after, wall, closes = _following(sequence)
    # The impact after the last is the first one, a span later.
    shift = jnp.where(closes, sequence.span, 0.0)
    following = impact_unknowns[after, :2]
    if next_turn is not None:
        following = jnp.where(closes[:, None], next_turn[0, :2], following)
    joined = jnp.concatenate([impact_unknowns, (following[:, 0] + shift)[:, None], following[:, 1:]], axis=1)
    real = sequence.real
    blank = jnp.array([0.0, 1.0, 0.5, 1.0, 1.0], impact_unknowns.dtype)
    side = jnp.where(real, sequence.side, 1).astype(impact_unknowns.dtype)
    return side, jnp.where(real, wall, -1).astype(impact_unknowns.dtype), jnp.where(real[:, None], joined, blank)


def residuals(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, next_turn: ImpactUnknowns | None = None
) -> Float[Array, " 3*impact"]:
    """Compute the residuals of the equations: zero at an orbit, and for padded impacts.

    Args:
        pair, sequence, impact_unknowns: A guess.
        next_turn: Impact unknowns of the next repetition, with times reduced by one span. Default: equal to
            `impact_unknowns`.
    """
    side, wall, joined = joined_unknowns(sequence, impact_unknowns, next_turn)
    pieces = map_lanes(partial(_pieces, pair))(side, wall, joined).value
    return jnp.where(sequence.real[:, None], pieces, 0.0).reshape(-1)


def linearise(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, *moved: ImpactPair
) -> LinearisedEquations:
    """Compute the equations and their derivatives in blocks, because each equation involves two neighbouring impacts.

    Args:
        pair, sequence, impact_unknowns: A guess.
        moved: Derivative of the pair by each parameter; the derivatives of the equations by the parameters are the last
            columns.
    """
    side, wall, joined = joined_unknowns(sequence, impact_unknowns)

    def parts(pair):
        piece = map_lanes(partial(_pieces, pair))(side, wall, joined)
        return piece.value, piece[1:]

    def along(change):
        return jax.jvp(parts, (pair,), (change,), has_aux=True)

    if moved:
        # One vmapped derivative for all parameters. Separate derivatives would repeat the equations, which are most of
        # the code that XLA compiles for a curve.
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *moved)
        pieces, changes, (blocks, *rates) = jax.vmap(along, out_axes=(None, -1, None))(together)
    else:
        pieces, (blocks, *rates) = parts(pair)
        changes = jnp.zeros((*pieces.shape, 0), impact_unknowns.dtype)
    real, dtype = sequence.real[:, None, None], impact_unknowns.dtype
    # For padded impacts the identity keeps the matrix regular, and their step zero.
    ring = BlockRing(
        # Columns 0 to 2 belong to the impact itself, columns 3 and 4 to onset and speed of the next one.
        diagonal=jnp.where(real, blocks[..., :3], jnp.eye(3, dtype=dtype)),
        next_block=jnp.where(real, jnp.pad(blocks[..., 3:], ((0, 0), (0, 0), (0, 1))), 0.0),
        is_closing=_following(sequence)[2],
        border_columns=jnp.where(real, changes, 0.0),
        border_rows=jnp.zeros((0, *pieces.shape), dtype),
        border_corner=jnp.zeros((0, len(moved)), dtype),
    )
    return LinearisedEquations(jnp.where(sequence.real[:, None], pieces, 0.0).reshape(-1), ring, *rates)


class ContactExits(NamedTuple):
    """The end of each contact, and the impact that should follow it by the equations.

    Attributes:
        side, speed, t: The wall, the speed away from it, and the time of the end.
        next_side, next_t, next_speed, next_contact_duration: The next impact.
    """

    side: Float[AnyArray, " impact"]
    speed: Float[Array, " impact"]
    t: Float[Array, " impact"]
    next_side: Float[Array, " impact"]
    next_t: Float[Array, " impact"]
    next_speed: Float[Array, " impact"]
    next_contact_duration: Float[Array, " impact"]


def contact_exits(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> ContactExits:
    """Compute the end of each contact, and the next impact by the equations."""
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    rate = map_lanes(lambda side, unknowns: contacts.end(pair, side, *unknowns[:3]).rate)(side, joined)
    return _contact_exits(sequence, impact_unknowns, rate)


def _contact_exits(sequence: Sequence, impact_unknowns: ImpactUnknowns, rate: Float[Array, " impact"]) -> ContactExits:
    side, wall, joined = joined_unknowns(sequence, impact_unknowns)
    t, _, contact_duration, next_t, next_speed = joined.T
    return ContactExits(
        side, -rate, t + contact_duration, wall, next_t, next_speed, impact_unknowns[_following(sequence)[0], 2]
    )


def measure_residuals(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[Array, "orbit impact 3"]
) -> tuple[Float[Array, " orbit"], ContactExits]:
    """Compute the largest absolute residual of each candidate of a batch, and the ends of its contacts.

    If a membrane law has no closed form, the result is at least the estimated error of the integrated contacts.
    """
    return jax.vmap(_measure_residuals)(pair, sequence, impact_unknowns)


def _measure_residuals(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns
) -> tuple[Float[Array, ""], ContactExits]:
    side, wall, joined = joined_unknowns(sequence, impact_unknowns)
    piece = map_lanes(partial(_pieces, pair))(side, wall, joined)
    residual = jnp.where(sequence.real[:, None], jnp.abs(piece.value), 0.0).max()
    return jnp.maximum(residual, _uncertainty(pair, sequence, impact_unknowns)), _contact_exits(
        sequence, impact_unknowns, piece.rate
    )


def _uncertainty(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> Float[Array, ""]:
    """Return the largest estimated error of the ends of contacts beyond rounding."""
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    errors = jax.vmap(lambda side, unknowns: contacts.uncertainty(pair, side, *unknowns[:3]))(side, joined)
    return jnp.where(sequence.real, errors, 0.0).max()


def has_positive_durations(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> Bool[Array, ""]:
    """Return True if every speed, contact duration (at soft walls) and flight duration is positive."""
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    t, speed, contact_duration, next_t, _ = joined.T
    has_contact = (contact_duration > 0) | pair.is_rigid_at(side)
    return ((speed > 0) & has_contact & (next_t - t - contact_duration > 0)).all()


class _Descent(eqx.Module):
    """State of Newton's method for a batch.

    Attributes:
        impact_unknowns, step: Current impact unknowns, and the full Newton step from them.
        largest_residual, rate: Largest absolute residual at the current unknowns, and w' at the end of every contact.
        fraction: Fraction of the step to try next.
        searching: Whether further steps are tried to reduce the residual.
        finished: Whether the last step has been taken.
        iteration: Number of loop iterations so far.
    """

    impact_unknowns: Float[Array, "orbit impact 3"]
    step: Float[Array, "orbit impact 3"]
    largest_residual: Float[Array, " orbit"]
    rate: Float[Array, "orbit impact"]
    fraction: Float[Array, " orbit"]
    searching: Bool[Array, " orbit"]
    finished: Bool[Array, " orbit"]
    iteration: Int[Array, ""]

    @property
    def arrives(self) -> Bool[Array, " orbit"]:
        """Mask of the searches that take their last step now."""
        # A search stops at a small step or at the floor of rounding, but only after a finite residual.
        close = (self.largest_residual < jnp.inf) & (
            (_size(self.step) <= _LAST_STEP) | (self.largest_residual < _FLOOR)
        )
        return ~self.searching & ~self.finished & close


def _size(step: Float[Array, "orbit impact 3"]) -> Float[Array, " orbit"]:
    return jnp.abs(step).max(axis=(1, 2))


def _step(linear: LinearisedEquations) -> ImpactUnknowns:
    """Compute Newton's step."""
    # The cyclic block structure is solved in linear time in the number of impacts.
    step, _ = ring_solve.solve(
        linear.ring, linear.residuals.reshape(-1, 3, 1), jnp.zeros((0, 1), linear.residuals.dtype)
    )
    return step[..., 0]


class Solution(NamedTuple):
    """Result of Newton's method for a batch.

    Attributes:
        impact_unknowns: Impact unknowns of each orbit.
        residual: Largest absolute residual of its equations; inf where the search stalled, or a speed or duration
            became negative.
        exits: The ends of its contacts.
    """

    impact_unknowns: Float[Array, "orbit impact 3"]
    residual: Float[Array, " orbit"]
    exits: ContactExits


# Compared with optimistix (`python benchmarks/newton.py`): its Newton method without damping takes 1.1 to 1.2 times as
# long near orbits and finds a third fewer from random guesses; its dogleg finds about as many, in 1.3 to 3.4 times the
# time.
def newton(
    pair: ImpactPair,
    sequence: Sequence,
    impact_unknowns: Float[Array, "orbit impact 3"],
    max_iterations: int = _MOST_ITERATIONS,
) -> Solution:
    """Solve a batch by damped Newton's method: a step that does not reduce the residual is halved.

    After convergence one last full step is taken regardless of the residual after it. This step runs in the same loop,
    so that the compiled program contains the equations only once.

    Args:
        pair, sequence, impact_unknowns: Guesses, with a leading axis.
        max_iterations: Most iterations of a search before its last step, each with one evaluation of the equations; the
            batch takes as many iterations as its slowest search.
    """

    def advance(state: _Descent) -> _Descent:
        arrives = state.arrives
        trial = state.impact_unknowns - jnp.where(arrives, 1.0, state.fraction)[:, None, None] * state.step
        linear = jax.vmap(linearise)(pair, sequence, trial)
        step, trial_residual = jax.vmap(_step)(linear), jnp.abs(linear.residuals).max(axis=1)
        # Armijo condition on the residual. NaN compares as False, so that an overflow counts as a failed step.
        is_better = jax.vmap(has_positive_durations)(pair, sequence, trial) & (
            trial_residual < (1 - 0.25 * state.fraction) * state.largest_residual
        )
        is_better = state.searching & is_better & jnp.isfinite(_size(step))
        # The fraction doubles after success, up to the full step, and halves after failure.
        fraction = jnp.where(is_better, jnp.minimum(2 * state.fraction, 1.0), 0.5 * state.fraction)
        searching = state.searching & (fraction > _LEAST_FRACTION) & ~(is_better & (_size(step) <= _LAST_STEP))
        accepted = is_better | arrives
        return _Descent(
            impact_unknowns=jnp.where(accepted[:, None, None], trial, state.impact_unknowns),
            step=jnp.where(is_better[:, None, None], step, state.step),
            largest_residual=jnp.where(accepted, trial_residual, state.largest_residual),
            rate=jnp.where(accepted[:, None], linear.rate, state.rate),
            fraction=jnp.where(state.searching, fraction, state.fraction),
            searching=searching & (state.iteration + 1 < max_iterations),
            finished=state.finished | arrives,
            iteration=state.iteration + 1,
        )

    # The first trial is the guess itself, because the initial step is 0 and the initial residual inf.
    zero, far = jnp.zeros_like(impact_unknowns), jnp.full(impact_unknowns.shape[0], jnp.inf)
    start = _Descent(impact_unknowns, zero, far, zero[..., 0], jnp.ones_like(far), far > 0, far < 0, jnp.int32(0))
    end = lax.while_loop(lambda state: (state.searching | state.arrives).any(), advance, start)
    # For membrane laws, the residual is at least the estimated error of the integrated contacts.
    residual = jnp.maximum(end.largest_residual, jax.vmap(_uncertainty)(pair, sequence, end.impact_unknowns))
    is_converged = end.finished & jax.vmap(has_positive_durations)(pair, sequence, end.impact_unknowns)
    exits = jax.vmap(_contact_exits)(sequence, end.impact_unknowns, end.rate)
    return Solution(end.impact_unknowns, jnp.where(is_converged, residual, jnp.inf), exits)
