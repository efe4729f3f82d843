"""What a lane that declined has kept is what the careful step finds from where the lane stands."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax.batch import advance, cell_program
from vijax.batch.cell import Entry, Plan, Settings
from vijax.engine.ground import ground_of
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import xla
from vijax.runtime.unrolled import unrolled

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
    """Cells after many steps and no service, of those that declined; the sampled and the careful answers to them."""
    rng = np.random.default_rng(8)
    one = jnp.ones(CELLS)
    d, kappa = rng.uniform(0.05, 0.3, CELLS), np.exp(rng.uniform(np.log(3), np.log(400), CELLS))
    pair = ImpactPair(jnp.asarray(d), jnp.asarray(kappa), 0.5 * one, 0 * one)

    @partial(jax.jit, compiler_options=xla.compiler_options())
    def work(entry):
        fresh = cell_program.load(PLAN, SETTINGS, entry)
        cell = jax.lax.fori_loop(0, STEPS, lambda _, cell: advance.step(PLAN, SETTINGS, cell), fresh)
        request = advance.request(PLAN, SETTINGS, cell)
        return cell, advance.sampled_answer(PLAN, request), advance.careful_answer(PLAN, request)

    cell, sampled, careful = jax.tree.map(
        np.asarray, work(Entry(pair, length=one, speed=one, u=0 * one, v=0.4 * one, t=None))
    )
    # Of some the flight is not certain; these are for the careful step.
    some = cell.declined & sampled.sure
    assert 100 < some.sum() < CELLS
    assert some.sum() > 0.7 * cell.declined.sum()
    return some, cell, sampled.event.impact, careful.event.impact


@pytest.mark.long
@pytest.mark.parametrize(
    "wall", [ImpactPair(0.2, 20.0, 0.5, 0.9), ImpactPair(0.2, None, 0.5, 0.9)], ids=["soft", "rigid"]
)
def test_an_accelerator_finds_the_careful_answer_lane_by_lane(on_gpu, wall):
    """There it is a kernel, which knows single lanes alone, and goes round until the last of these is done."""
    plan = Plan(rigid=wall.rigid, ground=ground_of(wall.gamma), deep=True, work=True)
    rng, one = np.random.default_rng(4), jnp.ones(64)
    pair = jax.tree.map(lambda x: x * one, wall)
    u, v, t = (jnp.asarray(rng.uniform(-x, x, 64)) for x in (0.1, 0.5, 1.0))
    entry = Entry(pair, length=one, speed=one, u=u, v=v, t=t)
    request = advance.request(plan, SETTINGS, cell_program.load(plan, SETTINGS, entry))
    plain = jax.jit(partial(advance.careful_answer, plan))(request)
    assert plain.event.real.any()
    leaves, tree = jax.tree.flatten(request)
    on_gpu()

    def answer(some):
        return advance.careful_answer(plan, jax.tree.unflatten(tree, some))

    found = jax.jit(lambda leaves: unrolled(answer, leaves))(leaves)
    for got, want in zip(found, jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-12)


def test_the_kept_arrival_is_that_of_where_the_lane_stands(declined):
    some, cell, _, careful = declined
    np.testing.assert_array_equal(cell.arrival.side[some], careful.side[some])
    np.testing.assert_allclose(cell.arrival.flight[some], careful.flight[some], rtol=0, atol=1e-13)
    np.testing.assert_allclose(cell.arrival.speed[some], np.abs(careful.v_in[some]), rtol=0, atol=1e-13)


def test_the_sampled_answer_to_it_is_the_careful_one(declined):
    some, _, sampled, careful = declined
    for name in ("onset_t", "onset_n", "side", "v_in", "v_out", "flight", "duration", "depth"):
        got, wanted = getattr(sampled, name)[some], getattr(careful, name)[some]
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-12, err_msg=name)
