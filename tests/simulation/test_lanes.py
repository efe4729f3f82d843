"""The lane scheduler on a toy program: results equal a plain loop, independent of other cells."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Array, Bool, Float

from vijax.runtime import tiles
from vijax.runtime.compilation import register_kernels
from vijax.simulation.scheduler import accelerator_scheduler, lane_rounds, lane_scheduler, lane_storage

Lane = Float[Array, "lane"]

STEPS_ONLY, DECLINES, NEEDS_ROBUST = 0, 1, 2
OUTPUTS = 3


class Toy(NamedTuple):
    """A countdown that updates a hash in each step; rows are (name, start, kind, rounds)."""

    name: Lane
    start: Lane
    kind: Lane
    rounds: Lane
    remaining: Lane
    hash: Lane
    robust_answers: Lane
    declined: Bool[Array, " lane"]
    needs_robust: Bool[Array, " lane"]
    done: Bool[Array, " lane"]


def load(rows):
    name, start, kind, rounds = rows.T
    zero, no = jnp.zeros_like(name), jnp.zeros(name.shape, bool)
    return Toy(name, start, kind, rounds, start, name, zero, no, no, no)


def needs_fallback(remaining, kind):
    """Return True if a step requires a fallback; used by the lanes and by the plain loop."""
    return ((kind == DECLINES) & (remaining % 3 == 0)) | ((kind == NEEDS_ROBUST) & (remaining % 5 == 0))


def step(toy):
    active = (toy.remaining > 0) & ~toy.declined & ~toy.done
    declines = active & needs_fallback(toy.remaining, toy.kind)
    moves = active & ~declines
    return toy._replace(
        hash=jnp.where(moves, (3 * toy.hash + toy.remaining) % 1009, toy.hash),
        remaining=toy.remaining - moves.astype(toy.remaining.dtype),
        declined=toy.declined | declines,
    )


class Answer(NamedTuple):
    """Result of the fast or the robust fallback for a lane."""

    hash: Lane
    certified: Bool[Array, " lane"]


def robust_fallback(toy):
    return Answer((5 * toy.hash + toy.remaining) % 1009, jnp.ones_like(toy.done))


def fast_fallback(toy):
    """Return a wrong answer wherever it is not certified."""
    certified = toy.kind != NEEDS_ROBUST
    return Answer(jnp.where(certified, robust_fallback(toy).hash, -1.0), certified)


def settle(toy, answer, answered):
    moves = answered & answer.certified
    return toy._replace(
        hash=jnp.where(moves, answer.hash, toy.hash),
        remaining=toy.remaining - moves.astype(toy.remaining.dtype),
        robust_answers=toy.robust_answers + moves.astype(toy.remaining.dtype),
        declined=toy.declined & ~moves,
        needs_robust=(toy.needs_robust | answered) & ~moves,
    )


def review(toy):
    ended = (toy.remaining <= 0) & ~toy.done
    again = ended & (toy.rounds > 1)
    return toy._replace(
        remaining=jnp.where(again, toy.start, toy.remaining),
        rounds=toy.rounds - ended.astype(toy.rounds.dtype),
        done=toy.done | (ended & ~again),
    )


PROGRAM = lane_rounds.Program(
    load=load,
    step=step,
    review=review,
    stopped=lambda toy: toy.remaining <= 0,
    done=lambda toy: toy.done,
    unload=lambda toy: jnp.stack([toy.name, toy.hash, toy.robust_answers], axis=1),
    fixed=lambda toy: (toy.name, toy.start, toy.kind),
    service=lane_rounds.Service(
        declined=lambda toy: toy.declined,
        needs_robust=lambda toy: toy.needs_robust,
        request=lambda toy: toy,
        fast_fallback=fast_fallback,
        robust_fallback=robust_fallback,
        settle=settle,
    ),
)


def plain(row):
    """Return the result of one cell by a plain loop."""
    name, start, kind, rounds = (int(x) for x in row)
    digest, answers = name, 0
    for _ in range(max(rounds, 1)):
        for remaining in range(start, 0, -1):
            answered = bool(needs_fallback(remaining, kind))
            digest = ((5 if answered else 3) * digest + remaining) % 1009
            answers += answered
    return [name, digest, answers]


def draw(number, kinds):
    rng = np.random.default_rng(7)
    lengths = np.where(rng.random(number) < 0.05, rng.integers(200, 400, number), rng.integers(0, 40, number))
    return np.stack([1 + np.arange(number), lengths, rng.choice(kinds, number), rng.integers(1, 4, number)], 1) * 1.0


@partial(jax.jit, static_argnames="width")
def run(cells, count, width):
    return lane_scheduler.run(PROGRAM, cells, count, OUTPUTS, width)


def results(cells, width, count=None):
    return np.asarray(run(jnp.asarray(cells), jnp.asarray(len(cells) if count is None else count, jnp.int32), width))


@pytest.mark.parametrize(
    "kinds",
    [[STEPS_ONLY], [STEPS_ONLY, DECLINES], [NEEDS_ROBUST], [STEPS_ONLY, STEPS_ONLY, DECLINES, NEEDS_ROBUST]],
    ids=["fast", "declining", "robust", "mixed"],
)
def test_results_equal_those_of_a_plain_loop(kinds):
    cells = draw(1500, kinds)
    assert np.array_equal(results(cells, width=256), [plain(row) for row in cells])


@pytest.mark.parametrize("width", [7, 200, *(pytest.param(width, marks=pytest.mark.long) for width in (1, 128, 1024))])
def test_results_do_not_depend_on_the_number_of_lanes(width):
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    assert np.array_equal(results(cells, width), [plain(row) for row in cells])


def test_results_on_an_accelerator_without_register_kernels_are_the_same(monkeypatch):
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    @jax.jit
    def as_there(cells):
        return lane_scheduler.run(PROGRAM, cells, jnp.asarray(len(cells), jnp.int32), OUTPUTS, 100)

    assert "xla_cpu" not in as_there.lower(jnp.asarray(cells)).as_text()
    assert np.array_equal(as_there(jnp.asarray(cells)), [plain(row) for row in cells])


def in_registers(program, cells, number=256):
    """Run cells as a GPU does, with interpreted kernels."""
    return jax.jit(
        lambda cells: lane_scheduler.run(program, cells, jnp.asarray(len(cells), jnp.int32), OUTPUTS, number)
    )(cells)


@pytest.fixture
def interpreted(monkeypatch):
    """Interpret the kernels of a GPU; the list of the numbers of blocks of lanes, one number per kernel."""
    blocks, apply = [], register_kernels.apply_in_registers

    def here(work, laid, number, tables, real=None):
        blocks.append(number.size // register_kernels.LANES)
        return apply(work, laid, number, tables, real, interpret=True)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(register_kernels, "apply_in_registers", here)
    return blocks


def test_lanes_in_registers_have_the_same_results(interpreted):
    """Steps, reviews and fast fallbacks run block by block."""
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    table = in_registers(PROGRAM, cells)
    assert sorted(interpreted) == [1, 1, 8]  # a kernel for both fallbacks of a batch, and one for all steps
    assert np.array_equal(table, [plain(row) for row in cells])
    # The fast fallback answers the other kinds: the robust answer is wrong here.
    spoiled = PROGRAM.service._replace(robust_fallback=lambda toy: Answer(-toy.hash, jnp.ones_like(toy.done)))
    program, cells = PROGRAM._replace(service=spoiled), draw(600, [STEPS_ONLY, DECLINES])
    assert np.array_equal(in_registers(program, cells), [plain(row) for row in cells])
    assert np.array_equal(
        in_registers(PROGRAM._replace(service=None, step=step_without_declining), cells),
        list(map(plain_steps_only, cells)),
    )


@pytest.mark.parametrize("number", [100, *(pytest.param(number, marks=pytest.mark.long) for number in (32, 128, 160))])
def test_a_batch_of_lanes_in_registers_consists_of_full_blocks(interpreted, number):
    """A kernel would omit lanes of an incomplete block, which would wait for ever; 100 lanes run without kernels."""
    cells = draw(200, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    assert np.array_equal(in_registers(PROGRAM, cells, number), [plain(row) for row in cells])
    assert sorted(interpreted) == ([] if number == 100 else [1, 1, number // 32])


def test_chains_run_in_registers(interpreted):
    links = draw_chains(64, 4)
    table = jax.jit(partial(lane_scheduler.chain, PROGRAM, succeed, outputs=OUTPUTS))(
        jnp.asarray(links), count=jnp.int32(64), length=jnp.int32(4)
    )
    assert sorted(interpreted) == [1, 1, 2]
    assert np.array_equal(table, [plain_chain(rows) for rows in links])


def step_without_declining(toy):
    """Count down without declining, whatever the kind."""
    return step(toy._replace(kind=jnp.zeros_like(toy.kind)))


def plain_steps_only(row):
    return plain([*row[:2], STEPS_ONLY, row[3]])


@pytest.mark.parametrize("number", [100, 256])
def test_chains_are_the_same_on_an_accelerator(monkeypatch, number):
    """256 lanes are stored in tables, in a form that a kernel can process."""
    links = draw_chains(number, 6)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    follow = jax.jit(partial(lane_scheduler.chain, PROGRAM, succeed, outputs=OUTPUTS))
    table = follow(jnp.asarray(links), count=jnp.int32(number), length=jnp.int32(6))
    assert np.array_equal(table, [plain_chain(rows) for rows in links])


def test_a_stopped_lane_is_reviewed_in_a_block_without_active_lanes():
    """Otherwise the lane never ends: a GPU once hung on a plane with cells at rest under gravity."""
    count = register_kernels.LANES
    toy = load(jnp.asarray(of_kind(STEPS_ONLY, np.full(count, 5.0))))._replace(remaining=jnp.zeros(count))
    laid = register_kernels.layout(toy, PROGRAM.fixed)
    at = lane_rounds.LaneState(jnp.arange(count, dtype=jnp.int32), register_kernels.pack(laid, toy))
    reviewed = register_kernels.unpack(laid, lane_storage._register_steps(PROGRAM, laid, at))
    assert reviewed.done.all()


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 599, 600])
def test_only_the_first_count_cells_run_and_other_rows_are_zero(count):
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    expected = np.zeros((600, OUTPUTS))
    expected[:count] = np.reshape([plain(row) for row in cells[:count]], (count, OUTPUTS))
    assert np.array_equal(results(cells, width=128, count=count), expected)


def test_padding_is_never_simulated():
    cells = draw(600, [STEPS_ONLY, DECLINES])
    padded = cells.copy()
    padded[77:] = np.nan  # a countdown of NaN never ends
    assert np.array_equal(results(padded, width=128, count=77)[:77], results(cells, width=128)[:77])


def test_the_result_of_a_cell_does_not_depend_on_its_row():
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    order = np.random.default_rng(1).permutation(600)
    assert np.array_equal(results(cells[order], width=128), results(cells, width=128)[order])


@partial(jax.jit, static_argnames="few")
def run_most(cells, count, few):
    return accelerator_scheduler.run_until_few(PROGRAM, cells, count, OUTPUTS, 128, few)


@jax.jit
def run_rest(rows, count):
    like = jax.ShapeDtypeStruct((1, 4), rows.dtype)
    return lane_scheduler.run(accelerator_scheduler.resume_program(PROGRAM, like), rows, count, OUTPUTS, 16)


@pytest.mark.parametrize(
    ("count", "few"),
    [*(pytest.param(600, few, marks=pytest.mark.long) for few in (1, 128)), (600, 40), (30, 40), (0, 40)],
)
def test_the_remaining_cells_resume_in_another_program_with_the_same_results(count, few):
    cells = draw(600, [STEPS_ONLY, DECLINES, NEEDS_ROBUST])
    table, remaining = jax.tree.map(np.array, run_most(jnp.asarray(cells), jnp.asarray(count, jnp.int32), few))
    real = remaining.cell >= 0
    rest = remaining.cell[real]
    assert rest.size == np.unique(rest).size <= few
    assert rest.size or few == 1 or not count  # some may end in the round that reaches the limit
    assert not table[rest].any()
    table[rest] = np.asarray(run_rest(jnp.asarray(remaining.lanes), jnp.asarray(real.sum(), jnp.int32)))[: rest.size]
    assert real[: rest.size].all()
    assert np.array_equal(table[:count], np.reshape([plain(row) for row in cells[:count]], (count, OUTPUTS)))


def of_kind(kind, starts):
    """Return rows of cells with these starts and one round."""
    starts = np.asarray(starts, float)
    return np.stack([np.arange(starts.size, dtype=float), starts, np.full(starts.size, kind), np.ones(starts.size)], 1)


def test_the_last_cells_are_finished_while_they_end_quickly():
    cells = of_kind(STEPS_ONLY, np.linspace(1, 64, 600).round())
    _, remaining = run_most(jnp.asarray(cells), jnp.asarray(600, jnp.int32), 128)
    assert not np.any(remaining.cell >= 0)


def test_a_long_cell_is_returned_as_a_remaining_cell():
    cells = of_kind(STEPS_ONLY, [*np.linspace(1, 64, 599).round(), 1e6])
    _, remaining = run_most(jnp.asarray(cells), jnp.asarray(600, jnp.int32), 128)
    assert remaining.cell[remaining.cell >= 0].tolist() == [599]


def lanes_at_work(fast, robust, active):
    """Return lanes with these numbers of requests for the fast and the robust fallback, and of active lanes."""
    toy = load(jnp.asarray(of_kind(STEPS_ONLY, np.full(fast + robust + active, 5.0))))
    lane = jnp.arange(fast + robust + active)
    toy = toy._replace(declined=lane < fast + robust, needs_robust=(lane >= fast) & (lane < fast + robust))
    return lane_rounds.LaneState(lane.astype(jnp.int32), toy)


def due_fallback(at, width):
    """Return the fallback that is due now, or None."""
    if not lane_rounds._service_due(PROGRAM, width, *at):
        return None
    return "fast" if lane_rounds._collect_requests(PROGRAM, PROGRAM.service, width, *at)[0] else "robust"


def due_fallback_on_accelerator(at, width):
    storage = lane_storage.choose_storage(PROGRAM, 4, at.carry.remaining.dtype, at.cell.size)
    counted = accelerator_scheduler.count(PROGRAM, storage, at)
    return (None, "fast", "robust")[int(accelerator_scheduler._due_fallback(counted, width))]


@pytest.mark.parametrize(
    ("fast", "robust", "active", "on_a_cpu", "on_accelerator"),
    [
        (64, 0, 90, "fast", "fast"),  # a batch is full
        (63, 0, 90, None, None),
        (15, 0, 15, "fast", "fast"),  # as many lanes wait as are active
        (0, 3, 3, "robust", None),  # the robust fallback delays an accelerator
        (0, 3, 0, "robust", "robust"),
        (2, 3, 4, "robust", None),
        (2, 3, 2, "robust", "fast"),
        (5, 4, 90, None, "robust"),  # an accelerator runs it at a sixteenth of a batch
        (64, 4, 90, "fast", "robust"),
    ],
)
def test_conditions_for_the_fallbacks(fast, robust, active, on_a_cpu, on_accelerator):
    at = lanes_at_work(fast, robust, active)
    assert due_fallback(at, width=64) == on_a_cpu
    assert due_fallback_on_accelerator(at, width=64) == on_accelerator


def test_a_new_number_of_real_cells_compiles_nothing():
    cells = draw(600, [STEPS_ONLY])
    results(cells, width=128)
    before = run._cache_size()
    results(cells, width=128, count=5)
    assert run._cache_size() == before


# --- chains ---------------------------------------------------------------------------------------


def succeed(toy, rows):
    """Return the next countdown, with the last digest as its name."""
    return rows.at[:, 0].set(toy.hash)


@jax.jit
def chained(links, count, length):
    return lane_scheduler.chain(PROGRAM, succeed, links, count, length, OUTPUTS)


def draw_chains(chains, links):
    return draw(chains * links, [STEPS_ONLY, DECLINES, NEEDS_ROBUST]).reshape(chains, links, 4)


def plain_chain(rows):
    """Return the results of one chain by plain loops, link after link."""
    links = []
    for row in rows:
        links.append(plain([links[-1][1] if links else row[0], *row[1:]]))
    return links


@pytest.mark.parametrize("chains", [1, 5, 40])
def test_links_of_a_chain_start_at_the_end_of_the_previous_link(chains):
    links = draw_chains(chains, 12)
    table = chained(jnp.asarray(links), jnp.asarray(chains, jnp.int32), jnp.asarray(12, jnp.int32))
    assert np.array_equal(table, [plain_chain(rows) for rows in links])


def test_padding_of_chains_is_zero_and_never_simulated():
    links = draw_chains(8, 6)
    links[5:], links[:, 4:] = np.nan, np.nan
    table = np.asarray(chained(jnp.asarray(links), jnp.asarray(5, jnp.int32), jnp.asarray(4, jnp.int32)))
    assert np.array_equal(table[:5, :4], [plain_chain(rows) for rows in links[:5, :4]])
    assert not table[5:].any()
    assert not table[:, 4:].any()


@pytest.mark.parametrize(("workers", "expected"), [(1, ["a", "b"]), (2, ["a", "b"]), (5, ["a", "b", "a", "b"])])
def test_all_devices_have_a_place_and_more_with_more_cores(monkeypatch, workers, expected):
    monkeypatch.setattr(jax, "local_devices", lambda: ["a", "b"])
    monkeypatch.setattr(tiles, "workers", lambda: workers)
    assert tiles.tile_devices() == expected
    with jax.default_device(jax.devices()[0]):
        assert tiles.tile_devices() == jax.devices()[:1] * workers


@pytest.mark.parametrize(
    ("count", "size", "calls"),
    [(0, 0, 0), (1, 32, 1), (33, 32, 2), (100, 32, 4), (200, 256, 1), (400, 256, 2), (3000, 4096, 1), (9000, 4096, 3)],
)
def test_tiles_contain_all_rows_once_with_little_padding(count, size, calls):
    pieces = tiles.tiles(count, (32, 256, 4096))
    assert [tile.rows.size for tile in pieces] == [size] * calls
    rows = [tile.rows[: tile.real] for tile in pieces]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, int), *rows]), np.arange(count))
    assert all((tile.rows[tile.real :] == count - 1).all() for tile in pieces)


@given(count=st.integers(0, 10**4), sizes=st.sets(st.integers(1, 5000), min_size=1))
def test_tiles_of_any_sizes_contain_all_rows_once(count, sizes):
    pieces = tiles.tiles(count, tuple(sorted(sizes)))
    rows = [tile.rows[: tile.real] for tile in pieces]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, int), *rows]), np.arange(count))
    assert len({tile.rows.size for tile in pieces}) <= 1
    padding = sum(tile.rows.size - tile.real for tile in pieces)
    assert padding <= max(count, min(sizes))
