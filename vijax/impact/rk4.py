"""Method of the paper: classical Runge-Kutta steps of constant length, with contact decided at the end of each step.

The ball counts as in contact if its displacement at the end of a step (a sample) is beyond a wall. The method
reproduces published diagrams and is a baseline for other methods. Its known limits:

- Times: onset and exit are the first samples inside and outside the membrane, so they are up to one step late. A
  grazing contact or a bounce between two samples is lost.
- Speeds and depths: v_in is the velocity of the first sample inside, after a stiff membrane has already reduced it, and
  v_out the velocity of the first sample outside. The depth is the depth of the deepest sample, and the work is a
  trapezoidal sum over samples.
- Order: a stage on the wrong side of the wall sees a jump of the force, so the order is 1, not 4.
- Stability: above kappa h = 2.6 to 2.8 (h the step) a contact diverges, and the cell is labelled nonfinite.

Source: the scheme behind the paper's figures, Eq. (38).
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vijax.impact.method import MAX_CONTACT_PERIODS, ImpactOutcome, Method, impact_outcome, save_decision
from vijax.model.flow import PI
from vijax.model.pair import ImpactPair, Real
from vijax.model.records import State
from vijax.model.walls.membrane import Wall, representative_law
from vijax.model.walls.sides import Sides, at_wall
from vijax.runtime.arrays import Scalar
from vijax.runtime.compilation.xla import materialise

_ON_GRID = 1e-6  # an initial phase at most this fraction of a step before a sample counts as that sample


class Rk4Carry(eqx.Module):
    """Carry of a lane: the last sample, the data of the present contact, and the tangent map since the last exit."""

    u: Scalar
    v: Scalar
    k: Scalar  # samples passed in this period
    offset: Scalar  # phase of sample 0 of a period
    n: Int[Array, ""]
    mode: Int[Array, ""]
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Bool[Array, ""]
    v_in: Scalar
    depth: Scalar
    work: Scalar
    exit_t: Scalar
    exit_n: Int[Array, ""]
    tangent: tuple[Scalar, ...] | None  # row by row


class Rk4(Method[Rk4Carry]):
    """Method of the paper: classical Runge-Kutta steps of constant length, without located events.

    Attributes:
        steps: Steps per forcing period.
    """

    steps: Real

    @property
    def arithmetic(self) -> bool:
        """True if a step calls no library function; this depends on the membrane law only."""
        return representative_law(self.law).arithmetic

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Return the number of steps of a recorded run."""
        return int(self.steps) * (periods + MAX_CONTACT_PERIODS)

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> Rk4Carry:
        """Return the carry of an initial state; if its phase is not on the grid of steps, the grid is shifted to it.

        Depth and work are always computed, because they cost almost nothing. Tangent maps are derivatives of the
        numerical scheme; they contain no saltation matrices, because the scheme locates no events.
        """
        zero = jnp.zeros_like(state.u)
        h = 2 / self.steps
        k = jnp.floor(state.t / h + _ON_GRID)
        return Rk4Carry(
            u=state.u,
            v=state.v,
            k=k,
            offset=state.t - k * h,
            n=state.n,
            mode=state.mode,
            onset_t=state.t,
            onset_n=state.n,
            entered=jnp.zeros_like(state.mode, bool),
            v_in=state.v,
            depth=jnp.maximum(jnp.abs(state.u) - 0.5 * pair.d, 0.0),
            work=zero,
            exit_t=state.t,
            exit_n=state.n,
            tangent=(zero + 1, zero, zero, zero + 1) if tangent else None,
        )

    def step(
        self, pair: ImpactPair, walls: Wall | Sides, m: Rk4Carry, *, recorded: bool = False
    ) -> tuple[Rk4Carry, ImpactOutcome, Bool[Array, ""]]:
        """Take one step, and update the data of the contact from the sample at its end.

        `recorded` has no effect: sample 0 of a period exists in every run, and every step is differentiable in reverse
        mode.
        """
        h = 2 / self.steps
        new = _next_sample(self.steps, pair, walls, m)
        w = jnp.abs(new.u) - 0.5 * pair.d
        mode = save_decision(jnp.where(w >= 0, jnp.where(new.u < 0, -1, 1), 0).astype(m.mode.dtype))
        is_exit, onset = (m.mode != 0) & (mode != m.mode), (mode != 0) & (mode != m.mode)
        power = _power(pair, walls, m.u, m.v) + _power(pair, walls, new.u, new.v)
        # Trapezoidal rule over the samples inside the membrane, restarted at an onset.
        work = jnp.where(onset, 0.0, m.work + 0.5 * h * power)
        t = m.offset + new.k * h
        outcome = impact_outcome(new, m.mode, State(new.u, new.v, t, new.n, mode), work, new.tangent)
        # The tangent map of an impact runs from exit to exit, so it restarts at an exit.
        tangent = new.tangent
        if tangent is not None:
            unit = (1.0, 0.0, 0.0, 1.0)
            tangent = tuple(jnp.where(is_exit, entry, value) for entry, value in zip(unit, tangent, strict=True))
        new = replace(
            new,
            mode=mode,
            onset_t=jnp.where(onset, t, m.onset_t),
            onset_n=jnp.where(onset, new.n, m.onset_n),
            entered=onset | (m.entered & ~is_exit),
            v_in=jnp.where(onset, new.v, m.v_in),
            depth=jnp.where(onset, w, jnp.where(is_exit, 0.0, jnp.maximum(m.depth, w))),
            work=work,
            exit_t=jnp.where(is_exit, t, m.exit_t),
            exit_n=jnp.where(is_exit, new.n, m.exit_n),
            tangent=tangent,
        )
        return new, outcome, is_exit & m.entered

    def ball(self, pair: ImpactPair, m: Rk4Carry) -> State:
        """Return the last sample."""
        return State(m.u, m.v, m.offset + m.k * (2 / self.steps), m.n, m.mode)


def _next_sample(steps: Real, pair: ImpactPair, walls: Wall | Sides, m: Rk4Carry) -> Rk4Carry:
    """Return the carry at the next sample with its tangent map; the data of the contact are not updated yet."""
    h = 2 / steps
    advance = partial(_runge_kutta, pair, walls, m.offset + m.k * h, h)
    u, v = materialise(advance(m.u, m.v))
    tangent = None
    if m.tangent is not None:
        a, b, c, d = m.tangent
        # One directional derivative per column of the tangent map.
        (_, (p, q)), (_, (r, s)) = (jax.jvp(advance, (m.u, m.v), column) for column in ((a, c), (b, d)))
        tangent = (p, r, q, s)
    # Samples are counted, and a phase is their number times h, since a sum of many steps would drift off the grid.
    k = m.k + 1
    period_ends = k >= steps
    k, n = jnp.where(period_ends, 0.0, k), m.n + period_ends.astype(m.n.dtype)
    return replace(m, u=u, v=v, k=k, n=n, tangent=tangent)


def _runge_kutta(
    pair: ImpactPair, walls: Wall | Sides, t: Scalar, h: Real, u: Scalar, v: Scalar
) -> tuple[Scalar, Scalar]:
    """Return u and v after one classical Runge-Kutta step; the membrane acts at the stages beyond a wall."""

    def push(forcing, u, v):
        side = jnp.where(u < 0, -1.0, 1.0)
        w = side * u - 0.5 * pair.d
        return materialise(v), materialise(forcing + jnp.where(w >= 0, side * at_wall(walls, side)(w, side * v), 0.0))

    middle = 0.5 * h
    first, second, last = materialise(tuple(jnp.cos(PI * (t + s)) - pair.gamma for s in (0.0, middle, h)))
    u1, v1 = push(first, u, v)
    u2, v2 = push(second, u + middle * u1, v + middle * v1)
    u3, v3 = push(second, u + middle * u2, v + middle * v2)
    u4, v4 = push(last, u + h * u3, v + h * v3)
    return u + h / 6 * (u1 + 2 * (u2 + u3) + u4), v + h / 6 * (v1 + 2 * (v2 + v3) + v4)


def _power(pair: ImpactPair, walls: Wall | Sides, u: Scalar, v: Scalar) -> Scalar:
    """Return the power that the ball gives to the membrane at a sample inside it; 0 for a sample outside."""
    along = jnp.where(u < 0, -v, v)
    depth = jnp.abs(u) - 0.5 * pair.d
    return jnp.where(depth >= 0, -at_wall(walls, u)(depth, along) * along, 0.0)
