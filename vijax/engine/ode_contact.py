"""One contact with a membrane of any law, of known length: what orbits are made of where no closed form is at hand.

A fixed number of Runge-Kutta steps of order 8 (the stages of diffrax's Dopri8), so that the end is a smooth function of
all that there is, to derivatives of any order. Lengths that a controller chose would make it jump, by as much as the
tolerance. An orbit holds many contacts, and derivatives of them: loops of its own, of a stage each, trace in a third of
the time that the steps of a solver made for controllers take, and run in two thirds.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vijax.engine.contact_search import Turns
from vijax.model.membrane import Wall
from vijax.model.pair import ImpactPair
from vijax.model.waves import pushing, waves_at
from vijax.runtime.arrays import Scalar

STEPS = 32
"""Steps of a contact: off by 1e-11 at most for the laws that are shipped, kappa times its length up to 6."""


class Contact(eqx.Module):
    """A contact: which wall the ball enters, when, and how fast.

    Attributes:
        pair: What shakes the ball.
        wall: The membrane.
        side: The wall's, -1 or +1.
        t: Time of the onset.
        speed: Into the wall, > 0.
    """

    pair: ImpactPair
    wall: Wall
    side: Scalar
    t: Scalar
    speed: Scalar

    def push(self, s: Scalar) -> Scalar:
        """Compute the forcing into the wall, a time s after the onset."""
        return self.side * pushing(waves_at(self.pair, self.t + s), self.pair.gamma)

    def acceleration(self, s: Scalar, w: Scalar, z: Scalar) -> Scalar:
        """Compute w'' at penetration w and rate z, a time s after the onset."""
        return self.push(s) + self.wall(w, z)


def contact(pair: ImpactPair, side: Scalar, t: Scalar, speed: Scalar) -> Contact:
    """Make the contact of an onset with a wall of a pair, whose membrane is `pair.law`."""
    here = pair.at(side)
    law: Any = here.law
    return Contact(here, law.wall(here), side, t, speed)


class Held(NamedTuple):
    """A ball within a membrane: penetration, its rate, and the energy given to the membrane since the onset."""

    w: Scalar
    z: Scalar
    work: Scalar


def _place(x: Scalar) -> Scalar:
    return x * x * (3 - 2 * x)


def _field(x: Any, y: Held, given: tuple[Contact, Scalar]) -> Held:
    """Compute how a ball moves with x, which is 0 at the onset and 1 at the end; time goes as x^2 beside either.

    A force as w^(3/2) at both ends, where w is small, is no power series in the time, but is one in x: without this the
    method has order 3 there.
    """
    of, stay = given
    pace = stay * (6 * x * (1 - x))
    pull = of.wall(y.w, y.z)
    return Held(pace * y.z, pace * (of.push(stay * _place(x)) + pull), -pace * pull * y.z)


class _Stages(NamedTuple):
    """A Runge-Kutta method: when each stage is in a step, and what the rates of those before it, and all, weigh."""

    at: np.ndarray
    before: np.ndarray
    weights: np.ndarray


@cache
def _stages() -> _Stages:
    """Read the stages of Dopri8; its last one is the first of the next step."""
    import diffrax  # when it is first asked for: it takes a second, and linear membranes do without

    table = diffrax.Dopri8.tableau
    rows = [np.zeros(0), *table.a_lower[:-1]]
    before = np.stack([np.pad(row, (0, len(rows) - len(row))) for row in rows])
    return _Stages(np.array([0.0, *table.c[:-1]]), before, np.asarray(table.b_sol[:-1]))


@partial(jax.jit, static_argnames="steps")
def course(of: Contact, stay: Scalar, steps: int = STEPS, w: Scalar | float = 0.0) -> tuple[Scalar, Held]:
    """Follow a contact of known length.

    Args:
        of: The contact.
        stay: Its length.
        steps: To take, a static number.
        w: Penetration at the onset; it is varied, no more.

    Returns:
        Times since the onset and states there, [step], the last one at the end.
    """
    at, before, weights = jax.tree.map(partial(jnp.asarray, dtype=of.speed.dtype), _stages())
    x, h = jnp.linspace(0.0, 1.0, steps + 1, dtype=of.speed.dtype), 1 / steps

    def moved(y: Held, weights: Float[Array, " stage"], rates: Held) -> Held:
        return jax.tree.map(lambda y, rates: y + h * (weights * rates).sum(), y, rates)

    def one(y: Held, begin: Scalar) -> tuple[Held, Held]:
        def stage(rates: Held, row: tuple[Array, Scalar, Array]) -> tuple[Held, None]:
            number, at, before = row
            here = _field(begin + h * at, moved(y, before, rates), (of, stay))
            return jax.tree.map(lambda rates, here: rates.at[number].set(here), rates, here), None

        blank = jax.tree.map(lambda y: y * jnp.zeros_like(at), y)
        rates, _ = lax.scan(stage, blank, (jnp.arange(at.size), at, before))
        after = moved(y, weights, rates)
        return after, after

    # Zeros that depend on all that the motion does: batched and differentiated as it is, the loops are traced once.
    zero = 0.0 * (of.speed + of.t + stay)
    _, states = lax.scan(one, Held(zero + w, of.speed + zero, zero), x[:-1])
    return stay * _place(x[1:]), states


def held(of: Contact, stay: Scalar, steps: int = STEPS, w: Scalar | float = 0.0) -> Held:
    """Say where the ball is a time after the onset; see `course`."""
    _, states = course(of, stay, steps, w)
    return jax.tree.map(lambda leaf: leaf[-1], states)


def error(of: Contact, stay: Scalar) -> Scalar:
    """Estimate by how much the end of a contact of known length is off, by what twice as many steps make of it."""
    there, finer = held(of, stay), held(of, stay, 2 * STEPS)
    return jnp.maximum(jnp.abs(there.w - finer.w) / stay, jnp.abs(there.z - finer.z))


class FoundEnd(NamedTuple):
    """The end of a contact: w and w' there, and how each changes with the onset's time, its speed, and the length."""

    w: Scalar
    z: Scalar
    w_slope: Float[Array, "3"]
    z_slope: Float[Array, "3"]


def end(of: Contact, stay: Scalar, steps: int = STEPS) -> FoundEnd:
    """Find the end of a contact of known length, and its derivatives."""

    def at(onset: Float[Array, "2"]) -> tuple[Float[Array, "2"], Held]:
        there = held(eqx.tree_at(lambda of: (of.t, of.speed), of, (onset[0], onset[1])), stay, steps)
        return jnp.stack([there.w, there.z]), there

    slopes, there = jax.jacfwd(at, has_aux=True)(jnp.stack([of.t, of.speed]))
    ahead = jnp.stack([there.z, of.acceleration(stay, there.w, there.z)])
    w_slope, z_slope = jnp.concatenate([slopes, ahead[:, None]], axis=1)
    return FoundEnd(there.w, there.z, w_slope, z_slope)


def tangent(of: Contact, stay: Scalar) -> Float[Array, "2 2"]:
    """Compute the tangent map of a contact in (w, w'), from flight to flight: the force may jump at either end."""
    zero = jnp.zeros_like(of.speed)

    def at(onset: Float[Array, "2"]) -> tuple[Float[Array, "2"], Scalar]:
        there = held(eqx.tree_at(lambda of: of.speed, of, onset[1]), stay, w=onset[0])
        return jnp.stack([there.w, there.z]), there.z

    inside, z = jax.jacfwd(at, has_aux=True)(jnp.stack([zero, of.speed]))
    return _kick(-_grip(of, z)) @ inside @ _kick(_grip(of, of.speed))


def _grip(of: Contact, z: Scalar) -> Scalar:
    """Compute by how much the force jumps where w is 0, over the rate there; the limit of that at rest."""
    zero, still = jnp.zeros_like(z), z == 0
    _, slope = jax.jvp(lambda z: of.wall(zero, z), (zero,), (zero + 1,))
    return jnp.where(still, slope, of.wall(zero, z) / jnp.where(still, 1.0, z))


def _kick(grip: Scalar) -> Float[Array, "2 2"]:
    one = jnp.ones_like(grip)
    return jnp.stack([jnp.stack([one, 0 * one]), jnp.stack([grip, one])])


def turns(of: Contact, stay: Scalar) -> Turns:
    """Find the deepest point of a contact, and its shallowest minimum inside.

    A step that holds two turning points is not seen to hold any: it is a 32nd of the contact, or 5 % of it midway.
    """
    s, (w, z, _) = course(of, stay)
    begin = jnp.zeros((1,), s.dtype)
    s0, w0, z0 = (jnp.concatenate([first, rest[:-1]]) for first, rest in ((begin, s), (begin, w), (of.speed[None], z)))
    # Where each step turns by the cubic through both ends.
    when, there = jax.vmap(_extreme)(s - s0, w0, z0, w, z)
    tops, dips = (z0 > 0) & (z <= 0), (z0 < 0) & (z >= 0)
    top, dip = jnp.argmax(jnp.where(tops, there, -jnp.inf)), jnp.argmin(jnp.where(dips, there, jnp.inf))
    crest, highest = _turning(of, s0[top] + when[top], -1.0)
    trough, lowest = _turning(of, s0[dip] + when[dip], 1.0)
    some, lost = dips.any(), ~tops.any() | ~jnp.isfinite(crest)
    return Turns(stay, crest, highest, jnp.where(some, trough, 0.0), jnp.where(some, lowest, jnp.inf), lost)


def _turning(of: Contact, s: Scalar, sign: float) -> tuple[Scalar, Scalar]:
    """Find a turning point near a time by Newton's method, which is there after two steps, and w there.

    The acceleration has the sign -1 at a maximum and 1 at a minimum; where it has not, there is none and s stays.
    """
    for _ in range(2):
        now = held(of, s)
        bend = sign * of.acceleration(s, now.w, now.z)
        s = s - jnp.where(bend > 0, sign * now.z / jnp.where(bend > 0, bend, 1.0), 0.0)
    return s, held(of, s).w


def _extreme(h: Scalar, w0: Scalar, z0: Scalar, w1: Scalar, z1: Scalar) -> tuple[Scalar, Scalar]:
    """Find where within a step of length h a cubic turns, whose slope changes sign between its ends."""
    rise = w1 - w0
    # The slope is z0 + 2 b x + 3 c x^2 at x in [0, 1], of h times the rate.
    begin, ends = h * z0, h * z1
    b, c = 3 * rise - 2 * begin - ends, begin + ends - 2 * rise
    # Of the two roots the one at which the slope falls, or rises, as it does between the ends.
    root = jnp.sqrt(jnp.maximum(b * b - 3 * c * begin, 0.0))
    below = -b + jnp.where(z0 > z1, root, -root)
    x = jnp.clip(jnp.where(below != 0, begin / jnp.where(below != 0, below, 1.0), 0.5), 0.0, 1.0)
    return x * h, w0 + x * (begin + x * (b + x * c))
