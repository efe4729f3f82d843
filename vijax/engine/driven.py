"""Motion under any excitation: harmonics, samples with straight lines between them, noise; no time step to choose.

Between two knots of the excitation the motion is a Taylor series that is exact to rounding (`taylor`). A step goes as
far as nothing happens for certain: to the next knot, or half the way where a wall, an exit or the deepest point of a
contact cannot be excluded. Where exactly one event is certain to lie ahead, further steps close in on it by a
fourth-order iteration within the bracket, and the last lands on it (`driven_events`). No lane waits for another.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from vijax.engine import taylor
from vijax.engine.driven_events import NONE, Ahead, Decision, DrivenCarry, StepEnd, choose, land, look, residual
from vijax.engine.driven_rigid import DrivenWall, Rebound, hit, kept, rebound, walls_of, watched
from vijax.engine.forcing import REACHED, Draws, Forcing
from vijax.engine.method import HELD, ImpactOutcome, Method, decided, finished
from vijax.engine.taylor import Oscillator, Push
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.sides import Sides, at, named
from vijax.model.waves import Waves
from vijax.runtime import checks
from vijax.runtime.arrays import Flag, Scalar, present
from vijax.runtime.xla import share

# Steps of a contact and of a flight's end, at most, for the room of recorded runs; most take a tenth.
_PER_IMPACT = 256


def _unit(zero: Scalar) -> tuple[Scalar, ...]:
    """Make the tangent map of no motion, row by row."""
    return zero + 1, zero, zero, zero + 1


class _Clock(NamedTuple):
    """When it is: knots passed, the time since the last one, periods completed, the phase of this one."""

    k: Scalar
    s: Scalar
    n: Int[Array, ""]
    t: Scalar


class Driven(Method[DrivenCarry]):
    """The method of excitations that are not the sine; of linear membranes and rigid walls.

    Attributes:
        forcing: The excitation.
    """

    forcing: Forcing

    @property
    def arithmetic(self) -> bool:
        """Say whether a step calls no library: it does not."""
        return True

    def walls(self, pair: ImpactPair) -> DrivenWall | Sides:
        """Give the wall of a pair; each wall where they differ."""
        return walls_of(pair)

    def taken(self, m: DrivenCarry) -> Int[Array, ""]:
        """Count the steps so far."""
        return m.steps

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Say after how many steps a recorded run is stopped: those of a ball that a membrane holds all the time."""
        knots = int(self.forcing.knots) + 1
        inside = 0.0
        kappas = [one for one in named("kappa", pair.kappa).values() if one is not None]
        if kappas and checks.is_concrete(kappas):
            inside = max(float(np.max(one)) for one in kappas) * 2 / taylor.REACH
        return (knots + int(inside) + 16) * (periods + HELD) + _PER_IMPACT * max_impacts

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> DrivenCarry:
        """Make the carry of a start."""
        zero, whole = jnp.zeros_like(state.u), jnp.zeros_like(state.n)
        n = state.n.astype(zero.dtype)
        k = self.forcing.knot_at(n, state.t)
        since = jnp.maximum(state.t - (k - n * self.forcing.knots) * self.forcing.gap, 0.0)
        draws = self.forcing.draws(pair, state, k)
        mode = self._mode(pair, state, k, since, draws)
        held, side = mode != 0, mode.astype(zero.dtype)
        x = jnp.where(held, side * state.u - 0.5 * pair.d, state.u)
        return DrivenCarry(
            x=x,
            z=jnp.where(held, side * state.v, state.v),
            k=k,
            s=since,
            n=state.n,
            mode=mode,
            trial=zero + jnp.inf,
            event=zero,
            bracket=zero,
            onset_t=state.t,
            onset_n=state.n,
            entered=jnp.zeros_like(held),
            v_in=state.v,
            depth=jnp.where(held, x, 0.0),
            work=zero if deep else None,
            left_t=state.t,
            left_n=state.n,
            tangent=_unit(zero) if tangent else None,
            draws=draws,
            steps=whole,
        )

    def _mode(self, pair: ImpactPair, state: State, k: Scalar, since: Scalar, draws: Draws | None) -> Int[Array, ""]:
        """Find the mode of a start: a ball at rest on a wall is held if this forcing, not the sine, pushes it there."""
        side = jnp.where(state.u < 0, -1.0, 1.0).astype(state.u.dtype)
        value, rate, *_ = self.forcing.push(pair.gamma, k, since, state.t, draws).derivatives()
        pushed = side * jnp.where(value == 0, rate, value) > 0
        if pair.rigid or pair.hard_wall:
            # A rigid wall keeps a ball that nothing moves.
            pushed = pushed | (pair.hard(side) & (value == 0) & (rate == 0))
        rests = (side * state.u == 0.5 * pair.d) & (state.v == 0)
        return jnp.where(rests, jnp.where(pushed, side, 0.0).astype(state.mode.dtype), state.mode)

    def step(
        self, pair: ImpactPair, walls: DrivenWall | Sides, m: DrivenCarry, *, recorded: bool = False
    ) -> tuple[DrivenCarry, ImpactOutcome, Flag]:
        """Take one step: to a knot, to where something may happen, towards an event, or onto it."""
        half, held, rigid = 0.5 * pair.d, m.mode != 0, pair.rigid or bool(pair.hard_wall)
        side = jnp.where(m.mode < 0, -1.0, 1.0).astype(half.dtype)
        to_knot, to_period = self.forcing.gap - m.s, self._to_period(m)
        spring = _spring_of(walls, side, held, self.forcing.reach)
        push = self.forcing.push(pair.gamma, m.k, m.s, 2 - to_period, m.draws).turned(jnp.where(held, side, 1.0))
        room = jnp.minimum(to_knot, jnp.minimum(spring.reach, self.forcing.reach))
        if recorded:
            # States at phase 0 are asked for: a step ends there.
            room = jnp.where(to_period < room * (1 - REACHED), to_period, room)
        # A step that ends at a knot is as long as where it began asks for; a trial is as long as it was decided to be.
        s, to_knot, to_period = share((jnp.minimum(lax.stop_gradient(m.trial), room), to_knot, to_period))
        now, later = share(taylor.rates(spring, push, m.x, m.z)), push.later(s)
        end = share(taylor.rates(spring, later, *taylor.moved(spring, push, m.x, m.z, s)))
        most = taylor.steepest(spring, self.forcing.bend, now, s)
        rests = held & pair.hard(side) if rigid else None
        if rests is not None:
            now, end, most = watched(rests, push, later, self.forcing, (now, end, most))
        sprung = held if rests is None else held & ~rests
        ahead = look(held, sprung, m.work is not None, half, most, now, end, s)
        ahead = share(Ahead(ahead.clear, jnp.where(m.event != NONE, m.event, ahead.event)))
        f = share(residual(ahead.event, half, end))
        told = m, half, spring.kappa, ahead, end, f, s, self.forcing.gap
        choice = decided(lax.stop_gradient(share(choose(*told))))
        landing, met = land(choice, half, side, s, end, f), None
        if rests is not None:
            there = later.later(landing.delay)
            met, landing = rebound(pair, walls, kept(landing, choice, rests), there, self.forcing.gap)
        landing = share(landing)
        clock = share(self._clock(m, landing.length, to_knot, to_period, choice.goes))
        work, tangent = m.work, m.tangent
        if work is not None:
            square = taylor.squared_rate(spring, (push, later), (now, end), s, landing.delay)
            work = work + jnp.where(choice.goes & sprung, spring.mu * square, 0.0)
        if tangent is not None:
            carried = _spread(spring, push, later, m, s, landing.delay, _kick(walls, side, landing))
            tangent = tuple(jnp.where(choice.goes, new, old) for new, old in zip(carried, tangent, strict=True))
        m = replace(m, work=work, tangent=tangent, draws=self.forcing.drawn(m.draws, m.k, clock.k))
        ended = landing.exits & m.entered
        if met is not None:
            m = hit(m, met, landing, (clock.t, clock.n), present(rests))
            side, ended = jnp.where(met.bounces, landing.toward, side), ended | met.bounces
        after = State(side * half, landing.z, clock.t, clock.n, jnp.zeros_like(m.mode))
        outcome = finished(m, side, after, jnp.zeros_like(half) if m.work is None else m.work, m.tangent)
        return _gone_on(m, choice, landing, clock, met), outcome, ended

    def ball(self, pair: ImpactPair, m: DrivenCarry) -> State:
        """Say where the ball of a carry is."""
        held, side = m.mode != 0, m.mode.astype(m.x.dtype)
        u = jnp.where(held, side * (0.5 * pair.d + m.x), m.x)
        t = jnp.maximum(2 - self._to_period(m), 0.0)
        return State(u, jnp.where(held, side * m.z, m.z), t, m.n, m.mode)

    def waves(self, t: Any) -> Waves:
        """Give the harmonics of the forcing from phase t on."""
        return self.forcing.waves(t)

    @property
    def repeats(self) -> bool:
        """Say whether the forcing repeats after every period."""
        return self.forcing.periodic

    def _to_period(self, m: DrivenCarry) -> Scalar:
        """Compute the time to the end of the period; whole knots first, as a sum of steps would lose digits."""
        return ((m.n + 1).astype(m.s.dtype) * self.forcing.knots - m.k) * self.forcing.gap - m.s

    def _clock(self, m: DrivenCarry, length: Scalar, to_knot: Scalar, to_period: Scalar, goes: Flag) -> _Clock:
        """Go on by a time, where the ball does."""
        short = REACHED * self.forcing.gap
        knot, over = (decided(goes & (to - length <= short)) for to in (to_knot, to_period))
        left = jnp.where(goes, to_period - length, to_period) + jnp.where(over, 2.0, 0.0)
        return _Clock(
            k=m.k + knot.astype(m.k.dtype),
            s=jnp.where(knot, 0.0, jnp.where(goes, m.s + length, m.s)),
            n=m.n + over.astype(m.n.dtype),
            t=jnp.maximum(2 - left, 0.0),
        )


def _gone_on(m: DrivenCarry, choice: Decision, landing: StepEnd, clock: _Clock, met: Rebound | None) -> DrivenCarry:
    """Make the carry after a step."""
    crossed, exits, there = landing.crossed, landing.exits, landing.there
    leaves, enters = exits, crossed
    if met is not None:
        leaves, enters = exits | met.bounces, crossed & ~met.sticks
    tangent = m.tangent
    if tangent is not None:
        # A ball that leaves begins a new tangent map: that of an impact is from exit to exit.
        unit = _unit(jnp.zeros_like(m.x))
        tangent = tuple(jnp.where(leaves, one, value) for one, value in zip(unit, tangent, strict=True))
    return replace(
        m,
        x=jnp.where(choice.goes, landing.x, m.x),
        z=jnp.where(choice.goes, landing.z, m.z),
        k=clock.k,
        s=clock.s,
        n=clock.n,
        mode=jnp.where(crossed, landing.toward.astype(m.mode.dtype), jnp.where(exits, 0, m.mode)),
        trial=choice.trial,
        event=jnp.where(choice.lands, NONE, choice.event),
        bracket=choice.bracket,
        onset_t=jnp.where(crossed, clock.t, m.onset_t),
        onset_n=jnp.where(crossed, clock.n, m.onset_n),
        entered=(m.entered | crossed) & ~exits,
        v_in=jnp.where(crossed, there.z, m.v_in),
        depth=jnp.where(enters, 0.0, jnp.where(landing.crest, jnp.maximum(m.depth, there.x), m.depth)),
        work=None if m.work is None else jnp.where(crossed, 0.0, m.work),
        left_t=jnp.where(leaves, clock.t, m.left_t),
        left_n=jnp.where(leaves, clock.n, m.left_n),
        tangent=tangent,
        steps=m.steps + 1,
    )


def _spring_of(walls: DrivenWall | Sides, side: Scalar, held: Flag, reach: Scalar) -> Oscillator:
    """Give the membrane that the ball is in, or what stands for one in flight."""
    zero = jnp.zeros_like(side)
    flight = Oscillator(zero, zero, zero, zero + reach)
    return Oscillator(*(jnp.where(held, own, free) for own, free in zip(at(walls, side).spring, flight, strict=True)))


def _kick(walls: DrivenWall | Sides, side: Scalar, landing: StepEnd) -> Scalar:
    """Find how much of du becomes du' at an event: the force jumps by the damping, on at the onset, off at the exit."""
    onset, leaving = at(walls, landing.toward).spring.mu, at(walls, side).spring.mu
    return jnp.where(landing.crossed, -onset, jnp.where(landing.exits, leaving, 0.0))


def _spread(
    spring: Oscillator, push: Push, later: Push, m: DrivenCarry, s: Scalar, delay: Scalar, kick: Scalar
) -> tuple[Scalar, ...]:
    """Take the tangent map over a step, the saltation at its end included."""

    def carried(x, z):
        end = taylor.rates(spring, later, *taylor.moved(spring, push, x, z, s)).after(delay)
        return end.x, end.z

    a, b, c, d = present(m.tangent)
    (_, (p, r)), (_, (q, t)) = (jax.jvp(carried, (m.x, m.z), column) for column in ((a, c), (b, d)))
    return p, q, r + kick * p, t + kick * q
