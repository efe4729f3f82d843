"""The motion between two impacts with known times: one contact and one flight, in closed form.

The ball enters a wall at one time and hits the next wall at another. These two conditions determine its entry speed and
contact duration. So one interval yields the speeds at both of its impacts, independent of the motion before. No error
grows over more than one interval, even in chaotic motion.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.fitting.fit_excitation import FitExcitation
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.numerics.linear_solve import solve

# Newton's method: the limit of steps (most solutions take 5), the largest relative change of an unknown in one step,
# and the relative change that ends the iteration.
_MOST_STEPS = 15
_HALF = 0.5
_STEP_TOLERANCE = 1e-10
# Guesses of the contact duration: their number (denser where short), the longest as a number of half periods of the
# membrane, and the fraction of a grid step subtracted from the longest, so that the flight after it has a positive
# duration.
_DURATIONS, _HALF_TURNS, _SHORTEST = 65, 8, 1e-6
# Largest numbers of sign changes of the mismatch (see `guess_motions`), with one motion each, and of turning points of
# the mismatch near 0, with two motions each.
_CROSSINGS, _TURNS = 4, 2
_HALVINGS = 10  # bisections of a sign change between two durations before Newton's method
_MOTIONS = _CROSSINGS + 2 * _TURNS
# Fractions of a contact, and of a flight, where the position of the ball is checked against the walls.
_PLACES = tuple(k / 8 for k in range(1, 8))


class Ends(eqx.Module):
    """Two consecutive impacts: their walls, -1 or +1, and their onsets in half forcing periods."""

    side: Scalar
    next_side: Scalar
    t: Scalar
    next_t: Scalar


class Motion(eqx.Module):
    """A motion from an impact to the next, as a guess for Newton's method; NaN for no motion.

    A motion that begins at a rigid wall needs no guess.

    Attributes:
        speed: Entry speed at the first wall.
        contact_duration: Contact duration at the first wall.
    """

    speed: Values
    contact_duration: Values


class Interval(eqx.Module):
    """The solution of an interval.

    Attributes:
        speed: Entry speed at the first wall, > 0; NaN if no motion leads from one impact to the other.
        contact_duration: Contact duration at the first wall.
        arrival: Velocity at the next impact.
        outside: Largest distance of the flight beyond a wall; at most 0 if the flight hits no wall between the impacts.
    """

    speed: Values
    contact_duration: Values
    arrival: Values
    outside: Values


class _Response(NamedTuple):
    """Result of an entry speed and a contact duration.

    Attributes:
        residual: Residuals: penetration at the end of the contact over its duration, and distance to the next wall.
        out: Velocity at the end of the contact.
        arrival: Velocity at the next onset.
    """

    residual: Any
    out: Any
    arrival: Any


class Restitution(eqx.Module):
    """Term added to r at an impact: offset + slope * impact speed.

    Both numbers are 0. Only derivatives by them are used, to test whether r depends on the speed.
    """

    offset: Scalar
    slope: Scalar


def interval(pair: ImpactPair, excitation: FitExcitation, added: Restitution, ends: Ends, near: Motion) -> Interval:
    """Compute the speeds at both ends of an interval for the motion near a guess.

    First derivatives are correct in all arguments except `near`.
    """
    inputs = excitation, added, ends
    return pair.by_wall_kind(
        ends.side, partial(_after_rigid, inputs=inputs), partial(_after_soft, inputs=inputs, near=near)
    )


def guess_motions(pair: ImpactPair, excitation: FitExcitation, ends: Ends) -> tuple[Motion, Flag]:
    """Guess the motions of an interval; several motions, from short to long contacts, may take the same time.

    For every contact duration the two ends of the contact determine entry and exit speed, and the next impact
    determines the exit velocity that is necessary to reach it. The mismatch of the two exit velocities is a function of
    the duration alone, and every sign change of the mismatch is a guess.

    Returns:
        Guesses [motion], padded with NaN; and whether contacts as long as the whole interval were searched.
    """

    def rigid(_: ImpactPair) -> tuple[Motion, Flag]:
        # At a rigid wall the motion needs no guess, so that one entry is any finite number and all others are NaN.
        speeds = jnp.full(_MOTIONS, jnp.nan).at[0].set(1.0)
        return Motion(speeds, 0.0 * speeds), jnp.asarray(True)

    def soft(wall: ImpactPair) -> tuple[Motion, Flag]:
        longest = _HALF_TURNS * jnp.pi / flow.membrane(wall, rolled=True).omega1
        return _crossings(wall, excitation, ends, longest), longest >= ends.next_t - ends.t

    return pair.by_wall_kind(ends.side, rigid, soft)


def _crossings(pair: ImpactPair, excitation: FitExcitation, ends: Ends, longest: Scalar) -> Motion:
    """Guess the motions [motion] where the mismatch changes its sign on the grid of durations, or turns back near 0.

    At a turning point near 0 two motions may lie closer together than the grid: a parabola through three points yields
    both.
    """
    wall = flow.membrane(pair, rolled=True)
    longest = jnp.minimum(longest, ends.next_t - ends.t)

    def duration_at(place: Values) -> Values:
        # Durations grow as place^1.5, dense where short; the longest leaves a positive duration to the flight.
        return (jnp.minimum(place, _DURATIONS - _SHORTEST) / _DURATIONS) ** 1.5 * longest

    def at(place: Scalar) -> tuple[Scalar, Motion]:
        """Return the mismatch, times the impulse response, and the least-squares entry speed for both conditions."""
        contact_duration = duration_at(place)
        w, z = excitation.contact(
            wall, pair.gamma, ends.side, ends.t, jnp.zeros_like(contact_duration), contact_duration
        )
        required_rate = ends.side * _required_velocity(pair, excitation, ends, ends.t + contact_duration)
        # With entry speed v: w + h v = 0 and z + slope v = required exit rate. Eliminating v gives the mismatch.
        h, slope = flow.free_response(wall, contact_duration)
        stiff = wall.kappa * wall.kappa
        speed = (slope * (required_rate - z) - stiff * h * w) / (stiff * h * h + slope * slope)
        return h * (z - required_rate) - w * slope, Motion(speed, contact_duration)

    places = 1.0 + jnp.arange(_DURATIONS, dtype=ends.t.dtype)
    mismatch, _ = jax.vmap(at)(places)
    # Two motions close together need separate guesses near each; otherwise Newton's method converges to one of them
    # twice.
    crosses = mismatch[:-1] * mismatch[1:] < 0
    low, sign = (_first(crosses, values, _CROSSINGS) for values in (places[:-1], jnp.sign(mismatch[:-1])))
    crossings = jax.vmap(partial(_bisect, lambda place: at(place)[0]))(low, sign)
    before, middle, after = mismatch[:-2], mismatch[1:-1], mismatch[2:]
    # Parabola middle + rise x + bend x^2 through three neighbours, x in grid steps; |rise| <= 2 |bend| puts its vertex
    # within one step.
    bend, rise = (before + after) / 2 - middle, (after - before) / 2
    turns = (before * middle > 0) & (middle * after > 0) & (middle * bend > 0) & (jnp.abs(rise) <= 2 * jnp.abs(bend))
    root_of_discriminant = jnp.sqrt(jnp.maximum(rise * rise - 4 * bend * middle, 0.0))
    roots = [places[1:-1] + (-rise + sign * root_of_discriminant) / (2 * bend) for sign in (-1, 1)]
    all_places = jnp.concatenate([crossings, *(_first(turns, root, _TURNS) for root in roots)])
    _, guess = jax.vmap(at)(all_places)
    return jax.tree.map(lambda x: jnp.where(guess.speed > 0, x, jnp.nan), guess)


def _bisect(mismatch: Callable[[Scalar], Scalar], low: Scalar, sign: Scalar) -> Scalar:
    """Bisect for the sign change of `mismatch` in `low` to `low` + 1, to a thousandth; `sign` is its sign at `low`."""

    def half(k: Array, low: Scalar) -> Scalar:
        middle = low + 0.5 ** (k + 1)
        return jnp.where(sign * mismatch(middle) > 0, middle, low)

    return lax.fori_loop(0, _HALVINGS, half, low) + 0.5 ** (_HALVINGS + 1)


def _first(real: Array, values: Array, count: int) -> Array:
    """Return the first `count` values where `real`, padded with NaN."""
    first = jnp.argsort(~real, stable=True)[:count]
    return jnp.where(real[first], values[first], jnp.nan)


def _after_rigid(pair: ImpactPair, inputs: tuple[FitExcitation, Restitution, Ends]) -> Interval:
    """Solve an interval after a rigid wall: the contact takes no time, and the flight follows from its two ends."""
    excitation, added, ends = inputs
    out = _required_velocity(pair, excitation, ends, ends.t)
    # -out/speed = r + offset + slope speed, solved for the speed to first order in offset and slope, which are 0.
    plain = -ends.side * out / pair.r
    speed = plain * (1 - (added.offset + added.slope * plain) / pair.r)
    speed = jnp.where(speed > 0, speed, jnp.nan)
    arrival = excitation.flight(pair.gamma, ends.t, out, ends.next_t - ends.t)[1]
    return Interval(speed, 0 * speed, arrival, _distance_outside(pair, excitation, ends, ends.t, out))


def _after_soft(pair: ImpactPair, inputs: tuple[FitExcitation, Restitution, Ends], near: Motion) -> Interval:
    """Solve for entry speed and contact duration, so that the flight reaches the next wall at the given time."""
    frozen, near = lax.stop_gradient(((pair, inputs), near))
    x, converged = _solve_contact(*frozen, near)
    # Implicit function theorem: subtract a Newton step that has the value 0. The root does not change, and its first
    # derivatives become correct.
    slopes, response = jax.jacfwd(_response)(x, *frozen), _response(x, pair, inputs)
    correction = solve(slopes.residual, response.residual - lax.stop_gradient(response.residual))
    out, arrival = response.out - slopes.out @ correction, response.arrival - slopes.arrival @ correction
    return _checked_interval(pair, inputs, x - correction, response._replace(out=out, arrival=arrival), converged)


def _solve_contact(
    pair: ImpactPair, inputs: tuple[FitExcitation, Restitution, Ends], near: Motion
) -> tuple[Float[Array, "2"], Flag]:
    """Solve for speed and duration of a contact from a guess, and return whether the solution converged."""
    return _newton(lambda x: _response(x, pair, inputs).residual, jnp.stack([near.speed, near.contact_duration]))


def _checked_interval(
    pair: ImpactPair,
    inputs: tuple[FitExcitation, Restitution, Ends],
    x: Float[Array, "2"],
    response: _Response,
    converged: Flag,
) -> Interval:
    """Return the interval for this contact and the flight after it; NaN if the ball leaves the wall earlier."""
    excitation, _, ends = inputs
    real = converged & (x[1] <= excitation.longest_contact) & (_shallowest(*lax.stop_gradient((pair, inputs, x))) > 0)
    speed, contact_duration, arrival = (jnp.where(real, number, jnp.nan) for number in (x[0], x[1], response.arrival))
    return Interval(
        speed, contact_duration, arrival, _distance_outside(pair, excitation, ends, ends.t + x[1], response.out)
    )


def _shallowest(pair: ImpactPair, inputs: tuple[FitExcitation, Restitution, Ends], x: Float[Array, "2"]) -> Scalar:
    """Compute the least penetration at a few places of a contact, which must be positive until the contact ends."""
    excitation, added, ends = inputs
    speed, contact_duration = x[0], x[1]
    wall = _membrane(pair, added, speed)

    def depth(part: Scalar) -> Scalar:
        return excitation.contact(wall, pair.gamma, ends.side, ends.t, speed, part * contact_duration)[0]

    return jnp.min(jax.vmap(depth)(jnp.asarray(_PLACES)))


def _membrane(pair: ImpactPair, added: Restitution, speed: Scalar) -> flow.Membrane:
    return flow.membrane(replace(pair, r=pair.r + added.offset + added.slope * speed), rolled=True)


def _response(x: Float[Array, "2"], pair: ImpactPair, inputs: tuple[FitExcitation, Restitution, Ends]) -> _Response:
    """Compute the motion through the contact and the flight after it."""
    excitation, added, ends = inputs
    speed, contact_duration = x[0], x[1]
    w, z = excitation.contact(_membrane(pair, added, speed), pair.gamma, ends.side, ends.t, speed, contact_duration)
    exit_t = ends.t + contact_duration
    rise, arrival = excitation.flight(pair.gamma, exit_t, ends.side * z, ends.next_t - exit_t)
    distance = 0.5 * pair.d * (ends.side - ends.next_side) + rise
    # Dividing by the duration removes the root of the penetration at the onset.
    return _Response(jnp.stack([w / contact_duration, distance]), ends.side * z, arrival)


def _required_velocity(pair: ImpactPair, excitation: FitExcitation, ends: Ends, t: Scalar) -> Scalar:
    """Compute the velocity that a ball needs at time t at the first wall, to reach the next impact in time."""
    s = ends.next_t - t
    rise, _ = excitation.flight(pair.gamma, t, jnp.zeros_like(s), s)
    return (0.5 * pair.d * (ends.next_side - ends.side) - rise) / s


def _newton(equations: Callable[[Array], Array], x: Float[Array, "2"]) -> tuple[Float[Array, "2"], Flag]:
    """Solve two equations for two positive numbers by Newton's method, and return whether it converged."""

    def continues(carry):
        count, _, step = carry
        return (count < _MOST_STEPS) & (step > _STEP_TOLERANCE)

    def twice(x: Array) -> tuple[Array, Array]:
        residual = equations(x)
        return residual, residual  # one to differentiate, one as value

    def iterate(carry):
        count, x, _ = carry
        slopes, residual = jax.jacfwd(twice, has_aux=True)(x)
        # Relative steps, limited to a half, keep both numbers positive.
        step = solve(slopes, -residual) / x
        step = jnp.where(jnp.isfinite(step), jnp.clip(step, -_HALF, _HALF), 0.0)
        return count + 1, x * (1 + step), jnp.abs(step).max()

    _, x, step = lax.while_loop(continues, iterate, (0, x, jnp.full_like(x[0], jnp.inf)))
    return x, (step <= _STEP_TOLERANCE) & jnp.isfinite(x).all()


def _distance_outside(pair: ImpactPair, excitation: FitExcitation, ends: Ends, t: Scalar, out: Scalar) -> Scalar:
    """Compute the largest distance of a flight beyond a wall, at a few places."""
    flight_duration = ends.next_t - t

    def place(part: Scalar) -> Scalar:
        return 0.5 * pair.d * ends.side + excitation.flight(pair.gamma, t, out, part * flight_duration)[0]

    return jnp.max(jnp.abs(jax.vmap(place)(jnp.asarray(_PLACES)))) - 0.5 * pair.d
