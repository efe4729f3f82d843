"""The regular impact in straight-line arithmetic: one flight without gravity and one contact, certified or declined.

Elementwise over lanes: fixed rounds, polynomial sine, cosine and exponential on known ranges, no library call. A lane
whose impact is not certified to be the first and converged to rounding is declined, and `exact.step` does it instead.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.exact import stick_speed
from vijax.engine.impact import Arrival, Ball, Hit, Lane
from vijax.engine.quick_contact import Wall, touch
from vijax.engine.quick_flight import fly
from vijax.model import energy


def through(contact: tuple[Lane, ...], elapsed: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Tangent map (row by row) of a flight and the contact after it."""
    a, b, c, d = contact
    return a, a * elapsed + b, c, c * elapsed + d


class Quick(NamedTuple):
    """What the quick step made of every lane."""

    hit: Hit
    arrival: Arrival
    sure: Bool[Array, "lane"]  # whether all of the hit is certain
    never: Bool[Array, "lane"]  # will meet no wall again


def quick_step(wall: Wall, gamma: Lane, lane: Ball, *, deep: bool = False, tangent: bool = False) -> Quick:
    """One impact of every lane by the regular path; gamma must be 0.

    Args:
        deep: Also find the greatest depth and the work given to the membrane.
        tangent: Also give the tangent map of the step, flight and saltations included.
    """
    flight = fly(wall.half, lane)
    side = flight.flip * flight.wall
    arrival = Arrival(flight.elapsed, flight.speed, side, flight.sure & ~flight.never)
    onset = lane.t + flight.elapsed
    passed = jnp.floor(0.5 * onset)
    onset_t, onset_n = onset - 2 * passed, lane.n + passed
    v_in = side * flight.speed
    depth = work = contact = None
    if wall.kappa is None:
        out, duration = wall.r * flight.speed, jnp.zeros_like(onset)
        leave_t, leave_n = onset_t, onset_n
        sure = out > 10 * stick_speed(out.dtype)
        if deep:
            depth, work = wall.chi * flight.speed, energy.membrane_work_rigid(v_in, wall.r)
        if tangent:
            # In the frame of the wall the acceleration there is -sine.
            contact = (-wall.r, jnp.zeros_like(out), -(1 + wall.r) * flight.sine / flight.speed, -wall.r)
    else:
        left, depth, sure = touch(wall, flight, deep)
        duration, out = left.duration, left.speed
        leave = onset_t + duration
        passed = jnp.floor(0.5 * leave)
        leave_t, leave_n = leave - 2 * passed, onset_n + passed
        if deep:
            work = energy.membrane_work(wall.kappa, 2 * wall.zeta, gamma, side, onset_t, duration, v_in, -side * out)
        if tangent:
            h = left.decay * left.sine / wall.omega1
            slope = left.decay * left.cosine - wall.zeta * h
            contact = (slope, h, -wall.kappa * wall.kappa * h, slope + 2 * wall.zeta * h)
    matrix = None if contact is None else through(contact, flight.elapsed)
    after = Ball(side * wall.half, -side * out, leave_t, leave_n)
    hit = Hit(onset_t, onset_n, side, v_in, -side * out, flight.elapsed, duration, after, depth, work, matrix)
    return Quick(hit, arrival, sure & arrival.sure, flight.never & flight.sure)
