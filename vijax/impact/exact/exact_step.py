"""Exact event-driven engine: flight to the next wall, then contact (soft wall) or velocity reset (rigid wall).

This is the slow, robust method. Each search brackets the first root by a certificate before it iterates
(`flight_search`, `contact_search`), so it misses no crossing, no grazing and no early exit in any regime. `fast_step`
computes most impacts faster and declines the others.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.impact.exact.contact_search import MAX_STAGES, exit_and_crest, first_return
from vijax.impact.exact.flight_search import next_wall
from vijax.impact.roots import implicit_root, implicit_state
from vijax.impact.sign_intervals import sign_interval_after
from vijax.model import energy, flow
from vijax.model.flow import Membrane
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.runtime.arrays import Flag, Scalar, Values
from vijax.runtime.compilation.xla import loop_body


class ExactResult(eqx.Module):
    """Result of one step.

    Attributes:
        state: State after the step.
        impact: The impact; its side is 0 if there was no onset.
        flight: Time of flight to the onset.
        contact_duration: Contact duration; inf if the contact never ends.
        stuck: The ball stuck on a rigid wall from the onset until its release.
        no_impact: No wall is reached within the horizon; the state is the initial state.
        permanent: The contact never ends; the state is the state at its onset.
    """

    state: State
    impact: Impact
    flight: Scalar
    contact_duration: Scalar
    stuck: Flag
    no_impact: Flag
    permanent: Flag


def stick_speed(dtype: Any) -> float:
    """Return the exit speed below which a chattering ball may count as stuck.

    It is 1e-9 in float64 and is proportional to the square root of eps in other precisions.
    """
    return 1e-9 * math.sqrt(jnp.finfo(dtype).eps / jnp.finfo(jnp.float64).eps)


# A ball counts as stuck once the rest of its chatter is shorter than this fraction of the time to its release. A larger
# value would stop balls that still bounce at their release; a smaller one would follow more bounces without an effect
# on the result.
STICK_SHARE = 1e-3


def _soft_contact(
    pair: ImpactPair,
    wall: Membrane,
    side: Scalar,
    t: Scalar,
    w0: Scalar,
    z0: Scalar,
    active: Flag,
    deep: bool,
    max_stages: int | Array,
):
    """Return duration (inf: for ever), outward speed -w' at the exit, and largest penetration of a contact.

    The penetration is NaN unless `deep`.
    """
    force = flow.contact_force(pair.gamma, side, t)
    args = (wall, force, w0, z0)
    # Derivatives belong to the root, not to the search, so the search is not differentiated.
    constants = lax.stop_gradient(args)
    if deep:
        duration, crest_time = exit_and_crest(*constants, active, max_stages)
    else:
        duration, crest_time = first_return(*constants, active, max_stages), jnp.zeros_like(w0)
    has_exit, has_crest = active & jnp.isfinite(duration), active & (crest_time > 0)

    def refine(which: Array, results: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        """Refine the exit (which = 0) or the crest (which = 1) so that it carries derivatives, and store its state."""
        exits = which == 0
        # If there is no root, time 1 stands in for it, so that both branches of `where` have finite derivatives. A
        # crest that is not decided stays NaN.
        exists, s = jnp.where(exits, has_exit, has_crest), jnp.where(exits, duration, crest_time)
        root, state = implicit_state(_exit_or_crest, _contact_rates, jnp.where(exists, s, 1.0), (which, args))
        s, state = jnp.where(exists, root, s), jnp.where(exists, state, jnp.where(exits, z0, w0 + 0.0 * crest_time))
        return jnp.where(exits, s, results[0]), jnp.where(exits, state, results[1]), state

    # A loop, so that the program contains the flow of the membrane and its derivatives once for exit and crest.
    duration, z, depth = lax.fori_loop(0, 1 + deep, loop_body(refine), (duration, z0, crest_time))
    return duration, -z, depth if deep else jnp.full_like(z, jnp.nan)


def _exit_or_crest(s, problem):
    """Return the residual and the state at time s: (w, w') for the exit, (w', w) for the crest."""
    which, args = problem
    w, z = flow.oscillate(*args, s)
    return jnp.where(which == 0, w, z), jnp.where(which == 0, z, w)


def _contact_rates(s, problem, state):
    """Return the derivatives by s of residual and state: (w', w'') at the exit, (w'', w' = 0) at the crest."""
    which, (m, force, _, _) = problem
    exits = which == 0
    # At the exit w = 0 and the state is w'. At the crest w' = 0 and the state is w.
    acceleration = force.at(s) - jnp.where(exits, m.mu, m.kappa * m.kappa) * state
    return jnp.where(exits, state, acceleration), jnp.where(exits, acceleration, 0.0)


def _crossing(s, args):
    """Return, at time s of a flight, the clearance to the wall (residual) and the velocity v of the ball (state)."""
    force, side, distance, v0 = args
    rise, v = flow.flight(force, v0, s)
    return distance - side * rise, v


def _flight_rates(s, args, v):
    """Return the first derivatives by time s of the two results of `_crossing`: clearance and velocity."""
    force, side, _, _ = args
    return -side * v, force.at(s)


def _rigid_contact(pair: ImpactPair, side: Scalar, t: Scalar, speed: Scalar, at_rest: Flag):
    """Return the outward speed after a rigid impact, whether the ball sticks, and for how long (inf: for ever).

    A chatter is a geometric series of bounces. After a rebound at speed v, under an acceleration a into the wall, the
    rest of the chatter lasts 2 v/(a (1 - r)).
    """
    force = flow.contact_force(pair.gamma, side, t)
    push = force.at(jnp.zeros_like(t))
    interval = sign_interval_after(lax.stop_gradient(force), jnp.zeros_like(t))
    # Each further bounce has r times the speed of the last one. The force hardly changes during the chatter.
    out = pair.r * speed
    chatter = 2 * out / jnp.where(push > 0, push, 1.0) / jnp.maximum(1 - pair.r, jnp.finfo(t.dtype).tiny)
    chatter_ends = (out < stick_speed(t.dtype)) & (push > 0) & (chatter < STICK_SHARE * interval.end) & (pair.r < 1)
    # A ball that is in contact at the start sticks whatever its speed.
    stuck = (chatter_ends | at_rest) & interval.positive
    # If the ball is never released, time 1 stands in for the release, so that derivatives are finite.
    release = jnp.where(jnp.isfinite(interval.end), interval.end, 1.0)
    release = jnp.where(jnp.isfinite(interval.end), implicit_root(lambda s, f: f.at(s), release, force), interval.end)
    return jnp.where(stuck, 0.0, out), stuck, jnp.where(stuck, release, 0.0)


def _onset(pair: ImpactPair, state: State, horizon: Scalar, active: Flag) -> tuple[Scalar, Scalar, Scalar, Flag]:
    """Return the time of flight, the side of the next wall, the velocity there, and whether a wall is reached.

    For a ball in contact the time of flight is 0 and the side is the side of its contact.
    """
    clearances = (0.5 * pair.d + state.u, 0.5 * pair.d - state.u)
    force = flow.flight_force(pair.gamma, state.t)
    # The search is not differentiated: `implicit_state` adds the derivatives of its result. If no wall is reached, time
    # 1 stands in for the result, because both branches of `where` are differentiated.
    constants = lax.stop_gradient((force, clearances, state.v, horizon))
    flight, side = next_wall(*constants, active)
    reached = active & (side != 0)
    side = jnp.where(state.mode != 0, state.mode.astype(flight.dtype), jnp.where(reached, side, 1.0))
    args = (force, side, jnp.where(side > 0, clearances[1], clearances[0]), state.v)
    flight, v_in = implicit_state(_crossing, _flight_rates, jnp.where(reached, flight, 1.0), args)
    return jnp.where(reached, flight, 0.0), side, jnp.where(reached, v_in, state.v), reached


def step(
    pair: ImpactPair,
    state: State,
    horizon: Scalar,
    *,
    deep: bool = True,
    max_stages: int | Array = MAX_STAGES,
    rolled: bool = False,
) -> ExactResult:
    """Simulate one impact: the flight to the next wall, the contact there, and the exit.

    Args:
        pair: One cell (scalars). `kappa=None` means rigid walls; the depth at a rigid wall is |v_in| chi(r), the depth
            of the membrane contact with the same restitution and kappa = 1.
        state: State in flight, or in contact at the start (a contact without onset: the impact has side 0).
        horizon: Longest time of flight that is searched for an onset.
        deep: If True, compute the largest depth of a contact with a soft wall; otherwise it is NaN. The work, and the
            depth at a rigid wall, are always computed.
        max_stages: Largest number of stages of a contact's search. If the search has not ended by then,
            `contact_duration` or the depth is NaN.
        rolled: If True, keep the series of a contact as a loop, which compiles faster and runs slower. This suits
            programs that are differentiated or run briefly; see `flow.Membrane`.

    The result is differentiable in pair and state, in forward and reverse mode, to any order: the derivatives of event
    times follow from the implicit function theorem.
    """
    in_contact = state.mode != 0
    in_flight = ~in_contact & (horizon > 0)
    flight, side, v_in, reached = _onset(pair, state, horizon, in_flight)
    t, periods = flow.wrap_phase(state.t + flight)
    has_contact = reached | in_contact

    def rigid(wall: ImpactPair) -> tuple[Any, ...]:
        out, stuck, contact_duration = _rigid_contact(wall, side, t, side * v_in, in_contact)
        # Eq. (35): the depth of a rigid impact is proportional to its speed.
        depth = side * v_in * energy.rigid_depth(wall)
        return contact_duration, out, depth, energy.membrane_work_rigid(v_in, wall.r), stuck

    def soft(wall: ImpactPair) -> tuple[Any, ...]:
        w0 = jnp.where(in_contact, side * state.u - 0.5 * pair.d, 0.0)
        args = wall, flow.membrane(wall, rolled=rolled), side, t, w0, side * v_in
        contact_duration, out, depth = _soft_contact(*args, has_contact & ~pair.is_rigid_at(side), deep, max_stages)
        # A finite stand-in for an infinite duration keeps the derivatives of the work finite.
        finite_duration = jnp.where(jnp.isfinite(contact_duration), contact_duration, 1.0)
        work = energy.membrane_work(wall.kappa, wall.mu, pair.gamma, side, t, finite_duration, v_in, -side * out)
        return contact_duration, out, depth, work, jnp.zeros_like(in_contact)

    contact_duration, out, depth, work, stuck = pair.by_wall_kind(side, rigid, soft)
    permanent = has_contact & jnp.isinf(contact_duration)
    ends = has_contact & ~permanent
    n = state.n + periods.astype(state.n.dtype)
    leave, more = flow.wrap_phase(t + jnp.where(ends, contact_duration, 0.0))
    after = State(
        u=jnp.where(ends, 0.5 * side * pair.d, state.u),
        v=jnp.where(ends, -side * out, state.v),
        t=jnp.where(ends, leave, state.t),
        n=jnp.where(ends, n + more.astype(n.dtype), state.n),
        mode=jnp.where(ends, 0, state.mode),
    )
    impact_side = jnp.where(reached, side, 0.0).astype(state.mode.dtype)
    impact = Impact(
        n=n, t=t, side=impact_side, v_in=v_in, v_out=-side * out, depth=depth, duration=contact_duration, work=work
    )
    return ExactResult(after, impact, flight, contact_duration, stuck & ends, in_flight & ~reached, permanent)


def start_mode(pair: ImpactPair, u: Values, v: Values, t: Values) -> Values:
    """Return the contact side of an initial state; 0 in flight.

    A ball inside a soft wall is in contact. On the border of a soft wall it is in contact if its velocity points into
    the wall or, at rest, if the forcing presses it on the wall. On a rigid wall only a ball at rest that is pressed on
    the wall is in contact. If the forcing is zero to rounding, its sign just afterwards decides, so that a ball that
    would be released after 1e-16 of a period is in flight.
    """
    side = jnp.where(u > 0, 1.0, -1.0).astype(u.dtype)
    clearance = 0.5 * pair.d - side * u
    is_pushed = sign_interval_after(flow.contact_force(pair.gamma, side, t), jnp.zeros_like(t)).positive
    resting = (clearance == 0) & (v == 0) & is_pushed
    entered = (clearance < 0) | ((clearance == 0) & (side * v > 0))
    return jnp.where(resting | (entered & ~pair.is_rigid_at(side)), side, 0.0)


def tangent_map(pair: ImpactPair, outcome: ExactResult) -> Float[Array, "2 2 *lane"]:
    """Return the tangent map of a step in (du, du') at fixed times, from flight to flight, with saltations.

    The map of a ball that sticks is zero, because its later motion does not depend on its earlier state. The fields of
    the step may hold many lanes.
    """

    def rigid(wall: ImpactPair) -> list[Values]:
        push = flow.acceleration(pair.gamma, outcome.impact.t)
        matrix = jnp.where(outcome.stuck, 0.0, flow.rigid_matrix(wall.r, push, outcome.impact.v_in))
        return [*matrix[0], *matrix[1]]

    def soft(wall: ImpactPair) -> list[Values]:
        matrix = flow.contact_matrix(flow.membrane(wall), outcome.contact_duration)
        return [*matrix[0], *matrix[1]]

    # The ball is on the wall that it leaves. The product with `flow.flight_matrix` is written out entry by entry: an
    # accelerator is slow at many products of small matrices.
    a, b, c, d = pair.by_wall_kind(outcome.state.u, rigid, soft)
    return jnp.array([[a, a * outcome.flight + b], [c, c * outcome.flight + d]])
