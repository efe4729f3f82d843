"""The regular impact in straight-line arithmetic: one flight and one contact, certified or declined.

Elementwise over lanes: fixed rounds, polynomial sine, cosine and exponential on known ranges, no library call. A lane
whose impact is not certified to be the first and converged to rounding is declined, and `exact.step` does it instead.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.exact import stick_speed
from vijax.engine.impact import Arrival, Ball, Lane, LaneImpact
from vijax.engine.quick_contact import touch
from vijax.engine.quick_flight import Flight, fly
from vijax.engine.quick_inclined_flight import fly as fly_inclined
from vijax.engine.quick_wall import RigidWall, SoftWall, TwoWalls, Wall
from vijax.model import energy
from vijax.model.sides import apart, at
from vijax.runtime.arrays import choose, present


def through(contact: tuple[Lane, ...], elapsed: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Compute the tangent map (row by row) of a flight and the contact after it."""
    a, b, c, d = contact
    return a, a * elapsed + b, c, c * elapsed + d


class Quick(NamedTuple):
    """What the quick step made of every lane."""

    impact: LaneImpact
    arrival: Arrival
    sure: Bool[Array, " lane"]  # whether all of the impact is certain
    never: Bool[Array, " lane"]  # will meet no wall again


class _Onset(NamedTuple):
    """When and how the ball meets a wall."""

    t: Lane
    n: Lane
    side: Lane
    v_in: Lane


class _Exit(NamedTuple):
    """How it leaves: how much later, how fast, how deep it was, and how the contact maps what is near it."""

    duration: Lane
    speed: Lane
    t: Lane
    n: Lane
    depth: Lane | None
    work: Lane | None
    contact: tuple[Lane, Lane, Lane, Lane]
    sure: Bool[Array, " lane"]


def _rebound(wall: RigidWall, flight: Flight, onset: _Onset, deep: bool, work: bool) -> _Exit:
    """Leave a rigid wall, at once."""
    out = wall.r * flight.speed
    # In the frame of the wall the acceleration there is -sine.
    push = flight.sine
    if wall.incline is not None:
        push = push + onset.side * wall.incline.gamma
    contact = (-wall.r, jnp.zeros_like(out), -(1 + wall.r) * push / flight.speed, -wall.r)
    depth = wall.chi * flight.speed if deep else None
    given = energy.membrane_work_rigid(onset.v_in, wall.r) if work else None
    sure = out > 10 * stick_speed(out.dtype)
    return _Exit(jnp.zeros_like(out), out, onset.t, onset.n, depth, given, contact, sure)


def _release(wall: SoftWall, flight: Flight, onset: _Onset, deep: bool, work: bool, gamma: Lane) -> _Exit:
    """Leave a membrane, after a contact."""
    left, depth, sure = touch(wall, flight, deep, work, onset.t + jnp.where(onset.side < 0, 1.0, 0.0))
    duration, out = left.duration, left.speed
    leave = onset.t + duration
    passed = jnp.floor(0.5 * leave)
    given = None
    if work:
        # `touch` is sure of no short contact, and the flight knows the forcing at its end.
        c, q = -flight.sine, flight.cosine
        force = c, q, c if wall.incline is None else c - onset.side * gamma
        turn = duration, *present(left.drive)
        given = energy.long_contact_work(wall.kappa, 2 * wall.zeta, force, turn, (flight.speed, -out))
    h = left.decay * left.sine / wall.omega1
    slope = left.decay * left.cosine - wall.zeta * h
    contact = (slope, h, -wall.kappa * wall.kappa * h, slope + 2 * wall.zeta * h)
    return _Exit(duration, out, leave - 2 * passed, onset.n + passed, depth, given, contact, sure)


def quick_step(
    walls: TwoWalls, gamma: Lane, lane: Ball, *, deep: bool = False, work: bool = False, tangent: bool = False
) -> Quick:
    """Take every lane one impact on by the regular path.

    Args:
        walls: Made for ground that gamma fits.
        deep: Also find the greatest depth.
        work: Also find the work given to the membrane.
        tangent: Also give the tangent map of the step, flight and saltations included.
    """
    both = apart(walls)
    room = both.left
    flight = fly(room.half, lane) if room.incline is None else fly_inclined(room.half, room.incline, lane)
    side = flight.flip * flight.wall
    arrival = Arrival(flight.elapsed, flight.speed, side, flight.sure & ~flight.never)
    meets = lane.t + flight.elapsed
    passed = jnp.floor(0.5 * meets)
    onset = _Onset(meets - 2 * passed, lane.n + passed, side, v_in=side * flight.speed)

    def leave(wall: Wall) -> _Exit:
        if isinstance(wall, RigidWall):
            return _rebound(wall, flight, onset, deep, work)
        return _release(wall, flight, onset, deep, work, gamma)

    if type(both.left) is type(both.right):
        leaves = leave(at(walls, side))
    else:
        # One of each kind: what both do is computed, and every lane takes that of its wall.
        leaves = choose(side > 0, leave(both.right), leave(both.left))
    impact = LaneImpact(
        onset.t,
        onset.n,
        side,
        v_in=onset.v_in,
        v_out=-side * leaves.speed,
        flight=flight.elapsed,
        duration=leaves.duration,
        after=Ball(side * room.half, -side * leaves.speed, leaves.t, leaves.n),
        depth=leaves.depth,
        work=leaves.work,
        tangent=through(leaves.contact, flight.elapsed) if tangent else None,
    )
    return Quick(impact, arrival, leaves.sure & arrival.sure, flight.never & flight.sure)
