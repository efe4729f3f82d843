"""How far an orbit is from grazing: what makes the solution of its equations a real motion, as smooth functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax import flow, shooting
from vijax.model import ImpactPair
from vijax.shooting import Knots, Sequence

_SAMPLES = 48  # of a flight or contact, to find its extrema
_NOTHING = 1.0  # clearance where there is nothing to clear


class Clearance(NamedTuple):
    """Positive on real orbits; zero where one grazes."""

    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall, over that into it: the ball stays


class Turns(NamedTuple):
    """Turning points inside a stretch, one a sample; NaN where there is none."""

    s: Float[Array, "sample"]
    position: Float[Array, "sample"]
    before: Float[Array, "sample"]  # velocity before it


def _turning_points(position, velocity, acceleration, length) -> Turns:
    """Where the velocity passes zero inside a stretch."""
    s = jnp.linspace(0.0, 1.0, _SAMPLES + 1) * length
    v = velocity(s)
    low, high, before, after = s[:-1], s[1:], v[:-1], v[1:]
    turns = before * after < 0
    at = low + (high - low) * before / jnp.where(turns, before - after, 1.0)
    for _ in range(2):
        at = jnp.clip(at - velocity(at) / acceleration(at), low, high)
    return Turns(jnp.where(turns, at, jnp.nan), jnp.where(turns, position(at), jnp.nan), before)


def _flight_room(pair: ImpactPair, passage: shooting.Passage):
    """Least distance from a wall at a turning point of the flight that follows each contact."""

    def one(side, speed, t, next_t):
        place = lambda s: 0.5 * side * pair.d + flow.flight(pair.gamma, t, -side * speed, s)[0]  # noqa: E731
        velocity = lambda s: flow.flight(pair.gamma, t, -side * speed, s)[1]  # noqa: E731
        turns = _turning_points(place, velocity, lambda s: flow.acceleration(pair.gamma, t + s), next_t - t)
        room = 0.5 * pair.d - jnp.where(turns.before > 0, 1, -1).astype(t.dtype) * turns.position
        return jnp.nanmin(jnp.append(room, _NOTHING))

    return jax.vmap(one)(passage.side, passage.speed, passage.t, passage.next_t)


def contact_turns(pair: ImpactPair, side, knots: Knots) -> Turns:
    """Turning points of the penetration inside each contact on a soft wall, [impact, sample]."""
    wall = flow.membrane(pair, rolled=True)

    def one(side, knot):
        t, speed, stay = knot
        force = flow.contact_force(pair.gamma, side, t)

        def motion(s):
            return jax.vmap(lambda s: flow.oscillate(wall, force, jnp.zeros_like(s), speed, s))(s)

        def bend(s):
            w, rate = motion(s)
            return jax.vmap(force.at)(s) - wall.mu * rate - wall.kappa * wall.kappa * w

        return _turning_points(lambda s: motion(s)[0], lambda s: motion(s)[1], bend, jnp.maximum(stay, 0.0))

    return jax.vmap(one)(side, knots)


def _contact_room(pair: ImpactPair, side, knots: Knots):
    """Least penetration at a turning point inside each contact where it is a minimum."""
    if pair.kappa is None:
        return jnp.full(side.shape, _NOTHING)
    turns = contact_turns(pair, side, knots)
    room = jnp.where(turns.before < 0, turns.position, jnp.nan)
    return jax.vmap(lambda row: jnp.nanmin(jnp.append(row, _NOTHING)))(room)


def clearance(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Clearance:
    """The clearances of an orbit, each the least over its impacts."""
    real = sequence.real
    # Padded impacts are given harmless knots.
    knots = jnp.where(real[:, None], knots, 1.0)
    passage = shooting.passages(pair, sequence, knots)

    def least(values):
        return jnp.where(real, values, _NOTHING).min()

    return Clearance(
        speed=least(knots[:, 1]),
        flight=least(_flight_room(pair, passage)),
        contact=least(_contact_room(pair, passage.side, knots)),
        exit=jnp.full_like(pair.d, _NOTHING) if pair.kappa is None else least(passage.speed / knots[:, 1]),
    )
