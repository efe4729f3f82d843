"""Averages of balls in perturbed devices, computed in one call, which may be a part of a user's jitted program.

Every ball has its own pair, and its energies are computed several times: for the device, and for devices that differ
from it in one electrical constant or in the unit of length. These variants share the motion of the ball to the last
bit, so that a difference of their energies is, per unit of perturbation, a derivative at fixed motion without noise.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int

from vijax.impact.gravity_regime import GravityRegime, gravity_regime_of
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import validation
from vijax.simulation.cell.cell import TRANSIENT_SHARE, Entry, Plan, Settings, walls_of
from vijax.simulation.cell.cell_program import program
from vijax.simulation.scheduler import lane_scheduler, record_rows
from vijax.simulation.simulate import compiled
from vijax.simulation.summary import Summary, summary_shapes


def averages(
    pair: ImpactPair,
    start: tuple[Float[Array, " ball"], Float[Array, " ball"]],
    length: Float[Array, " variant"],
    device: Harvester,
    count: Int[Array, ""],
    periods: Float[Array, ""],
) -> Summary:
    """Run balls with soft walls, each until its attractor is certified or `periods` are over; return their averages.

    Args:
        pair: Pairs of all balls; padding may hold any values.
        start: Displacement and velocity at phase 0.
        length: Unit of length [m] of each variant, for the energies.
        device: Electrical constants for the energies; each is an array [variant].
        count: Number of real balls; the rest is padding.
        periods: Limit of the search for an attractor.

    Returns:
        The summary; traced if an argument is traced.
    """
    unit = jnp.ones_like(pair.d)
    table = record_rows.pack(Entry(pair, unit, unit, *start, None))
    settings = Settings(
        periods=periods,
        transient=jnp.floor(TRANSIENT_SHARE * periods),
        device=device,
        method=None,
        length_variant=length,
        speed_variant=jnp.ones_like(length),
    )
    inputs = table, count, settings
    # On level ground (gamma = 0) the fast step is simpler; a traced program uses the regime WEAK for every other gamma.
    plans = [_plan(pair, gravity_regime, length.size) for gravity_regime in (GravityRegime.NONE, GravityRegime.WEAK)]
    if validation.is_concrete(inputs):
        plan = _plan(pair, gravity_regime_of(pair.gamma), length.size)
        table_out = compiled(plan, lane_scheduler.width_of(table.shape[0]))(*inputs)
    else:
        # Padding may hold any gamma, so only real balls decide which program runs.
        real = jnp.arange(table.shape[0], dtype=count.dtype) < count
        tilted = (
            jnp.any(real & (pair.gamma != 0)) if not validation.is_concrete(pair.gamma) else bool(np.any(pair.gamma))
        )
        table_out = _either(plans, tilted, inputs)
    return record_rows.unpack(table_out, summary_shapes(plans[0], table.dtype))


def _either(plans: list[Plan], tilted: Any, inputs: Any) -> Float[Array, "ball out"]:
    """Run the program of level ground if gamma is 0 for all balls; if gamma is traced, compile both programs."""
    if isinstance(tilted, bool):
        return _traced(plans[tilted], inputs)
    return lax.cond(tilted, partial(_traced, plans[1]), partial(_traced, plans[0]), inputs)


@partial(jax.jit, static_argnums=0)
def _traced(plan: Plan, inputs: Any) -> Float[Array, "ball out"]:
    """Compute the table of results inside a user's jitted program; a batch of devices is computed in sequence.

    `jax.jit` finds a compiled function by its identity. This is one function of the module, not one per call, so that a
    batch of devices is compiled once.
    """

    @sequential_vmap
    def run(table, count, settings):
        outputs = record_rows.width(summary_shapes(plan, table.dtype))
        return lane_scheduler.run(
            program(plan, settings), table, count, outputs, lane_scheduler.width_of(table.shape[0])
        )

    return run(*inputs)


def _plan(pair: ImpactPair, gravity_regime: GravityRegime, variants: int) -> Plan:
    return Plan(**walls_of(pair), gravity_regime=gravity_regime, deep=True, work=True, energies=True, variants=variants)
