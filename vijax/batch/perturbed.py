"""Balls in devices a little apart from one, run to their averages: in one call, and inside a program that JAX traces.

Every ball has a pair of its own, and its energies are counted several times over: in the device, and in devices that
differ from it in one electrical constant or in the unit of length. These share its motion to the last bit, so that a
difference of their energies is a derivative at fixed motion without noise.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int

from vijax.batch import lanes, rows
from vijax.batch.cell import TRANSIENT_SHARE, Entry, Plan, Settings, walls_of
from vijax.batch.cell_program import program
from vijax.batch.simulate import compiled
from vijax.batch.summary import Summary, shapes
from vijax.engine.ground import Ground, ground_of
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import checks


def averages(
    pair: ImpactPair,
    start: tuple[Float[Array, " ball"], Float[Array, " ball"]],
    length: Float[Array, " variant"],
    device: Harvester,
    count: Int[Array, ""],
    periods: Float[Array, ""],
) -> Summary:
    """Run balls with soft walls, each until its attractor is certain, or to its averages over so many periods.

    Args:
        pair: Of every ball, padded by any.
        start: Displacement and velocity at phase 0.
        length: Units of length [m] in which energies are counted.
        device: The electrical constants that go with them, [variant] each.
        count: How many balls are real.
        periods: The most that the search for an attractor may take.

    Returns:
        The summary; traced where anything that was given is.
    """
    one = jnp.ones_like(pair.d)
    table = rows.pack(Entry(pair, one, one, *start, None))
    settings = Settings(
        periods=periods,
        transient=jnp.floor(TRANSIENT_SHARE * periods),
        device=device,
        method=None,
        length_variant=length,
        speed_variant=jnp.ones_like(length),
    )
    given = table, count, settings
    plans = [_plan(pair, ground, length.size) for ground in (Ground.LEVEL, Ground.GENTLE)]
    if checks.is_concrete(given):
        plan = _plan(pair, ground_of(pair.gamma), length.size)
        found = compiled(plan, lanes.width_of(table.shape[0]))(*given)
    else:
        # Rows of padding may hold anything.
        real = jnp.arange(table.shape[0], dtype=count.dtype) < count
        tilted = jnp.any(real & (pair.gamma != 0)) if not checks.is_concrete(pair.gamma) else bool(np.any(pair.gamma))
        found = _either(plans, tilted, given)
    return rows.unpack(found, shapes(plans[0], table.dtype))


def _either(plans: list[Plan], tilted: Any, given: Any) -> Float[Array, "ball out"]:
    """Run the program of level ground if all balls are on it; where that is not known yet, both are compiled."""
    if isinstance(tilted, bool):
        return _traced(plans[tilted], given)
    return lax.cond(tilted, partial(_traced, plans[1]), partial(_traced, plans[0]), given)


@partial(jax.jit, static_argnums=0)
def _traced(plan: Plan, given: Any) -> Float[Array, "ball out"]:
    """Compute the table of results inside a larger program; of a batch of devices one after another.

    One call known by its identity, so that a batch is compiled once.
    """

    @sequential_vmap
    def run(table, count, settings):
        outputs = rows.width(shapes(plan, table.dtype))
        return lanes.run(program(plan, settings), table, count, outputs, lanes.width_of(table.shape[0]))

    return run(*given)


def _plan(pair: ImpactPair, ground: Ground, variants: int) -> Plan:
    return Plan(**walls_of(pair), ground=ground, deep=True, work=True, energies=True, variants=variants)
