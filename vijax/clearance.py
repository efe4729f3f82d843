"""How far an orbit is from grazing: what makes the solution of its equations a real motion, as smooth functions."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax import flow, shooting
from vijax.model import ImpactPair
from vijax.shooting import Knots, Sequence

_SAMPLES = 48  # of a flight or contact, to find its extrema
_POLISH = 3  # of Newton's steps from there
_NOTHING = 1.0  # clearance where there is nothing to clear


class Clearance(NamedTuple):
    """Positive on real orbits; zero where one grazes."""

    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall, over that into it: the ball stays


class _Stretch(NamedTuple):
    """Samples of a flight or contact, and the motion that they are of: elapsed time -> position, velocity."""

    s: Float[Array, "sample"]
    position: Float[Array, "sample"]
    velocity: Float[Array, "sample"]
    motion: Callable
    acceleration: Callable


def _sampled(motion: Callable, acceleration: Callable, length) -> _Stretch:
    s = jnp.linspace(0.0, 1.0, _SAMPLES + 1) * length
    position, velocity = jax.vmap(motion)(s)
    return _Stretch(s, position, velocity, motion, acceleration)


def _crest(stretch: _Stretch, way: float):
    """When a stretch is highest (way 1) or lowest (-1) at a turning point inside it, and its position; NaN for none.

    The samples choose the turning point; Newton follows that one alone.
    """
    s, x, v = stretch.s, way * stretch.position, way * stretch.velocity
    turns = (v[:-1] > 0) & (v[1:] <= 0)
    index = jnp.where(turns, jnp.maximum(x[:-1], x[1:]), -jnp.inf).argmax()
    low, high, before, after = s[index], s[index + 1], v[index], v[index + 1]

    def polish(_, at):
        step = stretch.motion(at)[1] / stretch.acceleration(at)
        return jnp.clip(at - jnp.nan_to_num(step), low, high)

    at = low + (high - low) * before / jnp.where(before > after, before - after, 1.0)
    at = lax.fori_loop(0, _POLISH, polish, at)
    found = turns.any()
    return jnp.where(found, at, jnp.nan), jnp.where(found, stretch.motion(at)[0], jnp.nan)


def _flight_room(pair: ImpactPair, passage: shooting.Passage):
    """Least distance from a wall at a turning point of the flight that follows each contact."""

    def one(side, speed, t, next_t):
        def motion(s):
            rise, v = flow.flight(pair.gamma, t, -side * speed, s)
            return 0.5 * side * pair.d + rise, v

        stretch = _sampled(motion, lambda s: flow.acceleration(pair.gamma, t + s), next_t - t)
        rooms = [0.5 * pair.d - way * _crest(stretch, way)[1] for way in (1.0, -1.0)]
        return jnp.nanmin(jnp.stack([*rooms, jnp.full_like(t, _NOTHING)]))

    return jax.vmap(one)(passage.side, passage.speed, passage.t, passage.next_t)


class Between(NamedTuple):
    """What happens between the onsets: the clearances, and when each contact on a soft wall is deepest (else NaN)."""

    clearance: Clearance
    deepest: Float[Array, "impact"]


def _contacts(pair: ImpactPair, side, knots: Knots):
    """When each contact is deepest, and its least penetration at a turning point inside where that is a minimum."""
    if pair.kappa is None:
        return jnp.full(side.shape, jnp.nan), jnp.full(side.shape, _NOTHING)
    wall = flow.membrane(pair, rolled=True)

    def one(side, knot):
        t, speed, stay = knot
        force = flow.contact_force(pair.gamma, side, t)

        def motion(s):
            return flow.oscillate(wall, force, jnp.zeros_like(s), speed, s)

        def bend(s):
            w, rate = motion(s)
            return force.at(s) - wall.mu * rate - wall.kappa * wall.kappa * w

        stretch = _sampled(motion, bend, jnp.maximum(stay, 0.0))
        (deepest, _), (_, low) = _crest(stretch, 1.0), _crest(stretch, -1.0)
        return deepest, jnp.where(jnp.isnan(low), _NOTHING, low)

    return jax.vmap(one)(side, knots)


def between(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Between:
    """The motion of an orbit between its onsets; clearances are the least over its impacts."""
    real = sequence.real
    # Padded impacts are given harmless knots.
    knots = jnp.where(real[:, None], knots, 1.0)
    passage = shooting.passages(pair, sequence, knots)

    deepest, shallow = _contacts(pair, passage.side, knots)

    def least(values):
        return jnp.where(real, values, _NOTHING).min()

    room = Clearance(
        speed=least(knots[:, 1]),
        flight=least(_flight_room(pair, passage)),
        contact=least(shallow),
        exit=jnp.full_like(pair.d, _NOTHING) if pair.kappa is None else least(passage.speed / knots[:, 1]),
    )
    return Between(room, deepest)
