"""Motion under any excitation: harmonics, samples joined by straight lines, and noise; there is no step size to choose.

Between two knots of the excitation the motion is a Taylor series that is exact to rounding (`taylor`). A step ends at
the next knot (a time where a straight line of the excitation begins). If an event (a wall crossing, an exit or the
deepest point of a contact) cannot be excluded, the step is halved. Once a certificate shows that exactly one event lies
ahead, further steps approach the event by a fourth-order iteration within its bracket, and the last step ends at the
event (`driven_events`). Each lane decides its steps alone, so no lane waits for another.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from vijax.impact.forcing import REACHED, Draws, Forcing
from vijax.impact.method import MAX_CONTACT_PERIODS, ImpactOutcome, Method, impact_outcome, save_decision
from vijax.impact.taylor import taylor
from vijax.impact.taylor.driven_events import (
    NONE,
    Decision,
    DrivenCarry,
    StepEnd,
    certify_step,
    decide_step,
    end_step,
    residual,
)
from vijax.impact.taylor.driven_rigid import (
    DrivenWall,
    RigidImpact,
    driven_walls,
    keep_at_rest,
    record_impact,
    rigid_impact,
    watch_push,
)
from vijax.impact.taylor.taylor import Oscillator, Push
from vijax.model.forcing.waves import Waves
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.walls.sides import Sides, at_wall, values_by_name
from vijax.runtime import validation
from vijax.runtime.arrays import Flag, Scalar, not_none
from vijax.runtime.compilation.xla import materialise

# Upper bound of the number of steps for one contact and the search for its onset, used in the step limit of recorded
# runs. Most impacts need a tenth of this number.
_PER_IMPACT = 256


def _identity_map(zero: Scalar) -> tuple[Scalar, ...]:
    """Return the identity as a tangent map, row by row."""
    return zero + 1, zero, zero, zero + 1


class _Clock(NamedTuple):
    """Time of a lane: knots passed, time since the last knot, periods completed, phase in the present period."""

    k: Scalar
    s: Scalar
    n: Int[Array, ""]
    t: Scalar


class Driven(Method[DrivenCarry]):
    """Method for excitations other than the sine, with linear membranes and rigid walls.

    Attributes:
        forcing: The excitation.
    """

    forcing: Forcing

    @property
    def arithmetic(self) -> bool:
        """True: a step uses only elementwise arithmetic and calls no library."""
        return True

    def walls(self, pair: ImpactPair) -> DrivenWall | Sides:
        """Return the walls of a pair: one value if both are equal, otherwise one value per wall."""
        return driven_walls(pair)

    def step_count(self, m: DrivenCarry) -> Int[Array, ""]:
        """Return the number of steps so far."""
        return m.steps

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Return the step limit of a recorded run; it is sufficient for a ball that is always inside a membrane."""
        knots = int(self.forcing.knots_per_period) + 1
        inside_steps = 0.0
        kappas = [value for value in values_by_name("kappa", pair.kappa).values() if value is not None]
        if kappas and validation.is_concrete(kappas):
            inside_steps = max(float(np.max(value)) for value in kappas) * 2 / taylor.REACH
        return (knots + int(inside_steps) + 16) * (periods + MAX_CONTACT_PERIODS) + _PER_IMPACT * max_impacts

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> DrivenCarry:
        """Return the carry for an initial state."""
        zero, zero_count = jnp.zeros_like(state.u), jnp.zeros_like(state.n)
        n = state.n.astype(zero.dtype)
        k = self.forcing.knot_at(n, state.t)
        # A knot slightly ahead counts as passed, and the time since that knot would be slightly negative.
        since = jnp.maximum(state.t - (k - n * self.forcing.knots_per_period) * self.forcing.knot_spacing, 0.0)
        draws = self.forcing.draws(pair, state, k)
        mode = self._mode(pair, state, k, since, draws)
        in_contact, side = mode != 0, mode.astype(zero.dtype)
        x = jnp.where(in_contact, side * state.u - 0.5 * pair.d, state.u)
        return DrivenCarry(
            x=x,
            z=jnp.where(in_contact, side * state.v, state.v),
            k=k,
            s=since,
            n=state.n,
            mode=mode,
            trial=zero + jnp.inf,
            event=zero,
            bracket=zero,
            onset_t=state.t,
            onset_n=state.n,
            entered=jnp.zeros_like(in_contact),
            v_in=state.v,
            depth=jnp.where(in_contact, x, 0.0),
            work=zero if deep else None,
            exit_t=state.t,
            exit_n=state.n,
            tangent=_identity_map(zero) if tangent else None,
            draws=draws,
            steps=zero_count,
        )

    def _mode(self, pair: ImpactPair, state: State, k: Scalar, since: Scalar, draws: Draws | None) -> Int[Array, ""]:
        """Return the contact mode of an initial state.

        A ball at rest on a wall is in contact if the forcing at that time presses the ball on the wall. The mode in
        `state` is valid for the sine only, so it is replaced for such a ball.
        """
        side = jnp.where(state.u < 0, -1.0, 1.0).astype(state.u.dtype)
        value, rate, *_ = self.forcing.push(pair.gamma, k, since, state.t, draws).derivatives()
        pushed = side * jnp.where(value == 0, rate, value) > 0
        if pair.rigid or pair.rigid_side:
            # Under zero force a ball at rest on a rigid wall stays there.
            pushed = pushed | (pair.is_rigid_at(side) & (value == 0) & (rate == 0))
        rests = (side * state.u == 0.5 * pair.d) & (state.v == 0)
        return jnp.where(rests, jnp.where(pushed, side, 0.0).astype(state.mode.dtype), state.mode)

    def step(
        self, pair: ImpactPair, walls: DrivenWall | Sides, m: DrivenCarry, *, recorded: bool = False
    ) -> tuple[DrivenCarry, ImpactOutcome, Flag]:
        """Try one step: to a knot, to a time before a possible event, towards a certified event, or exactly to it."""
        half, in_contact, rigid = 0.5 * pair.d, m.mode != 0, pair.rigid or bool(pair.rigid_side)
        side = jnp.where(m.mode < 0, -1.0, 1.0).astype(half.dtype)
        to_knot, to_period = self.forcing.knot_spacing - m.s, self._to_period(m)
        spring = _spring_of(walls, side, in_contact, self.forcing.reach)
        push = self.forcing.push(pair.gamma, m.k, m.s, 2 - to_period, m.draws).turned(jnp.where(in_contact, side, 1.0))
        longest = jnp.minimum(to_knot, jnp.minimum(spring.reach, self.forcing.reach))
        if recorded:
            # A recorded run needs the states at phase 0, so a step ends there.
            longest = jnp.where(to_period < longest * (1 - REACHED), to_period, longest)
        # When the step is differentiated, a trial length counts as a constant. The length of a step to a knot depends
        # on the time at its start.
        s, to_knot, to_period = materialise((jnp.minimum(lax.stop_gradient(m.trial), longest), to_knot, to_period))
        now, later = materialise(taylor.rates(spring, push, m.x, m.z)), push.later(s)
        end = materialise(taylor.rates(spring, later, *taylor.advance_series(spring, push, m.x, m.z, s)))
        most = taylor.fourth_derivative_bound(spring, self.forcing.curvature_bound, now, s)
        rests = in_contact & pair.is_rigid_at(side) if rigid else None
        if rests is not None:
            now, end, most = watch_push(rests, push, later, self.forcing, (now, end, most))
        sprung = in_contact if rests is None else in_contact & ~rests
        certificate = certify_step(in_contact, sprung, m.work is not None, half, most, now, end, s)
        certificate = materialise(certificate._replace(event=jnp.where(m.event != NONE, m.event, certificate.event)))
        f = materialise(residual(certificate.event, half, end))
        args = m, half, spring.kappa, certificate, end, f, s, self.forcing.knot_spacing
        decision = save_decision(lax.stop_gradient(materialise(decide_step(*args))))
        step_end, impact = end_step(decision, half, side, s, end, f), None
        if rests is not None:
            push_at_end = later.later(step_end.delay)
            impact, step_end = rigid_impact(
                pair, walls, keep_at_rest(step_end, decision, rests), push_at_end, self.forcing.knot_spacing
            )
        step_end = materialise(step_end)
        clock = materialise(self._clock(m, step_end.length, to_knot, to_period, decision.accepted))
        work, tangent = m.work, m.tangent
        if work is not None:
            square = taylor.squared_rate(spring, (push, later), (now, end), s, step_end.delay)
            work = work + jnp.where(decision.accepted & sprung, spring.mu * square, 0.0)
        if tangent is not None:
            carried = _tangent_after(spring, push, later, m, s, step_end.delay, _saltation_entry(walls, side, step_end))
            tangent = tuple(jnp.where(decision.accepted, new, old) for new, old in zip(carried, tangent, strict=True))
        m = replace(m, work=work, tangent=tangent, draws=self.forcing.advance_draws(m.draws, m.k, clock.k))
        ended = step_end.exits & m.entered
        if impact is not None:
            m = record_impact(m, impact, step_end, (clock.t, clock.n), not_none(rests))
            side, ended = jnp.where(impact.bounces, step_end.toward, side), ended | impact.bounces
        after = State(side * half, step_end.z, clock.t, clock.n, jnp.zeros_like(m.mode))
        outcome = impact_outcome(m, side, after, jnp.zeros_like(half) if m.work is None else m.work, m.tangent)
        return _next_carry(m, decision, step_end, clock, impact), outcome, ended

    def ball(self, pair: ImpactPair, m: DrivenCarry) -> State:
        """Return the state of the ball of a carry."""
        in_contact, side = m.mode != 0, m.mode.astype(m.x.dtype)
        u = jnp.where(in_contact, side * (0.5 * pair.d + m.x), m.x)
        t = jnp.maximum(2 - self._to_period(m), 0.0)
        return State(u, jnp.where(in_contact, side * m.z, m.z), t, m.n, m.mode)

    def waves(self, t: Any) -> Waves:
        """Return the harmonics of the forcing as functions of the time since phase t."""
        return self.forcing.waves(t)

    @property
    def has_periodic_forcing(self) -> bool:
        """True if the forcing repeats after every period."""
        return self.forcing.is_periodic

    def _to_period(self, m: DrivenCarry) -> Scalar:
        """Return the time to the end of the period, from the number of knots left, so that no digits are lost."""
        return ((m.n + 1).astype(m.s.dtype) * self.forcing.knots_per_period - m.k) * self.forcing.knot_spacing - m.s

    def _clock(self, m: DrivenCarry, length: Scalar, to_knot: Scalar, to_period: Scalar, accepted: Flag) -> _Clock:
        """Return the time after a step of length `length`, or the present time if the step is not accepted."""
        # A knot or a period's end at most REACHED knot spacings ahead counts as reached, so that no tiny step remains.
        short = REACHED * self.forcing.knot_spacing
        knot, over = (save_decision(accepted & (to - length <= short)) for to in (to_knot, to_period))
        remaining = jnp.where(accepted, to_period - length, to_period) + jnp.where(over, 2.0, 0.0)
        return _Clock(
            k=m.k + knot.astype(m.k.dtype),
            s=jnp.where(knot, 0.0, jnp.where(accepted, m.s + length, m.s)),
            n=m.n + over.astype(m.n.dtype),
            t=jnp.maximum(2 - remaining, 0.0),
        )


def _next_carry(
    m: DrivenCarry, decision: Decision, step_end: StepEnd, clock: _Clock, impact: RigidImpact | None
) -> DrivenCarry:
    """Return the carry after a step."""
    onset, exits, before_event = step_end.onset, step_end.exits, step_end.before_event
    leaves, enters = exits, onset
    if impact is not None:
        leaves, enters = exits | impact.bounces, onset & ~impact.sticks
    tangent = m.tangent
    if tangent is not None:
        # The tangent map of an impact runs from exit to exit, so it restarts at an exit.
        unit = _identity_map(jnp.zeros_like(m.x))
        tangent = tuple(jnp.where(leaves, entry, value) for entry, value in zip(unit, tangent, strict=True))
    return replace(
        m,
        x=jnp.where(decision.accepted, step_end.x, m.x),
        z=jnp.where(decision.accepted, step_end.z, m.z),
        k=clock.k,
        s=clock.s,
        n=clock.n,
        mode=jnp.where(onset, step_end.toward.astype(m.mode.dtype), jnp.where(exits, 0, m.mode)),
        trial=decision.trial,
        event=jnp.where(decision.reaches_event, NONE, decision.event),
        bracket=decision.bracket,
        onset_t=jnp.where(onset, clock.t, m.onset_t),
        onset_n=jnp.where(onset, clock.n, m.onset_n),
        entered=(m.entered | onset) & ~exits,
        v_in=jnp.where(onset, before_event.z, m.v_in),
        depth=jnp.where(enters, 0.0, jnp.where(step_end.crest, jnp.maximum(m.depth, before_event.x), m.depth)),
        work=None if m.work is None else jnp.where(onset, 0.0, m.work),
        exit_t=jnp.where(leaves, clock.t, m.exit_t),
        exit_n=jnp.where(leaves, clock.n, m.exit_n),
        tangent=tangent,
        steps=m.steps + 1,
    )


def _spring_of(walls: DrivenWall | Sides, side: Scalar, in_contact: Flag, reach: Scalar) -> Oscillator:
    """Return the oscillator of the membrane that the ball is in; in flight an oscillator with kappa = mu = 0."""
    zero = jnp.zeros_like(side)
    flight = Oscillator(zero, zero, zero, zero + reach)
    return Oscillator(
        *(
            jnp.where(in_contact, membrane, free)
            for membrane, free in zip(at_wall(walls, side).spring, flight, strict=True)
        )
    )


def _saltation_entry(walls: DrivenWall | Sides, side: Scalar, step_end: StepEnd) -> Scalar:
    """Return the saltation entry that maps du to du' at an event.

    The force jumps by the damping, so the entry is -mu at an onset and +mu at an exit.
    """
    onset, leaving = at_wall(walls, step_end.toward).spring.mu, at_wall(walls, side).spring.mu
    return jnp.where(step_end.onset, -onset, jnp.where(step_end.exits, leaving, 0.0))


def _tangent_after(
    spring: Oscillator, push: Push, later: Push, m: DrivenCarry, s: Scalar, delay: Scalar, kick: Scalar
) -> tuple[Scalar, ...]:
    """Return the tangent map after a step, with the saltation at its end."""

    def carried(x, z):
        end = taylor.rates(spring, later, *taylor.advance_series(spring, push, x, z, s)).after(delay)
        return end.x, end.z

    a, b, c, d = not_none(m.tangent)
    # One directional derivative per column of the tangent map.
    (_, (p, r)), (_, (q, t)) = (jax.jvp(carried, (m.x, m.z), column) for column in ((a, c), (b, d)))
    return p, q, r + kick * p, t + kick * q
