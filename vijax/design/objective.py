"""Objectives of a design for the ascents: value over the nodes of the tolerances, margins, and derivatives of both.

A node is a device with constants scattered by the tolerances; without tolerances there is one node. For each node
Newton's method solves for the periodic orbit, and the steady state on the orbit (`orbits.steady`) gives value, margins
and exact derivatives. With weights w_i and energies P_i of the nodes, the objective "mean" is log sum_i w_i P_i, and
"worst" is min_i log P_i, with the gradient of a soft minimum.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from vijax.design.ascent import Evaluation
from vijax.model import tuned_quantities
from vijax.model.choices import Objective
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.model.walls.sides import at_wall
from vijax.orbits import shooting, steady
from vijax.orbits.shooting import Sequence
from vijax.runtime.compilation.programs import jitted

OBJECTIVES: dict[Objective, str] = {
    "P": "energy harvested per half forcing period [J]",
    "power": "harvested power [W]",
    "speed": "largest speed into a wall [m/s]",
    "mean": "mean of P over the tolerances, a device without the orbit counting as 0 [J]",
    "worst": "least P over the tolerances [J]",
    "expected": "mean of P over all starts, each attractor by its share of them, and over the tolerances [J]",
}
_CONTINUATION_STEPS = 4  # continuation steps from the nominal orbit to the orbit of a device at its tolerance
_MAX_ITERATIONS = 16  # largest number of iterations of Newton's method; only lost orbits use all
_SOFTMIN_SHARPNESS = 300.0  # factor on log P in the soft minimum that gives the gradient of "worst"
_LARGEST_MARGIN = 20.0  # cap on margins, which are infinite without contact or voltage


class AscentBatch(eqx.Module):
    """Starts of one batch of ascents: device, walls in order of impact, impact unknowns, variables and bounds."""

    device: Harvester
    sequence: Sequence
    impact_unknowns: Float[Array, "start impact 3"]
    z: Float[Array, "start variable"]
    low: Float[Array, "start variable"]
    high: Float[Array, "start variable"]


class ObjectiveSpec(eqx.Module):
    """Objective, tuned quantities and tolerances, shared by all starts.

    Attributes:
        factors, weights: Factors on the scattered constants at each node of the tolerances, and the weight of the node.
            Node 0 is the nominal device.
        names: Names of the tuned quantities.
        scattered: Names of the scattered constants.
        objective: One of `OBJECTIVES`.
    """

    factors: Float[Array, "node constant"]
    weights: Float[Array, " node"]
    names: tuple[str, ...] = eqx.field(static=True)
    scattered: tuple[str, ...] = eqx.field(static=True)
    objective: str = eqx.field(static=True)

    def device(self, device: Harvester, z, factors) -> Harvester:
        """Return the device with tuned quantities and scattered constants."""
        return tuned_quantities.with_factors(
            tuned_quantities.tune_device(device, self.names, z), self.scattered, factors
        )


class _OrbitValues(NamedTuple):
    """Values at one device: logarithm of the objective, margins ln(limit / value), and impact unknowns of the orbit."""

    value: Float[Array, ""]
    margins: Float[Array, " constraint"]
    impact_unknowns: Float[Array, "impact 3"]


def _measure(spec: ObjectiveSpec, device: Harvester, sequence: Sequence, factors, impact_unknowns, residual, z):
    """Return (values, (values, status)) of an orbit as a function of the variables z.

    `jacfwd` with `has_aux` replaces the first copy of the values by derivatives and returns the second copy unchanged.
    """
    tuned_device = spec.device(device, z, factors)
    response = steady.steady_on_orbit(tuned_device, tuned_device.pair(), sequence, impact_unknowns, residual)
    value = {"power": response.power, "speed": response.speed}.get(spec.objective, response.P)
    real, unit_values = sequence.real, jnp.ones_like(response.depth)
    depth_margins = jnp.log(
        at_wall(tuned_device.depth_limit, sequence.side) / jnp.where(real, response.depth, unit_values)
    )
    # Margins are log(limit / value); padding impacts get the largest margin.
    energy_margins = jnp.log(
        tuned_device.energy_ratio_limit
        * jnp.where(real, response.work, unit_values)
        / jnp.where(real, response.energy, unit_values)
    )
    margins = jnp.concatenate([jnp.where(real, x, _LARGEST_MARGIN) for x in (depth_margins, energy_margins)])
    orbit_values = _OrbitValues(jnp.log(value), jnp.minimum(margins, _LARGEST_MARGIN), response.impact_unknowns)
    return orbit_values, (orbit_values, response.status)


class NodeOrbits(NamedTuple):
    """Orbits of all nodes and their slopes in the variables; `exists` is False where an orbit is lost."""

    impact_unknowns: Float[Array, "start node impact 3"]
    slopes: Float[Array, "start node impact 3 variable"]
    exists: Bool[Array, "start node"]


def _solve_orbits(spec: ObjectiveSpec, batch: AscentBatch, z, factors, guess):
    """Solve for the orbits from initial values; return impact unknowns and residuals [start, node, ...]."""
    make_pair = lambda device, z, factors: spec.device(device, z, factors).pair()  # noqa: E731
    pair = jax.vmap(jax.vmap(make_pair, in_axes=(None, None, 0)))(batch.device, z, factors)
    starts, count = guess.shape[:2]
    sequence = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), batch.sequence)
    flat = jax.tree.map(lambda x: x.reshape(starts * count, *x.shape[2:]), (pair, guess))
    solution = shooting.newton(flat[0], sequence, flat[1], _MAX_ITERATIONS)
    return jax.tree.map(lambda x: x.reshape(starts, count, *x.shape[1:]), (solution.impact_unknowns, solution.residual))


def follow_node_orbits(spec: ObjectiveSpec, batch: AscentBatch) -> NodeOrbits:
    """Return initial values for the orbits of all nodes, by continuation from the nominal orbits."""
    starts, count = batch.z.shape[0], spec.weights.size
    factors = jnp.broadcast_to(spec.factors, (starts, *spec.factors.shape))

    def follow(step, impact_unknowns):
        # Step k, 0 to 3, raises the factors to the power k / 4. The caller solves with the factors themselves.
        partial_factors = factors ** (step.astype(factors.dtype) / _CONTINUATION_STEPS)
        return _solve_orbits(spec, batch, batch.z, partial_factors, impact_unknowns)[0]

    impact_unknowns = jnp.repeat(batch.impact_unknowns[:, None], count, axis=1)
    if count > 1:
        impact_unknowns = lax.fori_loop(0, _CONTINUATION_STEPS, follow, impact_unknowns)
    return NodeOrbits(
        impact_unknowns,
        jnp.zeros((*impact_unknowns.shape, batch.z.shape[1]), impact_unknowns.dtype),
        jnp.ones((starts, count), bool),
    )


def _predict_orbits(spec: ObjectiveSpec, batch: AscentBatch, z, near, node_orbits: NodeOrbits):
    """Solve for the orbits at z, from linear predictions at `near`; return impact unknowns and residuals."""
    # First-order prediction from the orbits at `near`.
    guess = node_orbits.impact_unknowns + (node_orbits.slopes * (z - near)[:, None, None, None]).sum(axis=-1)
    # If the orbit of a node was lost, Newton's method starts from the nominal orbit, which may recover the lost one.
    guess = jnp.where(node_orbits.exists[..., None, None], guess, guess[:, :1])
    factors = jnp.broadcast_to(spec.factors, (z.shape[0], *spec.factors.shape))
    return _solve_orbits(spec, batch, z, factors, guess)


def _map_starts_and_nodes(function):
    """Map a function of (device, sequence, factors, impact unknowns, residual, z) over starts and nodes."""
    over_nodes = jax.vmap(function, in_axes=(None, None, 0, 0, 0, None))
    return jax.vmap(over_nodes, in_axes=(0, 0, None, 0, 0, 0))


def evaluate_objective(spec: ObjectiveSpec, batch: AscentBatch, z, near, node_orbits: NodeOrbits) -> Evaluation:
    """Evaluate objective and margins of every start at z, with derivatives, for `ascent.ascend`."""
    impact_unknowns, residual = _predict_orbits(spec, batch, z, near, node_orbits)
    # Forward mode is used because there are few variables and many outputs.
    slope = jax.jacfwd(partial(_measure, spec), argnums=5, has_aux=True)
    slopes, (orbit_values, status) = _map_starts_and_nodes(slope)(
        batch.device, batch.sequence, spec.factors, impact_unknowns, residual, z
    )
    is_ok, counts = status == Status.OK, spec.weights > 0
    if spec.objective == "worst":
        value = jnp.where(counts, orbit_values.value, jnp.inf).min(axis=1)
        # The value is the minimum itself; its gradient has the weights of the soft minimum.
        share = jax.nn.softmax(jnp.where(counts, -_SOFTMIN_SHARPNESS * orbit_values.value, -jnp.inf), axis=1)
        exists = is_ok.all(axis=1)
    else:
        # A device with a lost orbit counts as P = 0 in the mean, so the weights are not renormalised.
        parts = jnp.where(is_ok & counts, jnp.log(spec.weights) + orbit_values.value, -jnp.inf)
        value, share = jax.nn.logsumexp(parts, axis=1), jax.nn.softmax(parts, axis=1)
        # A mean exists if the nominal orbit exists; a worst case exists only if the orbits of all nodes exist.
        exists = is_ok[:, 0]
    value_slopes = jnp.where((is_ok & counts)[..., None], slopes.value, 0.0)
    # A device with a lost orbit gets the margins of the nominal device. With large margins instead, the barrier would
    # reward the loss of the orbit.
    margins = jnp.where(is_ok[..., None], orbit_values.margins, orbit_values.margins[:, :1])
    margin_slopes = jnp.where(is_ok[..., None, None], slopes.margins, slopes.margins[:, :1])
    flat = (z.shape[0], -1)
    return Evaluation(
        value=value,
        gradient=(share[..., None] * value_slopes).sum(axis=1),
        margins=margins.reshape(flat),
        slopes=margin_slopes.reshape(*flat, z.shape[1]),
        exists=exists & jnp.isfinite(value),
        memory=NodeOrbits(orbit_values.impact_unknowns, slopes.impact_unknowns, is_ok),
    )


@jitted
def spread_over_tolerances(spec: ObjectiveSpec, batch: AscentBatch) -> tuple[Array, ...]:
    """Return mean and worst value, and lost and inadmissible shares, of each start, as in `ToleranceStatistics`."""
    impact_unknowns, residual = _predict_orbits(spec, batch, batch.z, batch.z, follow_node_orbits(spec, batch))
    measure = _map_starts_and_nodes(partial(_measure, spec))
    _, (orbit_values, status) = measure(batch.device, batch.sequence, spec.factors, impact_unknowns, residual, batch.z)
    is_ok = status == Status.OK
    admissible = is_ok & (orbit_values.margins.min(axis=-1) >= 0)
    value = jnp.where(admissible, jnp.exp(orbit_values.value), 0.0)
    counts = spec.weights > 0
    return (
        (spec.weights * value).sum(axis=1),
        jnp.where(counts, jnp.where(is_ok, jnp.exp(orbit_values.value), 0.0), jnp.inf).min(axis=1),
        jnp.where(is_ok, 0.0, spec.weights).sum(axis=1),
        jnp.where(is_ok & ~admissible, spec.weights, 0.0).sum(axis=1),
    )
