"""A curve of bifurcations in a plane of two parameters, as a path in the space of impact unknowns and both parameters.

The equations are the multiple-shooting equations of the orbit (`shooting`) and one or two more, which define the curve:

    multiplier     det(M - 1) = 0 or det(M + 1) = 0, with M the monodromy matrix;
    flight_graze   clearance = 0 and velocity = 0 at one more unknown time in a flight: the ball grazes a wall;
    contact_graze  penetration = 0 and its rate = 0 at one more unknown time in a contact, which splits in two;
    depth          penetration of an impact / its limit = 1;
    energy         harvested energy of an impact / (limit of the ratio * energy given to the membrane) = 1.

Real orbits are the solutions that the ball can follow. The equations have solutions beyond them, so that test functions
mark their end.
Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10 (continuation of codimension-one bifurcations).
"""

import dataclasses
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.continuation.arclength_step import PathEquations
from vijax.continuation.continuation_parameter import set_parameters
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import at_wall
from vijax.orbits import clearances, contacts, flights, multipliers, shooting, steady
from vijax.orbits.shooting import Sequence
from vijax.runtime.arrays import AnyArray

Condition = Literal["multiplier", "flight_graze", "contact_graze", "depth", "energy"]
CONDITIONS: dict[str, Condition] = {
    "grazing": "flight_graze",
    "grazing contact": "contact_graze",
    "penetration limit": "depth",
    "energy limit": "energy",
}
"""Equation that defines a curve, by kind; on curves of all other kinds a multiplier is +1 or -1."""


class CurveTests(NamedTuple):
    """Test functions of a curve: a sign change marks an event.

    The functions from `degeneracy` on are positive on real orbits.
    """

    cusp: Float[Array, ""]  # component of the tangent along the previous one, in the plane: negative past a cusp
    cubic: Float[Array, ""]  # cubic coefficient of a flip; 1 here, because only `curve_events` computes it
    plus: Float[Array, ""]  # on curves of grazing and limits: a multiplier passes +1
    minus: Float[Array, ""]  # a multiplier passes -1
    resonance: Float[Array, ""]  # at a graze of a rigid wall: slope of the return to the graze
    # At a graze the acceleration (`_graze_acceleration`); at a limit the least margin of the other impacts.
    degeneracy: Float[Array, ""]
    speed: Float[Array, ""]  # the clearances as in `BranchTests`, without the graze that defines the curve
    flight: Float[Array, ""]
    contact: Float[Array, ""]
    exit: Float[Array, ""]
    low_first: Float[Array, ""]  # distances of both parameters to their bounds, in sides of the plane
    high_first: Float[Array, ""]
    low_second: Float[Array, ""]
    high_second: Float[Array, ""]


CUSP, CUBIC = CurveTests._fields.index("cusp"), CurveTests._fields.index("cubic")
FIRST_CURVE_END_TEST = CurveTests._fields.index("degeneracy")


class EventLocation(eqx.Module):
    """Location of the event that defines a curve of grazing or of a limit.

    Attributes:
        impact: Index of the impact at the limit, or of the impact with the graze in its contact or in the flight after
            it.
        wall: Wall that the ball grazes.
        equal_load: At a limit, True for the impacts that have the same load as this impact by symmetry.
    """

    impact: Int[AnyArray, "*orbit"]
    wall: Float[AnyArray, "*orbit"]
    equal_load: Bool[AnyArray, "*orbit impact"] | None = None


class CurvePath(eqx.Module):
    """The continuation problem of one curve.

    Its unknowns are all impact unknowns, the time of a graze on curves of grazing, and both parameters. A graze in
    flight is timed from the end of the contact before it, a graze in a contact from the onset of this contact. Each
    parameter is scaled to its range, so that the plane is a square of side 1. If the ratio of its bounds exceeds ten,
    its logarithm is scaled instead.

    Attributes:
        pair: Parameters of the orbit at the start of the curve.
        sequence: Walls of its impacts.
        start: Values of both parameters at the start.
        vertical_gamma: g/A of the device, which is gamma of a vertical tube (used along "beta" only).
        low, high: Corners of the plane.
        multiplier: Value of the multiplier on the curve: +1. or -1. (flips, and pitchforks of orbits stored as half a
            period).
        location: Location of the graze, on curves of grazing; the impact at the limit, on curves of limits.
        device: Device with the limits, its `penetration_limit` included; None on curves of bifurcations.
        along: Names of both parameters.
        logarithmic: For each parameter, whether its logarithm is scaled.
        condition: Which equation defines the curve; see the module.
        newton_tolerance, max_corrections: See `ContinuationSettings`.
    """

    test_names: ClassVar[tuple[str, ...]] = CurveTests._fields
    first_end: ClassVar[int] = FIRST_CURVE_END_TEST

    pair: ImpactPair
    sequence: Sequence
    start: Float[AnyArray, "*orbit 2"]
    vertical_gamma: Float[AnyArray, "*orbit"]
    low: Float[AnyArray, "*orbit 2"]
    high: Float[AnyArray, "*orbit 2"]
    multiplier: Float[AnyArray, "*orbit"]
    location: EventLocation
    device: Harvester | None
    along: tuple[str, str] = eqx.field(static=True)
    logarithmic: tuple[bool, bool] = eqx.field(static=True)
    condition: Condition = eqx.field(static=True)
    newton_tolerance: float = eqx.field(static=True)
    max_corrections: int = eqx.field(static=True)

    def parameters(self, y):
        """Return the values of both parameters at points y, along the last axis."""
        z = y[..., -2:]
        linear = self.low + z * (self.high - self.low)
        # The formula with the power is used for logarithmic parameters only: with a bound that is zero or negative it
        # gives NaN.
        values = [
            self.low[..., i] * (self.high[..., i] / self.low[..., i]) ** z[..., i] if is_logarithmic else linear[..., i]
            for i, is_logarithmic in enumerate(self.logarithmic)
        ]
        return (jnp if isinstance(y, jax.Array) else np).stack(values, axis=-1)

    def at(self, z) -> ImpactPair:
        """Return the pair at the scaled parameters z, which are the last two unknowns."""
        x, start = self.parameters(z), self.start
        values = (x[..., 0], x[..., 1]), (start[..., 0], start[..., 1])
        return set_parameters(self.pair, self.along, *values, self.vertical_gamma)

    def pair_and_unknowns(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Return the pair and the impact unknowns at one point y, or at many points along a leading axis."""
        return self.at(y[..., -2:]), self._impact_unknowns(y)

    def _impact_unknowns(self, y):
        width = self.sequence.side.shape[-1]
        return y[..., : 3 * width].reshape(*y.shape[:-1], width, 3)

    def condition_at(self, y) -> Float[Array, "condition"]:
        """Compute the residual of the equations that define the curve, besides the equations of the orbit."""
        pair, impact_unknowns = self.pair_and_unknowns(y)
        if self.condition == "multiplier":
            conditions = multipliers.multiplier_conditions(pair, self.sequence, impact_unknowns)
            return jnp.where(self.multiplier > 0, conditions.plus, conditions.minus)[None]
        if self.device is not None:
            return self._load_ratios(self.device, y[-2:], pair, impact_unknowns)[self.location.impact][None] - 1
        if self.condition == "contact_graze":
            t, speed, _ = impact_unknowns[self.location.impact]
            return jnp.stack(
                contacts.penetration_and_rate(pair.at(self.location.wall), self.location.wall, t, speed, y[-3])
            )
        exit_state = jax.tree.map(
            lambda leaf: leaf[self.location.impact], shooting.contact_exits(pair, self.sequence, impact_unknowns)
        )
        rise, v = flights.advance_flight(pair, exit_state.t, -exit_state.side * exit_state.speed, y[-3])
        return jnp.stack([0.5 * (exit_state.side - self.location.wall) * pair.d + rise, v])

    def _load_ratios(self, device: Harvester, z, pair: ImpactPair, impact_unknowns) -> Float[Array, " impact"]:
        """Return penetrations over their limit, or harvested energies over the admissible ones, of every impact."""
        x = self.parameters(z)
        # A and omega enter the loads directly as well as through the pair, so that their derivatives are needed here
        # too.
        constants = {name: x[index] for index, name in enumerate(self.along) if name in ("A", "omega")}
        device = dataclasses.replace(device, **constants)
        # The time of the largest penetration is located by a search, which is not differentiated. The derivative of
        # that time follows from its own equation.
        frozen = jax.tree.map(lax.stop_gradient, (pair, self.sequence, impact_unknowns))
        exit_speed = shooting.contact_exits(pair, self.sequence, impact_unknowns).speed
        depth, energy, work = steady.impact_energies(
            device, pair, self.sequence, impact_unknowns, exit_speed, clearances.interior_motion(*frozen).deepest
        )
        # Of a symmetric orbit stored as half a period (`mirrored`) the other half is the mirror image. Each stored
        # impact also occurs at the other wall, with the same penetration and the limit of that wall.
        side, mirrored = self.sequence.side, self.sequence.mirrored
        limit = jnp.minimum(*(at_wall(device.depth_limit, wall) for wall in (side, jnp.where(mirrored, -side, side))))
        if self.condition == "depth":
            return depth / limit
        if device.has_unequal_walls:
            energy = jnp.maximum(energy, steady.image_energy(device, self.sequence, depth, energy))
        return energy / (device.energy_ratio_limit * work)

    def equations(self, y) -> PathEquations:
        """Compute the residual, and its derivatives in all unknowns."""
        pair, impact_unknowns = self.pair_and_unknowns(y)
        # Derivatives of the pair in both parameters; they give the last two columns.
        pair_tangents = [jax.jvp(self.at, (y[-2:],), (unit,))[1] for unit in jnp.eye(2, dtype=y.dtype)]
        residual, ring, *_ = shooting.linearise(pair, self.sequence, impact_unknowns, *pair_tangents)
        # Unknown graze times (none or one): the equations of the orbit do not depend on them, so that their columns are
        # zero.
        graze_time_count = y.size - residual.size - 2
        zero_columns = jnp.zeros((*ring.border_columns.shape[:2], graze_time_count), y.dtype)
        ring = ring._replace(
            border_columns=jnp.concatenate([zero_columns, ring.border_columns], axis=2),
            border_corner=jnp.zeros((0, graze_time_count + 2), y.dtype),
        )
        # Reverse mode, because the condition has one or two values only, and their derivatives in all unknowns are
        # needed.
        return PathEquations(residual, self.condition_at(y), ring.bordered(jax.jacrev(self.condition_at)(y)))

    def _graze_acceleration(self, pair: ImpactPair, impact_unknowns, delay) -> Float[Array, ""]:
        """Return the acceleration at the graze: away from the wall in a flight, into the wall in a contact.

        It is positive, and vanishes at a degenerate graze.
        """
        if self.condition == "contact_graze":
            return self.location.wall * flights.acceleration(pair, impact_unknowns[self.location.impact, 0] + delay)
        exit_time = shooting.contact_exits(pair, self.sequence, impact_unknowns).t[self.location.impact]
        return -self.location.wall * flights.acceleration(pair, exit_time + delay)

    def tests(self, y, tangent, previous_tangent) -> CurveTests:
        """Compute the test functions at a point with its tangent, after a step along `previous_tangent`."""
        pair, impact_unknowns = self.pair_and_unknowns(y)
        # Test functions of other conditions are constant 1: they never change sign.
        constant = jnp.ones_like(pair.d)
        plus, minus, degeneracy, resonance, graze_times = constant, constant, constant, constant, {}
        if self.condition in ("flight_graze", "contact_graze"):
            plus, minus = multipliers.multiplier_conditions(pair, self.sequence, impact_unknowns)
            # The graze on the curve itself is left out of the clearances, which would be zero all along the curve.
            is_grazing = jnp.arange(impact_unknowns.shape[0], dtype=jnp.int32) == self.location.impact
            graze_times = {self.condition: jnp.where(is_grazing, y[-3], jnp.nan)}
            degeneracy = self._graze_acceleration(pair, impact_unknowns, y[-3])
            if pair.rigid or pair.rigid_side:
                return_slope = multipliers.displacement_after_return(
                    pair, self.sequence, impact_unknowns, self.location.impact, y[-3]
                )
                resonance = jnp.where(pair.is_rigid_at(self.location.wall), return_slope, constant)
        elif self.device is not None and self.location.equal_load is not None:
            plus, minus = multipliers.multiplier_conditions(pair, self.sequence, impact_unknowns)
            load_ratios = self._load_ratios(self.device, y[-2:], pair, impact_unknowns)
            # Difference of the load at the limit and the largest other load that is not equal to it by symmetry.
            degeneracy = jnp.where(self.location.equal_load, 1.0, load_ratios[self.location.impact] - load_ratios).min()
        clearance = clearances.interior_motion(pair, self.sequence, impact_unknowns, **graze_times).clearance
        z = y[-2:]
        return CurveTests(
            # On a curve of a limit `degeneracy` marks the points where the curve turns back, so that the cusp is not
            # needed.
            cusp=(tangent[-2:] @ previous_tangent[-2:]) / jnp.linalg.norm(previous_tangent[-2:])
            if self.device is None
            else constant,
            cubic=constant,
            plus=plus,
            minus=minus,
            resonance=resonance,
            degeneracy=degeneracy,
            speed=clearance.speed,
            flight=clearance.flight,
            contact=clearance.contact,
            exit=clearance.exit,
            low_first=z[0],
            high_first=1 - z[0],
            low_second=z[1],
            high_second=1 - z[1],
        )

    def count_events(self, before, after) -> Int[Array, ""]:
        """Count the events between two points; all end tests count as one, because only the first end matters."""
        # The cusp test function compares the tangent with the tangent at the beginning of the step, where it is
        # positive.
        changes = jnp.sign(before.at[CUSP].set(1.0)) * jnp.sign(after) < 0
        events = jnp.append(changes[:FIRST_CURVE_END_TEST], changes[FIRST_CURVE_END_TEST:].any())
        return events.sum(dtype=jnp.int32)


def curve_sign_changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return which test functions change sign between rows of points."""
    start_signs = np.sign(before)
    # As in `count_events`, the cusp test function is +1 at the beginning of a step.
    start_signs[:, CUSP] = 1.0
    return start_signs * np.sign(after) < 0
