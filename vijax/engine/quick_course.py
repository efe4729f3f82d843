"""The course of a contact in closed form, as seen from its onset, or from a reference time by polynomials about it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.impact import Lane
from vijax.engine.polynomial import EXP_REACH, REACH, exp, sine_cosine
from vijax.engine.quick_flight import Flight
from vijax.engine.quick_wall import SoftWall
from vijax.model.flow import PI
from vijax.runtime.xla import once, share, shared


class ContactState(eqx.Module):
    """Penetration w and its derivatives at one time of the contact, with the parts they were made of.

    What gravity adds to w, its steady response, is not in `w` (see `ContactEntry.penetration`): it changes no
    derivative, since the membrane's force on it is gravity's, only reversed.
    """

    w: Lane
    rate: Lane
    force: Lane  # its periodic part
    push: Lane  # w''
    jerk: Lane  # w'''
    drive: Lane  # derivative of the forcing
    sine: Lane
    cosine: Lane
    decay: Lane


class ContactCourse(eqx.Module):
    """A contact as seen from one reference time: steady part, forcing and free part rotated to it."""

    steady_cos: Lane
    steady_sin: Lane
    force_cos: Lane
    force_sin: Lane
    free_cos: Lane
    free_sin: Lane
    decay: Lane


@once
def motion(wall: SoftWall, course: ContactCourse, s: Lane) -> ContactState:
    """Compute the contact at time s from the course's reference."""
    sine, cosine = sine_cosine(wall.omega1 * s)
    drive_sine, drive_cosine = sine_cosine(PI * s)
    decay = share(course.decay * exp(-wall.zeta * s))
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
    push = force - 2 * wall.zeta * rate - wall.kappa * wall.kappa * w
    jerk = drive - 2 * wall.zeta * push - wall.kappa * wall.kappa * rate
    return ContactState(w, rate, force, push, jerk, drive, sine, cosine, decay)


def further(wall: SoftWall, at: ContactState) -> tuple[Lane, Lane]:
    """Compute the fourth and the fifth derivative of w."""
    square = wall.kappa * wall.kappa
    snap = -(PI**2) * at.force - 2 * wall.zeta * at.jerk - square * at.push
    return snap, -(PI**2) * at.drive - 2 * wall.zeta * snap - square * at.jerk


def at_reference(wall: SoftWall, course: ContactCourse) -> ContactState:
    """Give the contact at the course's reference: no sine and no exponential is needed there."""
    one, zero = jnp.ones_like(course.decay), jnp.zeros_like(course.decay)
    w = course.steady_cos + course.decay * course.free_cos
    rate = PI * course.steady_sin + course.decay * (wall.omega1 * course.free_sin - wall.zeta * course.free_cos)
    return _derivatives(wall, w, rate, course.force_cos, -PI * course.force_sin, zero, one, course.decay)


def in_reach(wall: SoftWall, s: Lane) -> Bool[Array, " lane"]:
    """Say whether the polynomials of `motion` hold at s."""
    return (jnp.maximum(wall.omega1, PI) * jnp.abs(s) < REACH) & (wall.zeta * jnp.abs(s) < EXP_REACH)


class ContactEntry(eqx.Module):
    """A contact at its onset: speed into the wall, forcing and steady response in phase and a quarter turn behind."""

    speed: Lane
    force_cos: Lane
    force_sin: Lane
    steady_cos: Lane
    steady_sin: Lane
    free_cos: Lane
    free_sin: Lane
    pressure: Lane | None  # Gravity presses the ball into the wall by this much; None on level ground.
    rest: Lane | None  # The membrane's steady response to that pressure.

    def penetration(self, at: ContactState) -> Lane:
        """All of w."""
        return at.w if self.rest is None else at.w + self.rest

    @property
    def force(self) -> Lane:
        """All of the forcing at the onset."""
        return self.force_cos if self.pressure is None else self.force_cos + self.pressure


@shared
def entry_of(wall: SoftWall, flight: Flight) -> ContactEntry:
    """Find forcing and steady response as the contact begins.

    The forcing is force_cos cos(pi s) - force_sin sin(pi s), its steady response steady_cos cos + steady_sin sin.
    """
    force_cos, force_sin = -flight.sine, flight.cosine
    steady_cos = wall.gain_in * force_cos + wall.gain_out * force_sin
    steady_sin = wall.gain_out * force_cos - wall.gain_in * force_sin
    pressure, rest, steady = None, None, steady_cos
    if wall.incline is not None:
        pressure = -flight.flip * flight.wall * wall.incline.gamma
        rest = pressure / (wall.kappa * wall.kappa)
        steady = steady_cos + rest
    free_sin = (flight.speed - PI * steady_sin - wall.zeta * steady) / wall.omega1
    return ContactEntry(flight.speed, force_cos, force_sin, steady_cos, steady_sin, -steady, free_sin, pressure, rest)


class Reference(eqx.Module):
    """A time after the onset that a contact is seen from: cos and sin of pi s and of omega1 s, exp(-zeta s)."""

    s: Lane
    drive_cosine: Lane
    drive_sine: Lane
    cosine: Lane
    sine: Lane
    decay: Lane


def course_at(entry: ContactEntry, at: Reference) -> ContactCourse:
    """Rotate the contact to a reference time."""
    return ContactCourse(
        entry.steady_cos * at.drive_cosine + entry.steady_sin * at.drive_sine,
        entry.steady_sin * at.drive_cosine - entry.steady_cos * at.drive_sine,
        entry.force_cos * at.drive_cosine - entry.force_sin * at.drive_sine,
        entry.force_cos * at.drive_sine + entry.force_sin * at.drive_cosine,
        entry.free_cos * at.cosine + entry.free_sin * at.sine,
        entry.free_sin * at.cosine - entry.free_cos * at.sine,
        at.decay,
    )
