"""One contact of known duration with a membrane of any law, for orbits of membranes without a closed form.

The method is Dopri8 (Runge-Kutta, order 8; coefficients from diffrax) with a fixed number of steps, so the end state is
a smooth function of all arguments, with derivatives of any order. A step-size controller would make it discontinuous by
about the tolerance. An orbit holds many contacts and their derivatives. Plain loops over steps and stages, as here,
trace in a third of the time of diffrax's solver steps and run in two thirds of it.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vijax.impact.exact.contact_search import TurningPoints
from vijax.model.forcing.waves import forcing_acceleration, waves_at
from vijax.model.pair import ImpactPair
from vijax.model.walls.membrane import Wall
from vijax.runtime.arrays import Scalar

STEPS = 32
"""Steps of a contact: the error is at most 1e-11 for the laws of vijax, for kappa times duration up to 6."""


class Contact(eqx.Module):
    """A contact: the wall, and the time and speed of its onset.

    Attributes:
        pair: The pair, with the forcing.
        wall: The membrane.
        side: Side of the wall, -1 or +1.
        t: Time of the onset.
        speed: Speed into the wall, > 0.
    """

    pair: ImpactPair
    wall: Wall
    side: Scalar
    t: Scalar
    speed: Scalar

    def push(self, s: Scalar) -> Scalar:
        """Return the forcing into the wall at time s after the onset."""
        return self.side * forcing_acceleration(waves_at(self.pair, self.t + s), self.pair.gamma)

    def acceleration(self, s: Scalar, w: Scalar, z: Scalar) -> Scalar:
        """Return w'' at penetration w and rate z, at time s after the onset."""
        return self.push(s) + self.wall(w, z)


def contact(pair: ImpactPair, side: Scalar, t: Scalar, speed: Scalar) -> Contact:
    """Return the contact that begins at time t with a wall of a pair; the membrane is `pair.law`."""
    here = pair.at(side)
    law: Any = here.law
    return Contact(here, law.bind(here), side, t, speed)


class ContactMotion(NamedTuple):
    """State of a ball in a membrane: penetration, its rate, and the energy given to the membrane since onset."""

    w: Scalar
    z: Scalar
    work: Scalar


def _time_fraction(x: Scalar) -> Scalar:
    """Return the fraction of the contact duration that has passed at x in [0, 1]: 3 x^2 - 2 x^3, flat at both ends."""
    return x * x * (3 - 2 * x)


def _field(x: Any, y: ContactMotion, args: tuple[Contact, Scalar]) -> ContactMotion:
    """Return the derivative of the state by x, where x is 0 at the onset and 1 at the end.

    The time is a smooth function of x and quadratic near both ends (`_time_fraction`).

    A force such as w^(3/2) has no power series in time at both ends, where w is small, but has one in x. Without this
    change of variable the method has order 3 for such a force.
    """
    of, contact_duration = args
    # Derivative of the time by x.
    time_rate = contact_duration * (6 * x * (1 - x))
    pull = of.wall(y.w, y.z)
    return ContactMotion(
        time_rate * y.z, time_rate * (of.push(contact_duration * _time_fraction(x)) + pull), -time_rate * pull * y.z
    )


class _Stages(NamedTuple):
    """Coefficients of a Runge-Kutta method: positions of the stages (c), their matrix (A), and the weights (b)."""

    at: np.ndarray
    before: np.ndarray
    weights: np.ndarray


@cache
def _stages() -> _Stages:
    """Return the stages of Dopri8 without the last one, which is the first stage of the next step."""
    import diffrax  # A deferred import: it takes a second, and linear membranes do not need it.

    table = diffrax.Dopri8.tableau
    # diffrax stores the rows of the strictly lower triangle; pad them to a square matrix.
    rows = [np.zeros(0), *table.a_lower[:-1]]
    before = np.stack([np.pad(row, (0, len(rows) - len(row))) for row in rows])
    return _Stages(np.array([0.0, *table.c[:-1]]), before, np.asarray(table.b_sol[:-1]))


@partial(jax.jit, static_argnames="steps")
def simulate_contact(
    of: Contact, contact_duration: Scalar, steps: int = STEPS, w: Scalar | float = 0.0
) -> tuple[Scalar, ContactMotion]:
    """Simulate a contact of known duration.

    Args:
        of: The contact.
        contact_duration: Duration of the contact.
        steps: Number of steps (static).
        w: Penetration at the onset, always 0. It is an argument so that derivatives with respect to it can be taken.

    Returns:
        Times since the onset and states there, [step]; the last entry is the end.
    """
    at, before, weights = jax.tree.map(partial(jnp.asarray, dtype=of.speed.dtype), _stages())
    x, h = jnp.linspace(0.0, 1.0, steps + 1, dtype=of.speed.dtype), 1 / steps

    def combine(y: ContactMotion, weights: Float[Array, " stage"], rates: ContactMotion) -> ContactMotion:
        return jax.tree.map(lambda y, rates: y + h * (weights * rates).sum(), y, rates)

    def advance_step(y: ContactMotion, begin: Scalar) -> tuple[ContactMotion, ContactMotion]:
        def stage(rates: ContactMotion, row: tuple[Array, Scalar, Array]) -> tuple[ContactMotion, None]:
            number, at, before = row
            rate = _field(begin + h * at, combine(y, before, rates), (of, contact_duration))
            return jax.tree.map(lambda rates, rate: rates.at[number].set(rate), rates, rate), None

        blank = jax.tree.map(lambda y: y * jnp.zeros_like(at), y)
        rates, _ = lax.scan(stage, blank, (jnp.arange(at.size), at, before))
        after = combine(y, weights, rates)
        return after, after

    # The zero depends on every traced input, so that the carry has its final batching and tangents from the start and
    # each loop is traced once.
    zero = 0.0 * (of.speed + of.t + contact_duration)
    _, states = lax.scan(advance_step, ContactMotion(zero + w, of.speed + zero, zero), x[:-1])
    return contact_duration * _time_fraction(x[1:]), states


def contact_state_at(
    of: Contact, contact_duration: Scalar, steps: int = STEPS, w: Scalar | float = 0.0
) -> ContactMotion:
    """Return the state of the ball at a time after the onset; see `simulate_contact`."""
    _, states = simulate_contact(of, contact_duration, steps, w)
    return jax.tree.map(lambda leaf: leaf[-1], states)


def error_estimate(of: Contact, contact_duration: Scalar) -> Scalar:
    """Return an error estimate of the state at the end of a contact, from a second run with twice as many steps.

    It is the larger of the difference of w divided by the contact duration, and the difference of w'.
    """
    coarse, finer = contact_state_at(of, contact_duration), contact_state_at(of, contact_duration, 2 * STEPS)
    return jnp.maximum(jnp.abs(coarse.w - finer.w) / contact_duration, jnp.abs(coarse.z - finer.z))


class ContactEndpoint(NamedTuple):
    """State (w, w') at the end of a contact, and its derivatives by onset time, onset speed and contact duration."""

    w: Scalar
    z: Scalar
    w_slope: Float[Array, "3"]
    z_slope: Float[Array, "3"]


def contact_endpoint(of: Contact, contact_duration: Scalar, steps: int = STEPS) -> ContactEndpoint:
    """Return the state at the end of a contact of known duration, and its derivatives."""

    def at(onset: Float[Array, "2"]) -> tuple[Float[Array, "2"], ContactMotion]:
        end_state = contact_state_at(
            eqx.tree_at(lambda of: (of.t, of.speed), of, (onset[0], onset[1])), contact_duration, steps
        )
        return jnp.stack([end_state.w, end_state.z]), end_state

    slopes, end_state = jax.jacfwd(at, has_aux=True)(jnp.stack([of.t, of.speed]))
    ahead = jnp.stack([end_state.z, of.acceleration(contact_duration, end_state.w, end_state.z)])
    w_slope, z_slope = jnp.concatenate([slopes, ahead[:, None]], axis=1)
    return ContactEndpoint(end_state.w, end_state.z, w_slope, z_slope)


def tangent_map(of: Contact, contact_duration: Scalar) -> Float[Array, "2 2"]:
    """Return the tangent map of a contact in (w, w'), from flight to flight; the force may jump at both ends."""
    zero = jnp.zeros_like(of.speed)

    def at(onset: Float[Array, "2"]) -> tuple[Float[Array, "2"], Scalar]:
        end_state = contact_state_at(eqx.tree_at(lambda of: of.speed, of, onset[1]), contact_duration, w=onset[0])
        return jnp.stack([end_state.w, end_state.z]), end_state.z

    inside, z = jax.jacfwd(at, has_aux=True)(jnp.stack([zero, of.speed]))
    # The force jumps up at the onset and back at the exit; each jump is a saltation matrix.
    return _saltation(-_force_jump_ratio(of, z)) @ inside @ _saltation(_force_jump_ratio(of, of.speed))


def _force_jump_ratio(of: Contact, z: Scalar) -> Scalar:
    """Return the jump of the force at w = 0 divided by the rate z of the crossing; if z = 0, the limit of the ratio."""
    zero, still = jnp.zeros_like(z), z == 0
    _, slope = jax.jvp(lambda z: of.wall(zero, z), (zero,), (zero + 1,))
    return jnp.where(still, slope, of.wall(zero, z) / jnp.where(still, 1.0, z))


def _saltation(jump: Scalar) -> Float[Array, "2 2"]:
    """Return the saltation matrix [[1, 0], [jump, 1]]."""
    unit = jnp.ones_like(jump)
    return jnp.stack([jnp.stack([unit, 0 * unit]), jnp.stack([jump, unit])])


def turning_points(of: Contact, contact_duration: Scalar) -> TurningPoints:
    """Return the deepest point of a contact, and its smallest minimum inside.

    A pair of turning points within one step is not detected. A step is at most 5 % of the contact duration.
    """
    s, (w, z, _) = simulate_contact(of, contact_duration)
    begin = jnp.zeros((1,), s.dtype)
    s0, w0, z0 = (jnp.concatenate([first, rest[:-1]]) for first, rest in ((begin, s), (begin, w), (of.speed[None], z)))
    # Turning point of the cubic through the states at both ends of each step.
    when, extremum = jax.vmap(_cubic_extremum)(s - s0, w0, z0, w, z)
    maxima, minima = (z0 > 0) & (z <= 0), (z0 < 0) & (z >= 0)
    highest_step, lowest_step = (
        jnp.argmax(jnp.where(maxima, extremum, -jnp.inf)),
        jnp.argmin(jnp.where(minima, extremum, jnp.inf)),
    )
    crest, highest = _refine_turning(of, s0[highest_step] + when[highest_step], -1.0)
    trough, lowest = _refine_turning(of, s0[lowest_step] + when[lowest_step], 1.0)
    has_minimum, failed = minima.any(), ~maxima.any() | ~jnp.isfinite(crest)
    return TurningPoints(
        contact_duration,
        crest,
        highest,
        jnp.where(has_minimum, trough, 0.0),
        jnp.where(has_minimum, lowest, jnp.inf),
        failed,
    )


def _refine_turning(of: Contact, s: Scalar, sign: float) -> tuple[Scalar, Scalar]:
    """Return the time of a turning point near s, and w at that time, by two steps of Newton's method.

    The acceleration must have the sign `sign`: -1 at a maximum, 1 at a minimum. Otherwise there is no turning point and
    s is unchanged.
    """
    for _ in range(2):
        now = contact_state_at(of, s)
        bend = sign * of.acceleration(s, now.w, now.z)
        s = s - jnp.where(bend > 0, sign * now.z / jnp.where(bend > 0, bend, 1.0), 0.0)
    return s, contact_state_at(of, s).w


def _cubic_extremum(h: Scalar, w0: Scalar, z0: Scalar, w1: Scalar, z1: Scalar) -> tuple[Scalar, Scalar]:
    """Return the time and the value of the turning point of the cubic through the states at both ends of a step.

    The time is relative to the start of the step, which has length h. The slope changes sign between the ends.
    """
    rise = w1 - w0
    # The slope is h z0 + 2 b x + 3 c x^2 for x in [0, 1].
    begin, ends = h * z0, h * z1
    b, c = 3 * rise - 2 * begin - ends, begin + ends - 2 * rise
    # The root is selected so that the slope changes sign in the same direction as between the ends.
    root = jnp.sqrt(jnp.maximum(b * b - 3 * c * begin, 0.0))
    below = -b + jnp.where(z0 > z1, root, -root)
    x = jnp.clip(jnp.where(below != 0, begin / jnp.where(below != 0, below, 1.0), 0.5), 0.0, 1.0)
    return x * h, w0 + x * (begin + x * (b + x * c))
