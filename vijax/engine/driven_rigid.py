"""What a rigid wall does to a driven motion: it throws the ball back, or holds it until the push turns.

Nothing of a ball at rest moves, so its steps watch the push in place of a displacement, by the same certificates: the
ball leaves where the push falls through 0.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from vijax.engine import taylor
from vijax.engine.driven_events import Decision, DrivenCarry, StepEnd
from vijax.engine.exact import STICK_SHARE, stick_speed
from vijax.engine.forcing import Forcing
from vijax.engine.taylor import Oscillator, Push, Rates
from vijax.model import energy, flow
from vijax.model.pair import ImpactPair
from vijax.model.sides import Sides, at
from vijax.runtime.arrays import Flag, Scalar, choose

# A pull, beside 1, that is as good as none: a ball at rest stays under it, in the silence of a record, and one that is
# let go is pulled by as much for certain.
_NO_PUSH = 1e-13
# A chatter ends at so many times the speed of the exact engine: displacements are counted from the middle of the gap,
# and of a bounce of 1e-16 rounding leaves nothing.
_SLOWER = 100


class DrivenWall(NamedTuple):
    """A wall of a driven motion: its membrane, all 0 of a rigid wall, and the restitution where walls are rigid."""

    spring: Oscillator
    r: Scalar | None


def walls_of(pair: ImpactPair) -> DrivenWall | Sides:
    """Give the wall of a pair; each wall where they differ."""
    if pair.unequal:
        return Sides(_wall(pair, -1), _wall(pair, 1))
    return _wall(pair, 1)


def _wall(pair: ImpactPair, side: int) -> DrivenWall:
    here = pair.at(side)
    if pair.hard(side):
        zero = jnp.zeros_like(pair.d)
        return DrivenWall(Oscillator(zero, zero, zero, zero + jnp.inf), here.r)
    kappa = here._soft_kappa()
    spring = Oscillator(kappa, kappa * kappa, here.mu, taylor.REACH / kappa)
    return DrivenWall(spring, here.r if pair.hard_wall else None)


def watched(
    rests: Flag, push: Push, later: Push, forcing: Forcing, motion: tuple[Rates, Rates, Scalar]
) -> tuple[Rates, Rates, Scalar]:
    """Put the push in place of the penetration where the ball rests.

    Args:
        rests: Whether it does, on a rigid wall.
        push, later: Of the step, at its beginning and at its end.
        forcing: Whose push it is.
        motion: Where the step begins and ends, and a bound of the fourth derivative.
    """
    now, end, most = motion
    # No harmonic is faster than the one that limits how far a series reaches.
    bound = forcing.bend * (taylor.REACH / forcing.reach) ** 2
    begins, ends = (_of_push(of) for of in (push, later))
    return choose(rests, (begins, ends, bound + jnp.zeros_like(most)), (now, end, most))


def _of_push(push: Push) -> Rates:
    value, rate, bend, twist = push.derivatives()
    return Rates(value + _NO_PUSH, rate, bend, twist, push.fourth())


class Rebound(NamedTuple):
    """What becomes of a ball that meets a rigid wall.

    Attributes:
        bounces: It is thrown back at once.
        sticks: It stays, as what is left of its bounces lasts no time.
        depth: How deep a membrane that it is lent would be pressed.
        work: Energy that the wall takes.
        tangent: Tangent map of the impact, row by row; 0 where it sticks, as the ball forgets how it came.
    """

    bounces: Flag
    sticks: Flag
    depth: Scalar
    work: Scalar
    tangent: tuple[Scalar, ...]


def rebound(
    pair: ImpactPair, walls: DrivenWall | Sides, landing: StepEnd, push: Push, gap: Scalar
) -> tuple[Rebound, StepEnd]:
    """Find what a rigid wall does at the end of a step, and where the ball is then.

    Args:
        pair: One cell.
        walls: Of `walls_of`.
        landing: Where the step ends.
        push: In flight, there.
        gap: Time between two knots.

    A chatter is a geometric series of bounces; what is left of it lasts 2 v/(a (1 - r)), as in `exact`.
    """
    toward, v_in = landing.toward, landing.there.z
    meets = landing.crossed & pair.hard(toward)
    r: Any = at(walls, toward).r
    value, rate, *_ = (toward * of for of in push.derivatives())
    out = r * jnp.maximum(toward * v_in, 0.0)
    rest = 2 * out / jnp.where(value > 0, value, 1.0) / jnp.maximum(1 - r, jnp.finfo(out.dtype).tiny)
    # Until the push may turn, by its slope, and no further than samples are known.
    ahead = jnp.minimum(gap, value / jnp.where(rate < 0, -rate, value / gap))
    slow = out < _SLOWER * stick_speed(out.dtype)
    sticks = meets & slow & (value > 0) & (rest < STICK_SHARE * ahead) & (r < 1)
    bounces = meets & ~sticks
    wall = pair.at(toward)
    deep = toward * v_in * (energy.rigid_depth(wall) if pair.rigid else jnp.zeros_like(out))
    hit = flow.rigid_matrix(r, toward * value, jnp.where(meets, v_in, 1.0))
    tangent = tuple(jnp.where(sticks, 0.0, entry) for entry in hit.ravel())
    x = jnp.where(bounces, toward * 0.5 * pair.d, landing.x)
    z = jnp.where(bounces, -toward * out, jnp.where(sticks, 0.0, landing.z))
    landing = landing._replace(x=x, z=z, crossed=landing.crossed & ~bounces)
    work = energy.membrane_work_rigid(v_in, r)
    return Rebound(bounces, sticks, deep, work, tangent), landing


def kept(landing: StepEnd, choice: Decision, rests: Flag) -> StepEnd:
    """Keep a ball at rest where it is: what its step watched is no place of it."""
    still = rests & choice.goes
    return landing._replace(x=jnp.where(still & ~landing.exits, 0.0, landing.x), z=jnp.where(still, 0.0, landing.z))


def hit(m: DrivenCarry, met: Rebound, landing: StepEnd, when: tuple[Scalar, Any], rests: Flag) -> DrivenCarry:
    """Put an impact at a rigid wall into the carry: onset and end are one, unless the ball stays.

    `when` is the phase and the period of the step's end.
    """
    t, n = when
    meets, tangent = met.bounces | met.sticks, m.tangent
    if tangent is not None:
        a, b, c, d = tangent
        p, q, r, s = met.tangent
        over = (p * a + q * c, p * b + q * d, r * a + s * c, r * b + s * d)
        # A ball that rested before the run forgets where that was.
        lost = rests & landing.exits
        tangent = tuple(
            jnp.where(lost, 0.0, jnp.where(meets, new, old)) for new, old in zip(over, tangent, strict=True)
        )
    return replace(
        m,
        tangent=tangent,
        onset_t=jnp.where(meets, t, m.onset_t),
        onset_n=jnp.where(meets, n, m.onset_n),
        v_in=jnp.where(meets, landing.there.z, m.v_in),
        depth=jnp.where(meets, met.depth, m.depth),
        work=None if m.work is None else jnp.where(meets, met.work, m.work),
    )
