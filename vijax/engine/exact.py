"""Exact event-driven engine: next wall crossing, the contact or the reset there, and the state after it.

The careful form: every search brackets the first root by a certificate before it iterates, so that no crossing, graze
or early exit is missed in any regime (`flight_search`, `contact_search`). `quick` does the regular impacts faster and
declines the others.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.engine.contact_search import PATIENCE, exit_and_crest, first_return
from vijax.engine.flight_search import next_wall
from vijax.engine.forcing_sign import spell_after
from vijax.engine.roots import implicit_root, implicit_state
from vijax.model import energy, flow
from vijax.model.flow import Membrane
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.xla import loop_body


class Outcome(eqx.Module):
    """What one step did: the state after it, the impact (side 0: none), and how long it flew and stayed on the wall."""

    state: State
    impact: Impact
    flight: Scalar
    stay: Scalar
    stuck: Flag  # a rigid wall held the ball until release
    quiet: Flag  # no wall within the horizon: the state is the start's
    permanent: Flag  # the contact never ends: the state is that of its onset


def stick_speed(dtype: Any) -> float:
    """Give the exit speed below which a chattering ball counts as stuck: 1e-9 in float64, else by the root of eps."""
    return 1e-9 * math.sqrt(jnp.finfo(dtype).eps / jnp.finfo(jnp.float64).eps)


# A ball counts as stuck once the rest of its chatter lasts less than this share of the time to its release. A larger
# one holds balls that would still be bouncing then, a smaller one follows more bounces that nobody sees.
STICK_SHARE = 1e-3


def _soft_contact(
    pair: ImpactPair,
    wall: Membrane,
    side: Scalar,
    t: Scalar,
    w0: Scalar,
    z0: Scalar,
    wanted: Flag,
    deep: bool,
    patience: int | Array,
):
    """Find duration (inf: for ever), outward speed -w' at the exit, and largest penetration of a contact."""
    force = flow.contact_force(pair.gamma, side, t)
    args = (wall, force, w0, z0)
    # Derivatives come from the root that is found, not from the search for it.
    frozen = lax.stop_gradient(args)
    if deep:
        duration, when = exit_and_crest(*frozen, wanted, patience)
    else:
        duration, when = first_return(*frozen, wanted, patience), jnp.zeros_like(w0)
    ends, turned = wanted & jnp.isfinite(duration), wanted & (when > 0)

    def look(which: Array, seen: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        exits = which == 0
        # Where there is none, the harmless time 1 stands there meanwhile; a crest that is not known is NaN.
        known, s = jnp.where(exits, ends, turned), jnp.where(exits, duration, when)
        found, state = implicit_state(_exit_or_crest, _contact_rates, jnp.where(known, s, 1.0), (which, args))
        s, state = jnp.where(known, found, s), jnp.where(known, state, jnp.where(exits, z0, w0 + 0.0 * when))
        return jnp.where(exits, s, seen[0]), jnp.where(exits, state, seen[1]), state

    # A loop, so that a program holds the membrane's flow once for both, and its derivatives.
    duration, z, depth = lax.fori_loop(0, 1 + deep, loop_body(look), (duration, z0, when))
    return duration, -z, depth if deep else jnp.full_like(z, jnp.nan)


def _exit_or_crest(s, of):
    """Say what vanishes there, and give what else there is: w and w', or w' and w."""
    which, args = of
    w, z = flow.oscillate(*args, s)
    return jnp.where(which == 0, w, z), jnp.where(which == 0, z, w)


def _contact_rates(s, of, state):
    """Compute the derivatives of `_exit_or_crest` in s: w' and w'' at the exit, w'' and w' = 0 at the crest."""
    which, (m, force, _, _) = of
    exits = which == 0
    # At the exit w = 0 and the state is w'; at the crest w' = 0 and the state is w.
    acceleration = force.at(s) - jnp.where(exits, m.mu, m.kappa * m.kappa) * state
    return jnp.where(exits, state, acceleration), jnp.where(exits, acceleration, 0.0)


def _crossing(s, args):
    force, side, distance, v0 = args
    rise, v = flow.flight(force, v0, s)
    return distance - side * rise, v


def _flight_rates(s, args, v):
    """Compute the derivatives of `_crossing` in s: of the distance to the wall, and of the velocity."""
    force, side, _, _ = args
    return -side * v, force.at(s)


def _rigid_contact(pair: ImpactPair, side: Scalar, t: Scalar, speed: Scalar, held: Flag):
    """Find the outward speed after a rigid impact, whether it sticks, and for how long (inf: for ever).

    A chatter is a geometric series of bounces; what is left of it lasts 2 v/(a (1 - r)).
    """
    force = flow.contact_force(pair.gamma, side, t)
    push = force.at(jnp.zeros_like(t))
    spell = spell_after(lax.stop_gradient(force), jnp.zeros_like(t))
    # Each bounce that is left is r times as fast as the last one, under a push that hardly changes meanwhile.
    out = pair.r * speed
    chatter = 2 * out / jnp.where(push > 0, push, 1.0) / jnp.maximum(1 - pair.r, jnp.finfo(t.dtype).tiny)
    tired = (out < stick_speed(t.dtype)) & (push > 0) & (chatter < STICK_SHARE * spell.end) & (pair.r < 1)
    stuck = (tired | held) & spell.positive
    release = jnp.where(jnp.isfinite(spell.end), spell.end, 1.0)
    release = jnp.where(jnp.isfinite(spell.end), implicit_root(lambda s, f: f.at(s), release, force), spell.end)
    return jnp.where(stuck, 0.0, out), stuck, jnp.where(stuck, release, 0.0)


def _onset(pair: ImpactPair, state: State, horizon: Scalar, wanted: Flag) -> tuple[Scalar, Scalar, Scalar, Flag]:
    """Find how long the ball flies to the next wall, the wall's side, the velocity there, and whether one is reached.

    A ball in contact is at its wall already, after a flight of length 0.
    """
    room = (0.5 * pair.d + state.u, 0.5 * pair.d - state.u)
    force = flow.flight_force(pair.gamma, state.t)
    # The search is not differentiated: `implicit_state` adds the derivatives of the time that it finds. Where it finds
    # none, the harmless time 1 stands there meanwhile, as both sides of a `where` are differentiated.
    sought = lax.stop_gradient((force, room, state.v, horizon))
    flight, side = next_wall(*sought, wanted)
    reached = wanted & (side != 0)
    side = jnp.where(state.mode != 0, state.mode.astype(flight.dtype), jnp.where(reached, side, 1.0))
    args = (force, side, jnp.where(side > 0, room[1], room[0]), state.v)
    flight, v_in = implicit_state(_crossing, _flight_rates, jnp.where(reached, flight, 1.0), args)
    return jnp.where(reached, flight, 0.0), side, jnp.where(reached, v_in, state.v), reached


def step(
    pair: ImpactPair,
    state: State,
    horizon: Scalar,
    *,
    deep: bool = True,
    patience: int | Array = PATIENCE,
    rolled: bool = False,
) -> Outcome:
    """Fly to the next wall, go through the contact there, and leave it: one impact.

    Args:
        pair: One cell (scalars). `kappa=None` is the rigid wall; its depth is |v_in| chi(r), that of kappa = 1.
        state: In flight, or in contact from the start (a contact without onset: the impact has side 0).
        horizon: Time beyond which no onset is looked for.
        deep: Whether to look for the greatest depth (and the work); NaN else.
        patience: Stages that a contact may take to be decided; if they do not do, its `stay` or depth is NaN.
        rolled: For programs that are differentiated, or run briefly; see `flow.Membrane`.

    Differentiable in pair and state, forward and reverse, to any order: event times by the implicit function.
    """
    held = state.mode != 0
    wanted = ~held & (horizon > 0)
    flight, side, v_in, reached = _onset(pair, state, horizon, wanted)
    t, periods = flow.wrap_phase(state.t + flight)
    meets = reached | held

    def rigid(wall: ImpactPair) -> tuple[Any, ...]:
        out, stuck, stay = _rigid_contact(wall, side, t, side * v_in, held)
        depth = side * v_in * energy.rigid_depth(wall)
        return stay, out, depth, energy.membrane_work_rigid(v_in, wall.r), stuck

    def soft(wall: ImpactPair) -> tuple[Any, ...]:
        w0 = jnp.where(held, side * state.u - 0.5 * pair.d, 0.0)
        given = wall, flow.membrane(wall, rolled=rolled), side, t, w0, side * v_in
        stay, out, depth = _soft_contact(*given, meets & ~pair.hard(side), deep, patience)
        ended = jnp.where(jnp.isfinite(stay), stay, 1.0)
        work = energy.membrane_work(wall.kappa, wall.mu, pair.gamma, side, t, ended, v_in, -side * out)
        return stay, out, depth, work, jnp.zeros_like(held)

    stay, out, depth, work, stuck = pair.met(side, rigid, soft)
    permanent = meets & jnp.isinf(stay)
    ends = meets & ~permanent
    n = state.n + periods.astype(state.n.dtype)
    leave, more = flow.wrap_phase(t + jnp.where(ends, stay, 0.0))
    after = State(
        u=jnp.where(ends, 0.5 * side * pair.d, state.u),
        v=jnp.where(ends, -side * out, state.v),
        t=jnp.where(ends, leave, state.t),
        n=jnp.where(ends, n + more.astype(n.dtype), state.n),
        mode=jnp.where(ends, 0, state.mode),
    )
    counted = jnp.where(reached, side, 0.0).astype(state.mode.dtype)
    impact = Impact(n=n, t=t, side=counted, v_in=v_in, v_out=-side * out, depth=depth, duration=stay, work=work)
    return Outcome(after, impact, flight, stay, stuck & ends, wanted & ~reached, permanent)


def start_mode(pair: ImpactPair, u: Values, v: Values, t: Values) -> Values:
    """Find a start's contact side (0: none): inside a soft wall; on a wall by velocity, at rest by acceleration.

    A rigid wall holds only a ball that rests on it and is pushed against it. Where the acceleration is zero, or as good
    as that, it counts as what it is about to be: a ball that is set free for 1e-16 of a period has no impact.
    """
    side = jnp.where(u > 0, 1.0, -1.0).astype(u.dtype)
    gap = 0.5 * pair.d - side * u
    pressed = spell_after(flow.contact_force(pair.gamma, side, t), jnp.zeros_like(t)).positive
    resting = (gap == 0) & (v == 0) & pressed
    entered = (gap < 0) | ((gap == 0) & (side * v > 0))
    return jnp.where(resting | (entered & ~pair.hard(side)), side, 0.0)


def tangent(pair: ImpactPair, outcome: Outcome) -> Float[Array, "2 2 *lane"]:
    """Compute the tangent map of a step in (du, du') at fixed times, from flight to flight, saltations included.

    A stuck ball forgets how it came: the zero matrix. Steps may be those of many balls at once.
    """

    def rigid(wall: ImpactPair) -> list[Values]:
        push = flow.acceleration(pair.gamma, outcome.impact.t)
        matrix = jnp.where(outcome.stuck, 0.0, flow.rigid_matrix(wall.r, push, outcome.impact.v_in))
        return [*matrix[0], *matrix[1]]

    def soft(wall: ImpactPair) -> list[Values]:
        matrix = flow.contact_matrix(flow.membrane(wall), outcome.stay)
        return [*matrix[0], *matrix[1]]

    # The ball has just left the wall. Times `flow.flight_matrix`, number by number: an accelerator is slow at many
    # products of small matrices.
    a, b, c, d = pair.met(outcome.state.u, rigid, soft)
    return jnp.array([[a, a * outcome.flight + b], [c, c * outcome.flight + d]])
