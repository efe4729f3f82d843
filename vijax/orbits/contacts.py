"""The contacts of an orbit: their ends, their turning points, their tangent maps; with rigid walls and any membrane.

Linear membranes have closed forms, under the sine and under harmonics. Contacts with others are flown by a solver of
fixed steps (`engine.ode_contact`); nothing else of an orbit asks which of the two its membrane is.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.engine import contact_search, ode_contact, turn_search
from vijax.engine.roots import extreme_value
from vijax.engine.taylor import Oscillator, Push
from vijax.model import energy, flow
from vijax.model.flow import Membrane
from vijax.model.pair import ImpactPair
from vijax.model.wave_work import wave_work
from vijax.model.waves import later, pressed, pushing, waves_at
from vijax.runtime.arrays import Scalar, choose


class ContactEnd(NamedTuple):
    """The end of a contact: penetration there over the contact's length, and w'; each in onset, speed and length."""

    place: Float[Array, ""]
    rate: Float[Array, ""]
    place_slope: Float[Array, "3"]
    rate_slope: Float[Array, "3"]


def end(pair: ImpactPair, side, t, speed, stay) -> ContactEnd:
    """Compute the end of a contact, and its derivatives.

    Args:
        pair: One cell.
        side: Of the wall.
        t, speed: Of the onset; the speed is into the wall.
        stay: Length of the contact, which need not end at w = 0 then.
    """

    def rigid(wall: ImpactPair) -> ContactEnd:
        zero, one = jnp.zeros_like(t), jnp.ones_like(t)
        return ContactEnd(stay, -wall.r * speed, jnp.stack([zero, zero, one]), jnp.stack([zero, -wall.r, zero]))

    def soft(wall: ImpactPair) -> ContactEnd:
        if wall.law is not None:
            return _end_of_law(wall, side, t, speed, stay)
        # A contact with a rigid wall beside a soft one has no length to divide by.
        length = jnp.where(pair.hard(side), 0.5, stay) if pair.hard_wall else stay
        return _end_of_linear(wall, side, t, speed, length)

    return pair.met(side, rigid, soft)


def _end_of_linear(wall: ImpactPair, side, t, speed, stay) -> ContactEnd:
    """Do what `end` does by the closed form: all follow from the free response and the forcing at both ends.

    An onset moved at the same length moves the whole motion, less the free motion of what the state at the onset gains.
    Automatic derivatives would run a tangent of the closed form for every unknown, at five times the cost.
    """
    membrane, waves = flow.membrane(wall, rolled=True), waves_at(wall, t)
    w, rate = pressed(membrane, waves, side, wall.gamma, speed, stay)
    h, slope = flow.free_response(membrane, stay)
    square, begin = membrane.kappa * membrane.kappa, side * pushing(waves, wall.gamma)
    push = side * pushing(later(waves, stay), wall.gamma) - membrane.mu * rate - square * w
    onset = rate - slope * speed - h * begin
    rate_onset = push + square * h * speed - slope * (begin - membrane.mu * speed)
    return ContactEnd(
        w / stay,
        rate,
        jnp.stack([onset, h, rate - w / stay]) / stay,
        jnp.stack([rate_onset, slope, push]),
    )


def _end_of_law(wall: ImpactPair, side, t, speed, stay) -> ContactEnd:
    found = ode_contact.end(ode_contact.contact(wall, side, t, speed), stay)
    place = found.w / stay
    there = jnp.array([0.0, 0.0, 1.0], place.dtype) * place
    return ContactEnd(place, found.z, (found.w_slope - there) / stay, found.z_slope)


def uncertainty(pair: ImpactPair, side, t, speed, stay) -> Scalar:
    """Estimate by how much the end of a contact is off beyond rounding: closed forms are not."""
    if pair.law is None:
        return jnp.zeros_like(t)
    return ode_contact.error(ode_contact.contact(pair, side, t, speed), stay)


def within(wall: ImpactPair, side, t, speed, s) -> tuple[Scalar, Scalar]:
    """Compute penetration and rate in a contact with a soft wall, a time s after its onset.

    Args:
        wall: The pair as the wall has it, `ImpactPair.at`.
        side, t, speed: As in `end`.
        s: Time since the onset.
    """
    if wall.law is not None:
        there = ode_contact.held(ode_contact.contact(wall, side, t, speed), s)
        return there.w, there.z
    return pressed(flow.membrane(wall, rolled=True), waves_at(wall, t), side, wall.gamma, speed, s)


def tangent(wall: ImpactPair, side, t, speed, stay) -> Float[Array, "2 2"]:
    """Compute the tangent map of a contact with a soft wall in (du, du'), with the jumps of the force at its ends."""
    if wall.law is None:
        return flow.contact_matrix(flow.membrane(wall, rolled=True), stay)
    # That of (w, w'), as both change sign with the side.
    return ode_contact.tangent(ode_contact.contact(wall, side, t, speed), stay)


def loss(wall: ImpactPair, side, t, speed, stay) -> Scalar:
    """Compute the determinant of `tangent`."""
    if wall.law is None:
        return jnp.exp(-flow.membrane(wall, rolled=True).mu * stay)
    here = tangent(wall, side, t, speed, stay)
    return here[0, 0] * here[1, 1] - here[0, 1] * here[1, 0]


def turns(pair: ImpactPair, side, t, speed, stay, real) -> contact_search.Turns:
    """Find where a contact turns between its onset and its end; a rigid wall has no such points.

    Args:
        pair, side, t, speed, stay: As in `end`.
        real: Whether the contact is there.
    """
    wall, wanted = pair.at(side), real & (stay > 0) & ~pair.hard(side)
    if pair.law is not None:
        found = ode_contact.turns(ode_contact.contact(wall, side, t, speed), stay)
        zero = jnp.zeros_like(t)
        return choose(wanted, found, contact_search.Turns(zero, zero, zero, zero, zero + jnp.inf, zero > 0))
    membrane = flow.membrane(wall, rolled=True)
    if pair.waves is not None:
        return _turns_under_harmonics(wall, membrane, side, t, speed, stay, wanted)
    force = flow.contact_force(pair.gamma, side, t)
    return contact_search.turning_points(membrane, force, jnp.zeros_like(t), speed, wanted, length=stay)


def _turns_under_harmonics(wall: ImpactPair, membrane: Membrane, side, t, speed, stay, wanted) -> contact_search.Turns:
    zero, waves = jnp.zeros_like(t), waves_at(wall, t)
    spring = Oscillator(membrane.kappa, membrane.kappa * membrane.kappa, membrane.mu, zero + jnp.inf)
    push = Push(-wall.gamma, zero, waves).turned(side)
    course = lambda s: pressed(membrane, waves, side, wall.gamma, speed, s)  # noqa: E731
    look = lambda seen, s, w, rises: contact_search.compared(seen, s, w, s > 0, rises)  # noqa: E731
    blank = contact_search.Turns(stay, zero, zero, zero, zero + jnp.inf, zero > 0)
    seen, lost = turn_search.visit_turns(spring, push, course, stay, wanted, look, blank)
    return eqx.tree_at(lambda turns: turns.lost, seen, lost)


class Given(NamedTuple):
    """What a contact gives: its greatest depth, and the energy that the wall gets, per mass of the ball."""

    depth: Float[Array, ""]
    work: Float[Array, ""]


def given(pair: ImpactPair, side, knot: Float[Array, "3"], v_out, crest) -> Given:
    """Compute what a contact gives; the time `crest` of its deepest point moves with all else.

    Args:
        pair, side: As in `end`.
        knot: Onset time, speed into the wall and length of the contact.
        v_out: Velocity after the contact.
        crest: Time since the onset, a constant of differentiation.

    Returns:
        Of a rigid wall the depth of a membrane of kappa = 1 in its place, or 0 beside a soft one.
    """
    t, speed, stay = knot

    def rigid(wall: ImpactPair) -> Given:
        return Given(speed * energy.rigid_depth(wall), energy.membrane_work_rigid(speed, wall.r))

    def soft(wall: ImpactPair) -> Given:
        return _given_to_membrane(wall, side, t, speed, stay, v_out, crest)

    return pair.met(side, rigid, soft)


def _given_to_membrane(wall: ImpactPair, side, t, speed, stay, v_out, crest) -> Given:
    of = wall, side, t, speed
    depth = extreme_value(_rate_and_depth, crest, of)
    if wall.law is not None:
        return Given(depth, ode_contact.held(ode_contact.contact(*of), stay).work)
    if wall.waves is not None:
        ends = speed, side * v_out
        return Given(depth, wave_work(flow.membrane(wall), waves_at(wall, t), wall.gamma, side, stay, ends))
    return Given(depth, energy.membrane_work(wall.kappa, wall.mu, wall.gamma, side, t, stay, side * speed, v_out))


def _rate_and_depth(s: Scalar, of: Any) -> tuple[Scalar, Scalar]:
    wall, side, t, speed = of
    depth, rate = within(wall, side, t, speed, s)
    return rate, depth
