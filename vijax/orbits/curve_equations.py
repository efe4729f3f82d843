"""A curve of bifurcations in a plane of two parameters as a path in the space of knots and both parameters.

To the equations of the orbit come those of what it is that happens: a multiplier is 1 or -1, the ball just touches a
wall, in flight or from inside in a contact, or an impact is as deep, or harvests as much of what it gives to the
membrane, as may be. Past the end of real orbits the equations go on, as those of orbits do; test functions say where.
"""

import dataclasses
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.sides import at
from vijax.orbits import contacts, flights, grazing, multipliers, shooting, steady
from vijax.orbits.arclength_step import PathEquations
from vijax.orbits.parameter import moved_together
from vijax.orbits.shooting import Sequence
from vijax.runtime.arrays import AnyArray

Condition = Literal["multiplier", "touch", "split", "depth", "energy"]
CONDITIONS: dict[str, Condition] = {
    "grazing": "touch",
    "grazing contact": "split",
    "penetration limit": "depth",
    "energy limit": "energy",
}
"""What holds on curves of a kind; on those of all other kinds a multiplier is given."""


class CurveTests(NamedTuple):
    """Functions whose sign changes mark what happens on a curve; those from `push` on are positive on real orbits."""

    turn: Float[Array, ""]  # how far a step goes on in the plane the way that it came: it turns back at a cusp
    cubic: Float[Array, ""]  # that of a flip, on which side doubled orbits lie; 1 until `curve_events` asks for it
    plus: Float[Array, ""]  # A multiplier of a grazing orbit passes +1 where it changes sign.
    minus: Float[Array, ""]  # One passes -1 here.
    resonance: Float[Array, ""]  # at a graze of a rigid wall: how orbits with an impact there depart, as a square root
    # At a graze the acceleration away from the wall that is touched; at a limit how far off all other impacts are.
    push: Float[Array, ""]
    speed: Float[Array, ""]  # the clearances of `Tests`, but for the graze itself
    flight: Float[Array, ""]
    contact: Float[Array, ""]
    exit: Float[Array, ""]
    low_first: Float[Array, ""]
    high_first: Float[Array, ""]
    low_second: Float[Array, ""]
    high_second: Float[Array, ""]


TURN, CUBIC = CurveTests._fields.index("turn"), CurveTests._fields.index("cubic")
FIRST_CURVE_END = CurveTests._fields.index("push")


class Touch(eqx.Module):
    """Where the ball touches a wall: after, or in, which impact, and which wall; at a limit, which impact is there."""

    impact: Int[AnyArray, "*orbit"]
    wall: Float[AnyArray, "*orbit"]
    alike: Bool[AnyArray, "*orbit impact"] | None = None  # At a limit: which impacts are there with it, by symmetry.


class CurvePath(eqx.Module):
    """What a lane follows: unknowns are all knots, at a graze when it is, and both parameters.

    A graze is so long after the end of a contact, or after its onset where the ball touches from inside.
    Parameters count over their range, so that the plane is a square of side 1; one whose bounds are more than a decade
    apart counts in its logarithm.

    Attributes:
        pair: Parameters of the orbit where the curve began.
        sequence: Walls that it meets.
        start: Both parameters there.
        steepest: g/A of the device, gamma of a vertical tube (along "beta" only).
        low, high: Corners of the plane.
        multiplier: Which one of the orbit's multipliers is: +1. or -1. (flips, pitchforks of orbits closed half way).
        touch: Where the ball touches a wall, on curves of grazing; which impact is at the limit, on those of limits.
        device: Whose limits they are, with its `penetration_limit`; None on curves of bifurcations.
        along: Which parameters move.
        logarithmic: Which of them count in their logarithms.
        condition: Whether a multiplier is given, a wall touched in flight or from inside, or an impact at a limit.
        newton_tolerance, max_corrections: See `ContinuationSettings`.
    """

    test_names: ClassVar[tuple[str, ...]] = CurveTests._fields
    first_end: ClassVar[int] = FIRST_CURVE_END

    pair: ImpactPair
    sequence: Sequence
    start: Float[AnyArray, "*orbit 2"]
    steepest: Float[AnyArray, "*orbit"]
    low: Float[AnyArray, "*orbit 2"]
    high: Float[AnyArray, "*orbit 2"]
    multiplier: Float[AnyArray, "*orbit"]
    touch: Touch
    device: Harvester | None
    along: tuple[str, str] = eqx.field(static=True)
    logarithmic: tuple[bool, bool] = eqx.field(static=True)
    condition: Condition = eqx.field(static=True)
    newton_tolerance: float = eqx.field(static=True)
    max_corrections: int = eqx.field(static=True)

    def places(self, y):
        """Give both parameters at points, along the last axis."""
        z = y[..., -2:]
        line = self.low + z * (self.high - self.low)
        # Where a quantity is no logarithm's the other form is never computed of a bound that may be negative.
        power = [
            self.low[..., i] * (self.high[..., i] / self.low[..., i]) ** z[..., i] if logarithm else line[..., i]
            for i, logarithm in enumerate(self.logarithmic)
        ]
        return (jnp if isinstance(y, jax.Array) else np).stack(power, axis=-1)

    def at(self, z) -> ImpactPair:
        """Give the pair where the last two unknowns are these."""
        x, start = self.places(z), self.start
        both = (x[..., 0], x[..., 1]), (start[..., 0], start[..., 1])
        return moved_together(self.pair, self.along, *both, self.steepest)

    def pair_and_knots(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Give the orbits of points, many along a leading axis."""
        return self.at(y[..., -2:]), self._knots(y)

    def _knots(self, y):
        width = self.sequence.side.shape[-1]
        return y[..., : 3 * width].reshape(*y.shape[:-1], width, 3)

    def condition_at(self, y) -> Float[Array, "condition"]:
        """Compute what vanishes on the curve besides the gap of the orbit."""
        pair, knots = self.pair_and_knots(y)
        if self.condition == "multiplier":
            both = multipliers.multiplier_conditions(pair, self.sequence, knots)
            return jnp.where(self.multiplier > 0, both.plus, both.minus)[None]
        if self.device is not None:
            return self._loads(self.device, y[-2:], pair, knots)[self.touch.impact][None] - 1
        if self.condition == "split":
            t, speed, _ = knots[self.touch.impact]
            return jnp.stack(contacts.within(pair.at(self.touch.wall), self.touch.wall, t, speed, y[-3]))
        leave = jax.tree.map(lambda leaf: leaf[self.touch.impact], shooting.departures(pair, self.sequence, knots))
        rise, v = flights.flown(pair, leave.t, -leave.side * leave.speed, y[-3])
        return jnp.stack([0.5 * (leave.side - self.touch.wall) * pair.d + rise, v])

    def _loads(self, device: Harvester, z, pair: ImpactPair, knots) -> Float[Array, " impact"]:
        """Compute penetrations over their limit, or harvested energies over those given to the membrane."""
        x = self.places(z)
        own = {name: x[index] for index, name in enumerate(self.along) if name in ("A", "omega")}
        device = dataclasses.replace(device, **own)
        # When a contact is deepest is found by a search, and moves with the knots by its own equation.
        frozen = jax.tree.map(lax.stop_gradient, (pair, self.sequence, knots))
        out = shooting.departures(pair, self.sequence, knots).speed
        depth, energy, work = steady.yields(device, pair, self.sequence, knots, out, grazing.between(*frozen).deepest)
        # An orbit closed half way is as deep at the other wall, too.
        side, mirrored = self.sequence.side, self.sequence.mirrored
        limit = jnp.minimum(*(at(device.depth_limit, wall) for wall in (side, jnp.where(mirrored, -side, side))))
        if self.condition == "depth":
            return depth / limit
        if device.unequal:
            energy = jnp.maximum(energy, steady.image_energy(device, self.sequence, depth, energy))
        return energy / (device.energy_ratio_limit * work)

    def equations(self, y) -> PathEquations:
        """Compute the gap and the condition, and their derivatives in all unknowns."""
        pair, knots = self.pair_and_knots(y)
        moved = [jax.jvp(self.at, (y[-2:],), (unit,))[1] for unit in jnp.eye(2, dtype=y.dtype)]
        gap, ring, *_ = shooting.linearise(pair, self.sequence, knots, *moved)
        waits = y.size - gap.size - 2
        idle = jnp.zeros((*ring.beside.shape[:2], waits), y.dtype)
        ring = ring._replace(
            beside=jnp.concatenate([idle, ring.beside], axis=2), corner=jnp.zeros((0, waits + 2), y.dtype)
        )
        # Backwards: of one number, or two, all derivatives at once.
        return PathEquations(gap, self.condition_at(y), ring.bordered(jax.jacrev(self.condition_at)(y)))

    def _push(self, pair: ImpactPair, knots, wait) -> Float[Array, ""]:
        """Compute the acceleration away from where the ball touches: off the wall in flight, into it in a contact."""
        if self.condition == "split":
            return self.touch.wall * flights.acceleration(pair, knots[self.touch.impact, 0] + wait)
        leave = shooting.departures(pair, self.sequence, knots).t[self.touch.impact]
        return -self.touch.wall * flights.acceleration(pair, leave + wait)

    def tests(self, y, tangent, former) -> CurveTests:
        """Compute the test functions at a point with its tangent, reached along a former tangent."""
        pair, knots = self.pair_and_knots(y)
        one = jnp.ones_like(pair.d)
        plus, minus, push, resonance, touches = one, one, one, one, {}
        if self.condition in ("touch", "split"):
            plus, minus = multipliers.multiplier_conditions(pair, self.sequence, knots)
            here = jnp.arange(knots.shape[0], dtype=jnp.int32) == self.touch.impact
            touches = {self.condition: jnp.where(here, y[-3], jnp.nan)}
            push = self._push(pair, knots, y[-3])
            if pair.rigid or pair.hard_wall:
                met = multipliers.returned(pair, self.sequence, knots, self.touch.impact, y[-3])
                resonance = jnp.where(pair.hard(self.touch.wall), met, one)
        elif self.device is not None and self.touch.alike is not None:
            plus, minus = multipliers.multiplier_conditions(pair, self.sequence, knots)
            loads = self._loads(self.device, y[-2:], pair, knots)
            push = jnp.where(self.touch.alike, 1.0, loads[self.touch.impact] - loads).min()
        room = grazing.between(pair, self.sequence, knots, **touches).clearance
        z = y[-2:]
        return CurveTests(
            # Where a limit turns back its orbit has met its mirror image or has doubled, which `push` says.
            turn=(tangent[-2:] @ former[-2:]) / jnp.linalg.norm(former[-2:]) if self.device is None else one,
            cubic=one,
            plus=plus,
            minus=minus,
            resonance=resonance,
            push=push,
            speed=room.speed,
            flight=room.flight,
            contact=room.contact,
            exit=room.exit,
            low_first=z[0],
            high_first=1 - z[0],
            low_second=z[1],
            high_second=1 - z[1],
        )

    def happenings(self, before, after) -> Int[Array, ""]:
        """Count what happens between two points; of ends the first alone matters."""
        # A step begins the way that it goes.
        met = jnp.sign(before.at[TURN].set(1.0)) * jnp.sign(after) < 0
        things = jnp.append(met[:FIRST_CURVE_END], met[FIRST_CURVE_END:].any())
        return things.sum(dtype=jnp.int32)


def passed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Say which test functions change sign between rows of them; a step begins the way that it goes."""
    begun = np.sign(before)
    begun[:, TURN] = 1.0
    return begun * np.sign(after) < 0
