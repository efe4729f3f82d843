"""What a design maximises, as an optimiser looks at it: the objective over all tolerances, the margins, derivatives."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from vijax.design.ascent import Look
from vijax.model import variables
from vijax.model.choices import Objective
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.model.sides import at
from vijax.orbits import shooting, steady
from vijax.orbits.shooting import Sequence
from vijax.runtime.programs import jitted

OBJECTIVES: dict[Objective, str] = {
    "P": "energy harvested per half forcing period [J]",
    "power": "harvested power [W]",
    "speed": "largest speed into a wall [m/s]",
    "mean": "mean of P over the tolerances, a device whose orbit is lost counting nothing [J]",
    "worst": "least P over the tolerances [J]",
    "expected": "mean of P over all starts, each attractor by its share of them, and over the tolerances [J]",
}
_STEPS = 4  # so many lead from the nominal orbit to that of a device off by its tolerance
_MOST_ITERATIONS = 16  # Newton's search near a known orbit gives up after so many: lost ones take them all
_SHARP = 300.0  # how nearly the soft minimum, whose gradient stands for the worst case's, is the minimum
_MOST = 20.0  # logarithms of margins end here: no contact, no voltage


class Batch(eqx.Module):
    """Starts that climb together: device, walls and knots of each, variables and their bounds."""

    device: Harvester
    sequence: Sequence
    knots: Float[Array, "start impact 3"]
    z: Float[Array, "start variable"]
    low: Float[Array, "start variable"]
    high: Float[Array, "start variable"]


class Scene(eqx.Module):
    """What every start shares."""

    factors: Float[Array, "node constant"]
    weights: Float[Array, " node"]
    names: tuple[str, ...] = eqx.field(static=True)
    scattered: tuple[str, ...] = eqx.field(static=True)
    objective: str = eqx.field(static=True)

    def device(self, device: Harvester, z, factors) -> Harvester:
        """Make the device with tuned quantities and scattered constants."""
        return variables.scattered(variables.tuned(device, self.names, z), self.scattered, factors)


class _SeenOrbit(NamedTuple):
    """Of one device: logarithm of the objective and of the margins, and the knots."""

    value: Float[Array, ""]
    margins: Float[Array, " constraint"]
    knots: Float[Array, "impact 3"]


def _measure(scene: Scene, device: Harvester, sequence: Sequence, factors, knots, residual, z):
    """Compute the objective at an orbit as a function of the variables, and the status."""
    own = scene.device(device, z, factors)
    there = steady.response(own, own.pair(), sequence, knots, residual)
    value = {"power": there.power, "speed": there.speed}.get(scene.objective, there.P)
    real, one = sequence.real, jnp.ones_like(there.depth)
    deep = jnp.log(at(own.depth_limit, sequence.side) / jnp.where(real, there.depth, one))
    rich = jnp.log(own.energy_ratio_limit * jnp.where(real, there.work, one) / jnp.where(real, there.energy, one))
    margins = jnp.concatenate([jnp.where(real, x, _MOST) for x in (deep, rich)])
    seen = _SeenOrbit(jnp.log(value), jnp.minimum(margins, _MOST), there.knots)
    return seen, (seen, there.status)


class Known(NamedTuple):
    """The orbits of every start's nodes, and how they move with the variables."""

    knots: Float[Array, "start node impact 3"]
    slopes: Float[Array, "start node impact 3 variable"]
    there: Bool[Array, "start node"]


def _settled(scene: Scene, batch: Batch, z, factors, guess):
    """Find knots and residuals [start, node] of the orbits near guesses."""
    one = lambda device, z, factors: scene.device(device, z, factors).pair()  # noqa: E731
    pair = jax.vmap(jax.vmap(one, in_axes=(None, None, 0)))(batch.device, z, factors)
    starts, count = guess.shape[:2]
    sequence = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), batch.sequence)
    flat = jax.tree.map(lambda x: x.reshape(starts * count, *x.shape[2:]), (pair, guess))
    found = shooting.newton(flat[0], sequence, flat[1], _MOST_ITERATIONS)
    return jax.tree.map(lambda x: x.reshape(starts, count, *x.shape[1:]), (found.knots, found.residual))


def begin(scene: Scene, batch: Batch) -> Known:
    """Follow the orbits of all nodes in a few steps from the nominal ones."""
    starts, count = batch.z.shape[0], scene.weights.size
    wide = jnp.broadcast_to(scene.factors, (starts, *scene.factors.shape))

    def onward(step, knots):
        part = wide ** (step.astype(wide.dtype) / _STEPS)
        return _settled(scene, batch, batch.z, part, knots)[0]

    knots = jnp.repeat(batch.knots[:, None], count, axis=1)
    if count > 1:
        knots = lax.fori_loop(0, _STEPS, onward, knots)
    return Known(knots, jnp.zeros((*knots.shape, batch.z.shape[1]), knots.dtype), jnp.ones((starts, count), bool))


def _orbits(scene: Scene, batch: Batch, z, near, known: Known):
    """Find knots and residuals [start, node] of the orbits that follow from those near."""
    guess = known.knots + (known.slopes * (z - near)[:, None, None, None]).sum(axis=-1)
    # A device whose orbit was lost may have the nominal one again.
    guess = jnp.where(known.there[..., None, None], guess, guess[:, :1])
    factors = jnp.broadcast_to(scene.factors, (z.shape[0], *scene.factors.shape))
    return _settled(scene, batch, z, factors, guess)


def _over_all(function):
    """Map a function of (device, sequence, factors, knots, residual, z) over starts and nodes."""
    over_nodes = jax.vmap(function, in_axes=(None, None, 0, 0, 0, None))
    return jax.vmap(over_nodes, in_axes=(0, 0, None, 0, 0, 0))


def look(scene: Scene, batch: Batch, z, near, known: Known) -> Look:
    """See the objective of every start with its derivatives, for `ascent.ascend`."""
    knots, residual = _orbits(scene, batch, z, near, known)
    slope = jax.jacfwd(partial(_measure, scene), argnums=5, has_aux=True)
    slopes, (seen, status) = _over_all(slope)(batch.device, batch.sequence, scene.factors, knots, residual, z)
    fine, counts = status == Status.OK, scene.weights > 0
    if scene.objective == "worst":
        value = jnp.where(counts, seen.value, jnp.inf).min(axis=1)
        share = jax.nn.softmax(jnp.where(counts, -_SHARP * seen.value, -jnp.inf), axis=1)
        there = fine.all(axis=1)
    else:
        # Weights as they are: a device whose orbit is lost lowers the mean.
        parts = jnp.where(fine & counts, jnp.log(scene.weights) + seen.value, -jnp.inf)
        value, share = jax.nn.logsumexp(parts, axis=1), jax.nn.softmax(parts, axis=1)
        there = fine[:, 0]
    rise = jnp.where((fine & counts)[..., None], slopes.value, 0.0)
    # A lost device is held as the nominal one is: wide margins would make the barrier reward the loss.
    margins = jnp.where(fine[..., None], seen.margins, seen.margins[:, :1])
    steep = jnp.where(fine[..., None, None], slopes.margins, slopes.margins[:, :1])
    flat = (z.shape[0], -1)
    return Look(
        value=value,
        gradient=(share[..., None] * rise).sum(axis=1),
        margins=margins.reshape(flat),
        slopes=steep.reshape(*flat, z.shape[1]),
        there=there & jnp.isfinite(value),
        memory=Known(seen.knots, slopes.knots, fine),
    )


@jitted
def spread(scene: Scene, batch: Batch) -> tuple[Array, ...]:
    """Compute mean and worst value of designs over tolerances, shares of those lost and inadmissible; see `Spread`."""
    knots, residual = _orbits(scene, batch, batch.z, batch.z, begin(scene, batch))
    measure = _over_all(partial(_measure, scene))
    _, (seen, status) = measure(batch.device, batch.sequence, scene.factors, knots, residual, batch.z)
    fine = status == Status.OK
    kept = fine & (seen.margins.min(axis=-1) >= 0)
    value = jnp.where(kept, jnp.exp(seen.value), 0.0)
    counts = scene.weights > 0
    return (
        (scene.weights * value).sum(axis=1),
        jnp.where(counts, jnp.where(fine, jnp.exp(seen.value), 0.0), jnp.inf).min(axis=1),
        jnp.where(fine, 0.0, scene.weights).sum(axis=1),
        jnp.where(fine & ~kept, scene.weights, 0.0).sum(axis=1),
    )
