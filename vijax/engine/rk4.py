"""The paper's own method: classical Runge-Kutta steps of constant length, the contact decided by the sign of a sample.

For replaying published diagrams, and as the peer that other methods are measured against. What it cannot know:

- When an impact begins or ends: onset and exit are the first samples inside and outside, late by up to a step. A graze
  or a bounce between two samples is not seen at all.
- The speeds there: v_in is read from the first sample inside, where a stiff membrane has taken part of it already, and
  v_out from the first one outside; the depth is that of the deepest sample, the work a trapezoidal sum over samples.
- The jump of the force: a stage on the wrong side of the wall costs the scheme its order, which is 1 here and not 4.
- Stiff walls: above kappa h = 2.6 to 2.8 (h the step) a contact blows up, and the cell is called nonfinite.

Source: the scheme behind the paper's figures, Eq. (38).
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vijax.engine.method import HELD, ImpactOutcome, Method, decided, finished
from vijax.model.flow import PI
from vijax.model.membrane import Wall, one_of
from vijax.model.pair import ImpactPair, Real
from vijax.model.records import State
from vijax.model.sides import Sides, at
from vijax.runtime.arrays import Scalar
from vijax.runtime.xla import share

_ON_GRID = 1e-6  # a start that is so small a part of a step before a sample counts as at it


class Rk4Carry(eqx.Module):
    """The carry of a lane: the last sample, and what its contact and the way since the last exit have seen."""

    u: Scalar
    v: Scalar
    k: Scalar  # samples of this period behind it
    offset: Scalar  # phase of sample 0
    n: Int[Array, ""]
    mode: Int[Array, ""]
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Bool[Array, ""]
    v_in: Scalar
    depth: Scalar
    work: Scalar
    left_t: Scalar
    left_n: Int[Array, ""]
    tangent: tuple[Scalar, ...] | None  # row by row


class Rk4(Method[Rk4Carry]):
    """The paper's method: classical Runge-Kutta steps of constant length, no event located.

    Attributes:
        steps: Steps per forcing period.
    """

    steps: Real

    @property
    def arithmetic(self) -> bool:
        """Say whether a step calls no library: it does not, if its membrane does not."""
        return one_of(self.law).arithmetic

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Say how many steps a recorded run takes."""
        return int(self.steps) * (periods + HELD)

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> Rk4Carry:
        """Make the carry of a start; its phase is sample 0 if it lies on none of the grid of steps.

        Depth and work cost nothing here. Tangent maps are those of the numerical scheme, which has no saltation.
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
            left_t=state.t,
            left_n=state.n,
            tangent=(zero + 1, zero, zero, zero + 1) if tangent else None,
        )

    def step(
        self, pair: ImpactPair, walls: Wall | Sides, m: Rk4Carry, *, recorded: bool = False
    ) -> tuple[Rk4Carry, ImpactOutcome, Bool[Array, ""]]:
        """Take one step, and see what its sample shows; one at phase 0 and derivatives in reverse cost nothing."""
        h = 2 / self.steps
        new = _moved(self.steps, pair, walls, m)
        w = jnp.abs(new.u) - 0.5 * pair.d
        mode = decided(jnp.where(w >= 0, jnp.where(new.u < 0, -1, 1), 0).astype(m.mode.dtype))
        leaves, onset = (m.mode != 0) & (mode != m.mode), (mode != 0) & (mode != m.mode)
        power = _power(pair, walls, m.u, m.v) + _power(pair, walls, new.u, new.v)
        work = jnp.where(onset, 0.0, m.work + 0.5 * h * power)
        t = m.offset + new.k * h
        outcome = finished(new, m.mode, State(new.u, new.v, t, new.n, mode), work, new.tangent)
        # A ball that leaves begins a new tangent map: that of an impact is from exit to exit.
        tangent = new.tangent
        if tangent is not None:
            unit = (1.0, 0.0, 0.0, 1.0)
            tangent = tuple(jnp.where(leaves, one, value) for one, value in zip(unit, tangent, strict=True))
        new = replace(
            new,
            mode=mode,
            onset_t=jnp.where(onset, t, m.onset_t),
            onset_n=jnp.where(onset, new.n, m.onset_n),
            entered=onset | (m.entered & ~leaves),
            v_in=jnp.where(onset, new.v, m.v_in),
            depth=jnp.where(onset, w, jnp.where(leaves, 0.0, jnp.maximum(m.depth, w))),
            work=work,
            left_t=jnp.where(leaves, t, m.left_t),
            left_n=jnp.where(leaves, new.n, m.left_n),
            tangent=tangent,
        )
        return new, outcome, leaves & m.entered

    def ball(self, pair: ImpactPair, m: Rk4Carry) -> State:
        """Say where the last sample is."""
        return State(m.u, m.v, m.offset + m.k * (2 / self.steps), m.n, m.mode)


def _moved(steps: Real, pair: ImpactPair, walls: Wall | Sides, m: Rk4Carry) -> Rk4Carry:
    """Compute the next sample and the tangent map up to it; what the contact has seen is still that of the last one."""
    h = 2 / steps
    move = partial(_runge_kutta, pair, walls, m.offset + m.k * h, h)
    u, v = share(move(m.u, m.v))
    tangent = None
    if m.tangent is not None:
        a, b, c, d = m.tangent
        (_, (p, q)), (_, (r, s)) = (jax.jvp(move, (m.u, m.v), column) for column in ((a, c), (b, d)))
        tangent = (p, r, q, s)
    # Samples are counted, and a phase is their number times h: a sum of so many steps would drift off the grid.
    k = m.k + 1
    over = k >= steps
    k, n = jnp.where(over, 0.0, k), m.n + over.astype(m.n.dtype)
    return replace(m, u=u, v=v, k=k, n=n, tangent=tangent)


def _runge_kutta(
    pair: ImpactPair, walls: Wall | Sides, t: Scalar, h: Real, u: Scalar, v: Scalar
) -> tuple[Scalar, Scalar]:
    """Take one classical step; every stage is in contact if it lies beyond the wall."""

    def push(forcing, u, v):
        side = jnp.where(u < 0, -1.0, 1.0)
        w = side * u - 0.5 * pair.d
        return share(v), share(forcing + jnp.where(w >= 0, side * at(walls, side)(w, side * v), 0.0))

    middle = 0.5 * h
    first, second, last = share(tuple(jnp.cos(PI * (t + s)) - pair.gamma for s in (0.0, middle, h)))
    u1, v1 = push(first, u, v)
    u2, v2 = push(second, u + middle * u1, v + middle * v1)
    u3, v3 = push(second, u + middle * u2, v + middle * v2)
    u4, v4 = push(last, u + h * u3, v + h * v3)
    return u + h / 6 * (u1 + 2 * (u2 + u3) + u4), v + h / 6 * (v1 + 2 * (v2 + v3) + v4)


def _power(pair: ImpactPair, walls: Wall | Sides, u: Scalar, v: Scalar) -> Scalar:
    """Compute the power into the membrane at a sample inside; 0 at one outside."""
    along = jnp.where(u < 0, -v, v)
    depth = jnp.abs(u) - 0.5 * pair.d
    return jnp.where(depth >= 0, -at(walls, u)(depth, along) * along, 0.0)
