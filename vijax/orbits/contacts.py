"""The contacts of an orbit: state at the end, turning points, tangent map, depth and work; for rigid and soft walls.

Linear membranes have closed forms, under the sine and under harmonics (Eqs. (20)-(23) of the paper, corrected). For
other membrane laws `impact.ode.ode_contact` integrates the contact with a fixed number of steps. All other modules of
`orbits` call the functions below and do not distinguish the two cases.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.impact.exact import contact_search, turn_search
from vijax.impact.ode import ode_contact
from vijax.impact.roots import extreme_value
from vijax.impact.taylor.taylor import Oscillator, Push
from vijax.model import energy, flow
from vijax.model.flow import Membrane
from vijax.model.forcing.harmonic_work import harmonic_contact_work
from vijax.model.forcing.waves import contact_motion, forcing_acceleration, waves_at, waves_later
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Scalar, select


class ContactEnd(NamedTuple):
    """Penetration and rate at the end of a contact, with derivatives in (onset time, entry speed, contact duration).

    Attributes:
        scaled_penetration: Penetration w divided by the contact duration; the contact duration itself at a rigid wall.
            Zero at a true exit. The division removes the trivial root at duration zero.
        rate: Rate w' at the end of the contact.
        scaled_penetration_slope, rate_slope: Derivatives of `scaled_penetration` and of `rate` in the three unknowns.
    """

    scaled_penetration: Float[Array, ""]
    rate: Float[Array, ""]
    scaled_penetration_slope: Float[Array, "3"]
    rate_slope: Float[Array, "3"]


def end(pair: ImpactPair, side, t, speed, contact_duration) -> ContactEnd:
    """Compute penetration and rate at the end of a contact, with derivatives.

    Args:
        pair: Parameters of one cell.
        side: The wall, -1 or +1.
        t, speed: Time and speed of the onset; the speed is positive into the wall.
        contact_duration: Duration of the contact. The penetration w need not vanish at its end, because the duration
            may be a guess.
    """

    def rigid(wall: ImpactPair) -> ContactEnd:
        zero, one = jnp.zeros_like(t), jnp.ones_like(t)
        return ContactEnd(
            contact_duration, -wall.r * speed, jnp.stack([zero, zero, one]), jnp.stack([zero, -wall.r, zero])
        )

    def soft(wall: ImpactPair) -> ContactEnd:
        if wall.law is not None:
            return _end_of_law(wall, side, t, speed, contact_duration)
        # If one wall is rigid and the other soft, the soft branch is evaluated for both walls. A contact with the rigid
        # wall has duration 0; the placeholder 0.5 avoids a division by zero.
        length = jnp.where(pair.is_rigid_at(side), 0.5, contact_duration) if pair.rigid_side else contact_duration
        return _end_of_linear(wall, side, t, speed, length)

    return pair.by_wall_kind(side, rigid, soft)


def _end_of_linear(wall: ImpactPair, side, t, speed, contact_duration) -> ContactEnd:
    """Compute `end` for a linear membrane in closed form.

    All derivatives follow from the free response (the motion of the membrane without forcing) and the forcing at both
    ends. If the onset moves at constant contact duration, the motion is shifted in time, except for the free response
    to the change of the initial state. Automatic differentiation would propagate one tangent of the closed form for
    each unknown, at five times the cost.
    """
    membrane, waves = flow.membrane(wall, rolled=True), waves_at(wall, t)
    w, rate = contact_motion(membrane, waves, side, wall.gamma, speed, contact_duration)
    # h is the free response to a unit speed (h(0) = 0, h'(0) = 1), slope its rate.
    h, slope = flow.free_response(membrane, contact_duration)
    square, begin = membrane.kappa * membrane.kappa, side * forcing_acceleration(waves, wall.gamma)
    push = (
        side * forcing_acceleration(waves_later(waves, contact_duration), wall.gamma) - membrane.mu * rate - square * w
    )
    # Derivatives by the onset time, by time translation: the rate of change at the end, w' or w'' = push, minus the
    # free response to the rate of change (speed, begin - mu speed) of the entry state (w, w').
    onset = rate - slope * speed - h * begin
    rate_onset = push + square * h * speed - slope * (begin - membrane.mu * speed)
    return ContactEnd(
        w / contact_duration,
        rate,
        jnp.stack([onset, h, rate - w / contact_duration]) / contact_duration,
        jnp.stack([rate_onset, slope, push]),
    )


def _end_of_law(wall: ImpactPair, side, t, speed, contact_duration) -> ContactEnd:
    located = ode_contact.contact_endpoint(ode_contact.contact(wall, side, t, speed), contact_duration)
    scaled_penetration = located.w / contact_duration
    # Quotient rule: only the third unknown, the contact duration, changes the divisor.
    by_duration = jnp.array([0.0, 0.0, 1.0], scaled_penetration.dtype) * scaled_penetration
    return ContactEnd(
        scaled_penetration, located.z, (located.w_slope - by_duration) / contact_duration, located.z_slope
    )


def uncertainty(pair: ImpactPair, side, t, speed, contact_duration) -> Scalar:
    """Estimate the integration error at the end of a contact; 0 for linear membranes, which have a closed form."""
    if pair.law is None:
        return jnp.zeros_like(t)
    return ode_contact.error_estimate(ode_contact.contact(pair, side, t, speed), contact_duration)


def penetration_and_rate(wall: ImpactPair, side, t, speed, s) -> tuple[Scalar, Scalar]:
    """Compute penetration and rate in a contact with a soft wall, at a time s after its onset.

    Args:
        wall: Parameters at the wall of the contact, from `ImpactPair.at`.
        side, t, speed: As in `end`.
        s: Time since the onset.
    """
    if wall.law is not None:
        state = ode_contact.contact_state_at(ode_contact.contact(wall, side, t, speed), s)
        return state.w, state.z
    return contact_motion(flow.membrane(wall, rolled=True), waves_at(wall, t), side, wall.gamma, speed, s)


def tangent_map(wall: ImpactPair, side, t, speed, contact_duration) -> Float[Array, "2 2"]:
    """Compute the tangent map of a contact with a soft wall in (du, du'), including the force jumps at its ends."""
    if wall.law is None:
        return flow.contact_matrix(flow.membrane(wall, rolled=True), contact_duration)
    # The map of (w, w') and the map of (u, u') are equal, because both components change sign with the side.
    return ode_contact.tangent_map(ode_contact.contact(wall, side, t, speed), contact_duration)


def tangent_determinant(wall: ImpactPair, side, t, speed, contact_duration) -> Scalar:
    """Compute the determinant of `tangent_map`: exp(-mu contact_duration) for linear membranes."""
    if wall.law is None:
        return jnp.exp(-flow.membrane(wall, rolled=True).mu * contact_duration)
    matrix = tangent_map(wall, side, t, speed, contact_duration)
    # A law may damp nonlinearly, so that the determinant has no closed form.
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]


def turning_points(pair: ImpactPair, side, t, speed, contact_duration, real) -> contact_search.TurningPoints:
    """Locate the turning points of a contact between its onset and its end; a rigid wall has none.

    Args:
        pair, side, t, speed, contact_duration: As in `end`.
        real: Whether the contact exists; False for padding.
    """
    wall, exists = pair.at(side), real & (contact_duration > 0) & ~pair.is_rigid_at(side)
    if pair.law is not None:
        turns_of_law = ode_contact.turning_points(ode_contact.contact(wall, side, t, speed), contact_duration)
        zero = jnp.zeros_like(t)
        return select(
            exists, turns_of_law, contact_search.TurningPoints(zero, zero, zero, zero, zero + jnp.inf, zero > 0)
        )
    membrane = flow.membrane(wall, rolled=True)
    if pair.waves is not None:
        return _turns_under_harmonics(wall, membrane, side, t, speed, contact_duration, exists)
    force = flow.contact_force(pair.gamma, side, t)
    return contact_search.turning_points(
        membrane, force, jnp.zeros_like(t), speed, exists, contact_duration=contact_duration
    )


def _turns_under_harmonics(
    wall: ImpactPair, membrane: Membrane, side, t, speed, contact_duration, exists
) -> contact_search.TurningPoints:
    zero, waves = jnp.zeros_like(t), waves_at(wall, t)
    spring = Oscillator(membrane.kappa, membrane.kappa * membrane.kappa, membrane.mu, zero + jnp.inf)
    push = Push(-wall.gamma, zero, waves).turned(side)
    state_at = lambda s: contact_motion(membrane, waves, side, wall.gamma, speed, s)  # noqa: E731
    update = lambda visited, s, w, rises: contact_search.record_turning_point(visited, s, w, s > 0, rises)  # noqa: E731
    # Initial record: no minimum so far (lowest inf), no failure.
    initial = contact_search.TurningPoints(contact_duration, zero, zero, zero, zero + jnp.inf, zero > 0)
    visited, failed = turn_search.visit_turns(spring, push, state_at, contact_duration, exists, update, initial)
    return eqx.tree_at(lambda turns: turns.failed, visited, failed)


class DepthAndWork(NamedTuple):
    """Largest penetration of a contact, and energy that the wall receives from it, per mass of the ball."""

    depth: Float[Array, ""]
    work: Float[Array, ""]


def depth_and_work(pair: ImpactPair, side, unknowns: Float[Array, "3"], v_out, crest) -> DepthAndWork:
    """Compute depth and work of a contact from the time `crest` of its deepest point.

    Args:
        pair, side: As in `end`.
        unknowns: Onset time, speed into the wall and contact duration.
        v_out: Velocity after the contact.
        crest: Time from the onset to the deepest point. Under differentiation it is not an independent variable.

    Returns:
        Depth and work. For a rigid wall, the depth is computed for a membrane of kappa = 1 in its place; it is 0 if the
        other wall is soft.
    """
    t, speed, contact_duration = unknowns

    def rigid(wall: ImpactPair) -> DepthAndWork:
        return DepthAndWork(speed * energy.rigid_depth(wall), energy.membrane_work_rigid(speed, wall.r))

    def soft(wall: ImpactPair) -> DepthAndWork:
        return _soft_depth_and_work(wall, side, t, speed, contact_duration, v_out, crest)

    return pair.by_wall_kind(side, rigid, soft)


def _soft_depth_and_work(wall: ImpactPair, side, t, speed, contact_duration, v_out, crest) -> DepthAndWork:
    inputs = wall, side, t, speed
    # `extreme_value` differentiates the largest penetration, a maximum in time where the rate vanishes.
    depth = extreme_value(_rate_and_depth, crest, inputs)
    if wall.law is not None:
        return DepthAndWork(depth, ode_contact.contact_state_at(ode_contact.contact(*inputs), contact_duration).work)
    if wall.waves is not None:
        ends = speed, side * v_out
        return DepthAndWork(
            depth,
            harmonic_contact_work(flow.membrane(wall), waves_at(wall, t), wall.gamma, side, contact_duration, ends),
        )
    return DepthAndWork(
        depth, energy.membrane_work(wall.kappa, wall.mu, wall.gamma, side, t, contact_duration, side * speed, v_out)
    )


def _rate_and_depth(s: Scalar, inputs: Any) -> tuple[Scalar, Scalar]:
    wall, side, t, speed = inputs
    depth, rate = penetration_and_rate(wall, side, t, speed, s)
    return rate, depth
