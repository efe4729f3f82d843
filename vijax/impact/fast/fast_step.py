"""Fast step: one flight and one contact of every lane in straight-line arithmetic, certified or declined.

All operations are elementwise over lanes: a fixed number of iterations, polynomials for sine, cosine and exponential on
bounded ranges, and no library call. A lane is declined unless its impact is certified to be the first one and converged
to rounding; a fallback step (in the end `exact_step.step`) computes it instead.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.exact.exact_step import stick_speed
from vijax.impact.fast.fast_contact import fast_contact
from vijax.impact.fast.fast_flight import Flight, fast_flight
from vijax.impact.fast.fast_gravity_flight import fast_gravity_flight
from vijax.impact.fast.fast_walls import RigidWall, SoftWall, TwoWalls, Wall
from vijax.impact.impact import Arrival, BallState, Lane, LaneImpact
from vijax.model import energy
from vijax.model.walls.sides import as_sides, at_wall
from vijax.runtime.arrays import not_none, select


def compose_tangent(contact: tuple[Lane, ...], elapsed: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Return the tangent map (row by row) of a flight of duration `elapsed` and the contact after it."""
    a, b, c, d = contact
    return a, a * elapsed + b, c, c * elapsed + d


class FastResult(NamedTuple):
    """Result of the fast step in every lane.

    Attributes:
        impact: The impact; it has a meaning only where `certified`.
        arrival: End of the flight.
        certified: The whole impact is certified.
        escapes: The ball is certified to reach no wall again.
    """

    impact: LaneImpact
    arrival: Arrival
    certified: Bool[Array, " lane"]
    escapes: Bool[Array, " lane"]


class _Onset(NamedTuple):
    """Time, side and velocity of an onset."""

    t: Lane
    n: Lane
    side: Lane
    v_in: Lane


class _Exit(NamedTuple):
    """Exit of a contact.

    Attributes:
        duration: Contact duration.
        speed: Speed away from the wall.
        t, n: Phase and period of the exit.
        depth: Largest penetration.
        work: Energy given to the wall.
        contact: Tangent map of the contact, row by row.
        certified: The contact is certified.
    """

    duration: Lane
    speed: Lane
    t: Lane
    n: Lane
    depth: Lane | None
    work: Lane | None
    contact: tuple[Lane, Lane, Lane, Lane]
    certified: Bool[Array, " lane"]


def _rebound(wall: RigidWall, flight: Flight, onset: _Onset, deep: bool, work: bool) -> _Exit:
    """Return the exit from a rigid wall, which coincides with the onset."""
    out = wall.r * flight.speed
    # The frame of the flight is mirrored to the wall; in it the acceleration at the wall is -sine, plus gravity.
    push = flight.sine
    if wall.gravity is not None:
        push = push + onset.side * wall.gravity.gamma
    contact = (-wall.r, jnp.zeros_like(out), -(1 + wall.r) * push / flight.speed, -wall.r)
    depth = wall.chi * flight.speed if deep else None
    membrane_work = energy.membrane_work_rigid(onset.v_in, wall.r) if work else None
    # A slower ball may stick, so its lane is declined and the fallback decides.
    certified = out > 10 * stick_speed(out.dtype)
    return _Exit(jnp.zeros_like(out), out, onset.t, onset.n, depth, membrane_work, contact, certified)


def _release(wall: SoftWall, flight: Flight, onset: _Onset, deep: bool, work: bool, gamma: Lane) -> _Exit:
    """Return the exit from a membrane."""
    exit_state, depth, certified = fast_contact(wall, flight, deep, work, onset.t + jnp.where(onset.side < 0, 1.0, 0.0))
    duration, out = exit_state.duration, exit_state.speed
    exit_time = onset.t + duration
    periods = jnp.floor(0.5 * exit_time)
    membrane_work = None
    if work:
        # `fast_contact` certifies no contact with omega1 s < 0.25, so the formula for long contacts applies. `flight`
        # holds the forcing at the onset.
        c, q = -flight.sine, flight.cosine
        force = c, q, c if wall.gravity is None else c - onset.side * gamma
        turn = duration, *not_none(exit_state.drive)
        membrane_work = energy.long_contact_work(wall.kappa, 2 * wall.zeta, force, turn, (flight.speed, -out))
    # h is the impulse response of the membrane and `slope` its derivative, at the contact duration.
    h = exit_state.decay * exit_state.sine / wall.omega1
    slope = exit_state.decay * exit_state.cosine - wall.zeta * h
    contact = (slope, h, -wall.kappa * wall.kappa * h, slope + 2 * wall.zeta * h)
    return _Exit(duration, out, exit_time - 2 * periods, onset.n + periods, depth, membrane_work, contact, certified)


def fast_step(
    walls: TwoWalls, gamma: Lane, lane: BallState, *, deep: bool = False, work: bool = False, tangent: bool = False
) -> FastResult:
    """Advance every lane by one impact on the fast path.

    Args:
        walls: Result of `prepare_walls` for a regime of gravity that includes gamma.
        gamma: Gravity parameter of each lane.
        lane: State of the ball in each lane.
        deep: Also compute the largest depth.
        work: Also compute the work given to the membrane.
        tangent: Also compute the tangent map of the step, flight and saltations included.
    """
    sides = as_sides(walls)
    left_wall = sides.left
    flight = (
        fast_flight(left_wall.half, lane)
        if left_wall.gravity is None
        else fast_gravity_flight(left_wall.half, left_wall.gravity, lane)
    )
    side = flight.flip * flight.wall
    arrival = Arrival(flight.elapsed, flight.speed, side, flight.certified & ~flight.escapes)
    onset_time = lane.t + flight.elapsed
    # Whole periods (of length 2) move from the phase to the period counter.
    periods = jnp.floor(0.5 * onset_time)
    onset = _Onset(onset_time - 2 * periods, lane.n + periods, side, v_in=side * flight.speed)

    def exit_of(wall: Wall) -> _Exit:
        if isinstance(wall, RigidWall):
            return _rebound(wall, flight, onset, deep, work)
        return _release(wall, flight, onset, deep, work, gamma)

    if type(sides.left) is type(sides.right):
        exit_state = exit_of(at_wall(walls, side))
    else:
        # One rigid and one soft wall: both exits are computed, and each lane selects the exit of its wall.
        exit_state = select(side > 0, exit_of(sides.right), exit_of(sides.left))
    impact = LaneImpact(
        onset.t,
        onset.n,
        side,
        v_in=onset.v_in,
        v_out=-side * exit_state.speed,
        flight=flight.elapsed,
        duration=exit_state.duration,
        after=BallState(side * left_wall.half, -side * exit_state.speed, exit_state.t, exit_state.n),
        depth=exit_state.depth,
        work=exit_state.work,
        tangent=compose_tangent(exit_state.contact, flight.elapsed) if tangent else None,
    )
    return FastResult(impact, arrival, exit_state.certified & arrival.certified, flight.escapes & flight.certified)
