"""Both fallbacks continue a declined lane from its current state with the same result."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax.impact.gravity_regime import gravity_regime_of
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime.compilation import xla
from vijax.runtime.compilation.lane_unrolling import unrolled
from vijax.simulation import impact_step
from vijax.simulation.cell import cell_program
from vijax.simulation.cell.cell import Entry, Plan, Settings

CELLS, STEPS = 2048, 60
PLAN = Plan(until="window", deep=True, work=True, tangent=False)
SETTINGS = Settings(
    periods=jnp.asarray(1000.0),
    transient=jnp.asarray(0.0),
    device=jax.tree.map(jnp.asarray, Harvester()),
    method=None,
    length_variant=jnp.ones(1),
    speed_variant=jnp.ones(1),
)


@pytest.fixture(scope="module")
def declined():
    """Cells after many steps without fallback, the lanes that declined, and the sampled and robust answers to them."""
    rng = np.random.default_rng(8)
    unity = jnp.ones(CELLS)
    d, kappa = rng.uniform(0.05, 0.3, CELLS), np.exp(rng.uniform(np.log(3), np.log(400), CELLS))
    pair = ImpactPair(jnp.asarray(d), jnp.asarray(kappa), 0.5 * unity, 0 * unity)

    @partial(jax.jit, compiler_options=xla.compiler_options())
    def work(entry):
        fresh = cell_program.load(PLAN, SETTINGS, entry)
        cell = jax.lax.fori_loop(0, STEPS, lambda _, cell: impact_step.step(PLAN, SETTINGS, cell), fresh)
        request = impact_step.request(PLAN, SETTINGS, cell)
        return cell, impact_step.sampled_answer(PLAN, request), impact_step.robust_answer(PLAN, request)

    cell, sampled, robust = jax.tree.map(
        np.asarray, work(Entry(pair, length=unity, speed=unity, u=0 * unity, v=0.4 * unity, t=None))
    )
    # Some flights are not certified; they need the robust fallback.
    sampled_lanes = cell.declined & sampled.certified
    assert 100 < sampled_lanes.sum() < CELLS
    assert sampled_lanes.sum() > 0.7 * cell.declined.sum()
    return sampled_lanes, cell, sampled.event.impact, robust.event.impact


@pytest.mark.long
@pytest.mark.parametrize(
    "wall", [ImpactPair(0.2, 20.0, 0.5, 0.9), ImpactPair(0.2, None, 0.5, 0.9)], ids=["soft", "rigid"]
)
def test_robust_answers_on_an_accelerator_are_the_same_lane_by_lane(on_gpu, wall):
    """On an accelerator the fallback is a kernel of single lanes; it iterates until the last lane is finished."""
    plan = Plan(rigid=wall.rigid, gravity_regime=gravity_regime_of(wall.gamma), deep=True, work=True)
    rng, unity = np.random.default_rng(4), jnp.ones(64)
    pair = jax.tree.map(lambda x: x * unity, wall)
    u, v, t = (jnp.asarray(rng.uniform(-x, x, 64)) for x in (0.1, 0.5, 1.0))
    entry = Entry(pair, length=unity, speed=unity, u=u, v=v, t=t)
    request = impact_step.request(plan, SETTINGS, cell_program.load(plan, SETTINGS, entry))
    plain = jax.jit(partial(impact_step.robust_answer, plan))(request)
    assert plain.event.real.any()
    leaves, tree = jax.tree.flatten(request)
    on_gpu()

    def answer(lane_leaves):
        return impact_step.robust_answer(plan, jax.tree.unflatten(tree, lane_leaves))

    by_lane = jax.jit(lambda leaves: unrolled(answer, leaves))(leaves)
    for got, want in zip(by_lane, jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-12)


def test_the_stored_arrival_belongs_to_the_current_state(declined):
    lanes, cell, _, robust = declined
    np.testing.assert_array_equal(cell.arrival.side[lanes], robust.side[lanes])
    np.testing.assert_allclose(cell.arrival.flight[lanes], robust.flight[lanes], rtol=0, atol=1e-13)
    np.testing.assert_allclose(cell.arrival.speed[lanes], np.abs(robust.v_in[lanes]), rtol=0, atol=1e-13)


def test_the_sampled_answer_agrees_with_the_robust_answer(declined):
    lanes, _, sampled, robust = declined
    for name in ("onset_t", "onset_n", "side", "v_in", "v_out", "flight", "duration", "depth"):
        got, expected = getattr(sampled, name)[lanes], getattr(robust, name)[lanes]
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12, err_msg=name)
