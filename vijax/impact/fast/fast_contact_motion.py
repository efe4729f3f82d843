"""Closed form of a contact, relative to its onset or to a reference time with polynomials about that time.

w = steady response + exp(-zeta s) (free_cos cos(omega1 s) + free_sin sin(omega1 s)), s the time since the reference.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.fast.fast_flight import Flight
from vijax.impact.fast.fast_walls import SoftWall
from vijax.impact.impact import Lane
from vijax.impact.polynomial import EXP_REACH, REACH, exp, sine_cosine
from vijax.model.flow import PI
from vijax.runtime.compilation.xla import materialise, materialised, reuse_trace


class ContactState(eqx.Module):
    """Penetration w and its derivatives at one time of the contact, with the parts of the closed form.

    The constant response to gravity is not part of the field `w`; `ContactEntry.penetration` adds it. The derivatives
    are complete without it, because at this constant penetration the membrane's force balances gravity.

    `sine` and `cosine` have the argument omega1 s, with s the time since the reference. `decay` is exp(-zeta t), with t
    the time since the onset.
    """

    w: Lane
    rate: Lane
    force: Lane  # periodic part of the forcing
    push: Lane  # w''
    jerk: Lane  # w'''
    drive: Lane  # derivative of the forcing by time
    sine: Lane
    cosine: Lane
    decay: Lane


class ContactCourse(eqx.Module):
    """Coefficients of a contact relative to a reference time: steady response, forcing, free part, and its decay."""

    steady_cos: Lane
    steady_sin: Lane
    force_cos: Lane
    force_sin: Lane
    free_cos: Lane
    free_sin: Lane
    decay: Lane


@reuse_trace
def contact_state_at(wall: SoftWall, course: ContactCourse, s: Lane) -> ContactState:
    """Return the state of the contact at time s after the course's reference."""
    sine, cosine = sine_cosine(wall.omega1 * s)
    drive_sine, drive_cosine = sine_cosine(PI * s)
    decay = materialise(course.decay * exp(-wall.zeta * s))
    # Free part and its quadrature, rotated by omega1 s.
    along = course.free_cos * cosine + course.free_sin * sine
    across = course.free_sin * cosine - course.free_cos * sine
    steady = course.steady_cos * drive_cosine + course.steady_sin * drive_sine
    steady_rate = PI * (course.steady_sin * drive_cosine - course.steady_cos * drive_sine)
    force = course.force_cos * drive_cosine - course.force_sin * drive_sine
    drive = -PI * (course.force_sin * drive_cosine + course.force_cos * drive_sine)
    w = steady + decay * along
    rate = steady_rate + decay * (wall.omega1 * across - wall.zeta * along)
    return _derivatives(wall, w, rate, force, drive, sine, cosine, decay)


def _derivatives(wall: SoftWall, w, rate, force, drive, sine, cosine, decay) -> ContactState:
    """Return the state with w'' and w''' from the equation of motion."""
    push = force - 2 * wall.zeta * rate - wall.kappa * wall.kappa * w
    jerk = drive - 2 * wall.zeta * push - wall.kappa * wall.kappa * rate
    return ContactState(w, rate, force, push, jerk, drive, sine, cosine, decay)


def higher_derivatives(wall: SoftWall, at: ContactState) -> tuple[Lane, Lane]:
    """Return the fourth and the fifth derivative of w."""
    square = wall.kappa * wall.kappa
    snap = -(PI**2) * at.force - 2 * wall.zeta * at.jerk - square * at.push
    return snap, -(PI**2) * at.drive - 2 * wall.zeta * snap - square * at.jerk


def at_reference(wall: SoftWall, course: ContactCourse) -> ContactState:
    """Return the state of the contact at the reference time of its course, without a sine or an exponential."""
    unit, zeros = jnp.ones_like(course.decay), jnp.zeros_like(course.decay)
    w = course.steady_cos + course.decay * course.free_cos
    rate = PI * course.steady_sin + course.decay * (wall.omega1 * course.free_sin - wall.zeta * course.free_cos)
    return _derivatives(wall, w, rate, course.force_cos, -PI * course.force_sin, zeros, unit, course.decay)


def in_reach(wall: SoftWall, s: Lane) -> Bool[Array, " lane"]:
    """Return True where the polynomials that `contact_state_at` uses are valid at s."""
    return (jnp.maximum(wall.omega1, PI) * jnp.abs(s) < REACH) & (wall.zeta * jnp.abs(s) < EXP_REACH)


class ContactEntry(eqx.Module):
    """A contact at its onset: speed into the wall, and coefficients of forcing, steady response and free part.

    Each part has a coefficient of the cosine and one of the sine of the time since the onset (see `entry_of`).
    """

    speed: Lane
    force_cos: Lane
    force_sin: Lane
    steady_cos: Lane
    steady_sin: Lane
    free_cos: Lane
    free_sin: Lane
    pressure: Lane | None  # Constant force into the wall by gravity; None without gravity.
    rest: Lane | None  # Steady penetration under that force.

    def penetration(self, at: ContactState) -> Lane:
        """Return the penetration: the field `w` of the state plus `rest`, the constant penetration under gravity."""
        return at.w if self.rest is None else at.w + self.rest

    @property
    def force(self) -> Lane:
        """Whole forcing at the onset, with gravity."""
        return self.force_cos if self.pressure is None else self.force_cos + self.pressure


@materialised
def entry_of(wall: SoftWall, flight: Flight) -> ContactEntry:
    """Return the forcing and its steady response at the onset of a contact.

    The forcing is force_cos cos(pi s) - force_sin sin(pi s); its steady response is steady_cos cos(pi s) + steady_sin
    sin(pi s).
    """
    force_cos, force_sin = -flight.sine, flight.cosine
    steady_cos = wall.gain_in * force_cos + wall.gain_out * force_sin
    steady_sin = wall.gain_out * force_cos - wall.gain_in * force_sin
    pressure, rest, steady = None, None, steady_cos
    if wall.gravity is not None:
        pressure = -flight.flip * flight.wall * wall.gravity.gamma
        rest = pressure / (wall.kappa * wall.kappa)
        steady = steady_cos + rest
    # The free part satisfies w = 0 and w' = speed at the onset.
    free_sin = (flight.speed - PI * steady_sin - wall.zeta * steady) / wall.omega1
    return ContactEntry(flight.speed, force_cos, force_sin, steady_cos, steady_sin, -steady, free_sin, pressure, rest)


class Reference(eqx.Module):
    """A reference time s after the onset: s, cos and sin of pi s and of omega1 s, and exp(-zeta s)."""

    s: Lane
    drive_cosine: Lane
    drive_sine: Lane
    cosine: Lane
    sine: Lane
    decay: Lane


def course_at(entry: ContactEntry, at: Reference) -> ContactCourse:
    """Return the coefficients of the contact relative to a reference time."""
    return ContactCourse(
        entry.steady_cos * at.drive_cosine + entry.steady_sin * at.drive_sine,
        entry.steady_sin * at.drive_cosine - entry.steady_cos * at.drive_sine,
        entry.force_cos * at.drive_cosine - entry.force_sin * at.drive_sine,
        entry.force_cos * at.drive_sine + entry.force_sin * at.drive_cosine,
        entry.free_cos * at.cosine + entry.free_sin * at.sine,
        entry.free_sin * at.cosine - entry.free_cos * at.sine,
        at.decay,
    )
