"""What lies between two impacts whose times are known: one contact and one flight, and nothing is searched for.

The ball enters a wall at one time and meets the next wall at another. How fast it must have been then follows: so one
interval says at which speed each of its impacts happens, whatever came before. Chaos has no time to grow.
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

from vijax.fitting.shaking import Shaking
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.linear_solve import solve

# Newton's steps, most of which take 5; a step changes neither number by more than half, and the last by less than this.
_MOST_STEPS = 15
_HALF = 0.5
_ARRIVED = 1e-10
# A contact is looked for at so many durations, closer to each other where they are short, up to so many half turns of
# the membrane; the longest is shorter than that by this share of the way between two.
_DURATIONS, _HALF_TURNS, _SHORTEST = 65, 8, 1e-6
# Of an interval so many motions are told: where the miss changes its sign, and two each where it turns back.
_CROSSINGS, _TURNS = 4, 2
_HALVINGS = 10  # A change of sign between two durations is narrowed down so often before Newton begins.
_MOTIONS = _CROSSINGS + 2 * _TURNS
# Places in a contact and in a flight where the ball must be on the right side of the walls.
_PLACES = tuple(k / 8 for k in range(1, 8))


class Ends(eqx.Module):
    """Two impacts that follow each other: their walls, -1 or +1, and their onsets in half forcing periods."""

    side: Scalar
    next_side: Scalar
    t: Scalar
    next_t: Scalar


class Motion(eqx.Module):
    """A motion from an impact to the next: how fast it enters the first wall, and how long it stays; NaN for none.

    Of a rigid wall it needs not be known.
    """

    speed: Values
    stay: Values


class Interval(eqx.Module):
    """What an interval says.

    Attributes:
        speed: How fast the ball enters the first wall, > 0; NaN where no motion leads from one impact to the other.
        stay: How long it stays there.
        arrival: Its velocity as it meets the next wall.
        outside: How far it would pass through a wall on its way; at most 0 if it meets none.
    """

    speed: Values
    stay: Values
    arrival: Values
    outside: Values


class _Followed(NamedTuple):
    """What a speed at the onset and a duration of the contact lead to.

    Attributes:
        missed: What must be 0: penetration as the contact ends, over its duration, and distance to the next wall.
        out: Velocity as the contact ends.
        arrival: Velocity at the next onset.
    """

    missed: Any
    out: Any
    arrival: Any


class Restitution(eqx.Module):
    """What is added to r at an impact: offset + slope times its speed. Both are 0; derivatives by them test r."""

    offset: Scalar
    slope: Scalar


def interval(pair: ImpactPair, shaking: Shaking, added: Restitution, ends: Ends, near: Motion) -> Interval:
    """Find the speeds at both ends of an interval, of the motion near one; differentiable once in all but that."""
    told = shaking, added, ends
    return pair.met(ends.side, partial(_behind_rigid, told=told), partial(_behind_soft, told=told, near=near))


def guessed_motions(pair: ImpactPair, shaking: Shaking, ends: Ends) -> tuple[Motion, Flag]:
    """List near what an interval may be: a slow ball may stay long, or enter faster and fly longer.

    For every duration of the contact its two ends say how fast the ball enters and leaves, and the next impact says
    how fast it must leave: a function of the duration alone, of which every change of sign is followed.

    Returns:
        Guesses [motion], NaN where there are no more; and whether all durations that the interval leaves were tried.
    """

    def rigid(_: ImpactPair) -> tuple[Motion, Flag]:
        # The motion behind a rigid wall is known without a guess.
        one = jnp.full(_MOTIONS, jnp.nan).at[0].set(1.0)
        return Motion(one, 0.0 * one), jnp.asarray(True)

    def soft(wall: ImpactPair) -> tuple[Motion, Flag]:
        longest = _HALF_TURNS * jnp.pi / flow.membrane(wall, rolled=True).omega1
        return _crossings(wall, shaking, ends, longest), longest >= ends.next_t - ends.t

    return pair.met(ends.side, rigid, soft)


def _crossings(pair: ImpactPair, shaking: Shaking, ends: Ends, longest: Scalar) -> Motion:
    """Guess the motions [motion]: where the miss changes its sign from duration to duration, or turns back near 0.

    Where it turns back two motions may lie closer to each other than the durations; they are those of a parabola.
    """
    wall = flow.membrane(pair, rolled=True)
    longest = jnp.minimum(longest, ends.next_t - ends.t)

    def stay_at(place: Values) -> Values:
        # The last leaves room for the shortest flight.
        return (jnp.minimum(place, _DURATIONS - _SHORTEST) / _DURATIONS) ** 1.5 * longest

    def at(place: Scalar) -> tuple[Scalar, Motion]:
        """Give the miss, times the impulse response, and the speed that fits both conditions best."""
        stay = stay_at(place)
        w, z = shaking.contact(wall, pair.gamma, ends.side, ends.t, jnp.zeros_like(stay), stay)
        wanted = ends.side * _needed(pair, shaking, ends, ends.t + stay)
        h, slope = flow.free_response(wall, stay)
        stiff = wall.kappa * wall.kappa
        speed = (slope * (wanted - z) - stiff * h * w) / (stiff * h * h + slope * slope)
        return h * (z - wanted) - w * slope, Motion(speed, stay)

    places = 1.0 + jnp.arange(_DURATIONS, dtype=ends.t.dtype)
    miss, _ = jax.vmap(at)(places)
    # Of two motions that are close to each other Newton finds one twice, from where neither is much nearer.
    crosses = miss[:-1] * miss[1:] < 0
    low, sign = (_first(crosses, values, _CROSSINGS) for values in (places[:-1], jnp.sign(miss[:-1])))
    crossings = jax.vmap(partial(_halved, lambda place: at(place)[0]))(low, sign)
    before, here, after = miss[:-2], miss[1:-1], miss[2:]
    bend, rise = (before + after) / 2 - here, (after - before) / 2
    turns = (before * here > 0) & (here * after > 0) & (here * bend > 0) & (jnp.abs(rise) <= 2 * jnp.abs(bend))
    apart = jnp.sqrt(jnp.maximum(rise * rise - 4 * bend * here, 0.0))
    roots = [places[1:-1] + (-rise + sign * apart) / (2 * bend) for sign in (-1, 1)]
    found = jnp.concatenate([crossings, *(_first(turns, root, _TURNS) for root in roots)])
    _, guess = jax.vmap(at)(found)
    return jax.tree.map(lambda x: jnp.where(guess.speed > 0, x, jnp.nan), guess)


def _halved(miss: Callable[[Scalar], Scalar], low: Scalar, sign: Scalar) -> Scalar:
    """Find where a function that has a sign at `low` changes it before `low` + 1, to a thousandth."""

    def half(k: Array, low: Scalar) -> Scalar:
        middle = low + 0.5 ** (k + 1)
        return jnp.where(sign * miss(middle) > 0, middle, low)

    return lax.fori_loop(0, _HALVINGS, half, low) + 0.5 ** (_HALVINGS + 1)


def _first(real: Array, values: Array, count: int) -> Array:
    """Take the first values that are real; NaN where there are no more."""
    first = jnp.argsort(~real, stable=True)[:count]
    return jnp.where(real[first], values[first], jnp.nan)


def _behind_rigid(pair: ImpactPair, told: tuple[Shaking, Restitution, Ends]) -> Interval:
    """Leave a rigid wall at once: the flight is known by where it begins and ends."""
    shaking, added, ends = told
    out = _needed(pair, shaking, ends, ends.t)
    # -out/speed = r + offset + slope speed, solved for the speed to first order in offset and slope, which are 0.
    plain = -ends.side * out / pair.r
    speed = plain * (1 - (added.offset + added.slope * plain) / pair.r)
    speed = jnp.where(speed > 0, speed, jnp.nan)
    arrival = shaking.flight(pair.gamma, ends.t, out, ends.next_t - ends.t)[1]
    return Interval(speed, 0 * speed, arrival, _flown_outside(pair, shaking, ends, ends.t, out))


def _behind_soft(pair: ImpactPair, told: tuple[Shaking, Restitution, Ends], near: Motion) -> Interval:
    """Solve for the speed at the onset and the duration of the contact: it ends, and the flight meets the next wall."""
    frozen, near = lax.stop_gradient(((pair, told), near))
    x, arrived = _solved(*frozen, near)
    # The root moves with what the equations are told: its value stays, its first derivatives are right.
    slopes, here = jax.jacfwd(_followed)(x, *frozen), _followed(x, pair, told)
    back = solve(slopes.missed, here.missed - lax.stop_gradient(here.missed))
    out, arrival = here.out - slopes.out @ back, here.arrival - slopes.arrival @ back
    return _held(pair, told, x - back, here._replace(out=out, arrival=arrival), arrived)


def _solved(pair: ImpactPair, told: tuple[Shaking, Restitution, Ends], near: Motion) -> tuple[Float[Array, "2"], Flag]:
    """Find speed and duration of a contact, from near ones, and say whether they are found."""
    return _newton(lambda x: _followed(x, pair, told).missed, jnp.stack([near.speed, near.stay]))


def _held(
    pair: ImpactPair, told: tuple[Shaking, Restitution, Ends], x: Float[Array, "2"], follows: _Followed, arrived: Flag
) -> Interval:
    """Say all of a contact of this speed and duration and of the flight after it, unless it ends sooner."""
    shaking, _, ends = told
    real = arrived & (x[1] <= shaking.longest_contact) & (_shallowest(*lax.stop_gradient((pair, told, x))) > 0)
    speed, stay, arrival = (jnp.where(real, number, jnp.nan) for number in (x[0], x[1], follows.arrival))
    return Interval(speed, stay, arrival, _flown_outside(pair, shaking, ends, ends.t + x[1], follows.out))


def _shallowest(pair: ImpactPair, told: tuple[Shaking, Restitution, Ends], x: Float[Array, "2"]) -> Scalar:
    """Find the least penetration at a few places of a contact, which is over when the ball first comes back."""
    shaking, added, ends = told
    speed, stay = x[0], x[1]
    wall = _membrane(pair, added, speed)

    def depth(part: Scalar) -> Scalar:
        return shaking.contact(wall, pair.gamma, ends.side, ends.t, speed, part * stay)[0]

    return jnp.min(jax.vmap(depth)(jnp.asarray(_PLACES)))


def _membrane(pair: ImpactPair, added: Restitution, speed: Scalar) -> flow.Membrane:
    return flow.membrane(replace(pair, r=pair.r + added.offset + added.slope * speed), rolled=True)


def _followed(x: Float[Array, "2"], pair: ImpactPair, told: tuple[Shaking, Restitution, Ends]) -> _Followed:
    """Follow the ball through the contact and the flight after it."""
    shaking, added, ends = told
    speed, stay = x[0], x[1]
    w, z = shaking.contact(_membrane(pair, added, speed), pair.gamma, ends.side, ends.t, speed, stay)
    exit_t = ends.t + stay
    rise, arrival = shaking.flight(pair.gamma, exit_t, ends.side * z, ends.next_t - exit_t)
    miss = 0.5 * pair.d * (ends.side - ends.next_side) + rise
    # A penetration has a root at the onset, too.
    return _Followed(jnp.stack([w / stay, miss]), ends.side * z, arrival)


def _needed(pair: ImpactPair, shaking: Shaking, ends: Ends, t: Scalar) -> Scalar:
    """Compute the velocity with which a ball that leaves the first wall at a time meets the next one in time."""
    s = ends.next_t - t
    rise, _ = shaking.flight(pair.gamma, t, jnp.zeros_like(s), s)
    return (0.5 * pair.d * (ends.next_side - ends.side) - rise) / s


def _newton(equations: Callable[[Array], Array], x: Float[Array, "2"]) -> tuple[Float[Array, "2"], Flag]:
    """Solve two equations for two positive numbers; say whether they are solved."""

    def goes_on(carry):
        count, _, step = carry
        return (count < _MOST_STEPS) & (step > _ARRIVED)

    def twice(x: Array) -> tuple[Array, Array]:
        missed = equations(x)
        return missed, missed  # one to differentiate, one as it is

    def go(carry):
        count, x, _ = carry
        slopes, missed = jax.jacfwd(twice, has_aux=True)(x)
        step = solve(slopes, -missed) / x
        step = jnp.where(jnp.isfinite(step), jnp.clip(step, -_HALF, _HALF), 0.0)
        return count + 1, x * (1 + step), jnp.abs(step).max()

    _, x, step = lax.while_loop(goes_on, go, (0, x, jnp.full_like(x[0], jnp.inf)))
    return x, (step <= _ARRIVED) & jnp.isfinite(x).all()


def _flown_outside(pair: ImpactPair, shaking: Shaking, ends: Ends, t: Scalar, out: Scalar) -> Scalar:
    """Find how far a flight leaves the gap, at a few places."""
    whole = ends.next_t - t

    def place(part: Scalar) -> Scalar:
        return 0.5 * pair.d * ends.side + shaking.flight(pair.gamma, t, out, part * whole)[0]

    return jnp.max(jnp.abs(jax.vmap(place)(jnp.asarray(_PLACES)))) - 0.5 * pair.d
