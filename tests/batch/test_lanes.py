"""Lanes on a toy program: every cell ends as a plain loop over it says, whatever it shares the lanes with."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Array, Bool, Float

from vijax.batch import accelerator_lanes, held_lanes, lane_rounds, lanes
from vijax.runtime import registers, tiles

Lane = Float[Array, "lane"]

EASY, DECLINES, HARD = 0, 1, 2
OUTPUTS = 3


class Toy(NamedTuple):
    """A countdown that hashes its way down; rows are (name, start, kind, rounds)."""

    name: Lane
    start: Lane
    kind: Lane
    rounds: Lane
    left: Lane
    hash: Lane
    careful: Lane
    declined: Bool[Array, " lane"]
    hard: Bool[Array, " lane"]
    done: Bool[Array, " lane"]


def load(rows):
    name, start, kind, rounds = rows.T
    zero, no = jnp.zeros_like(name), jnp.zeros(name.shape, bool)
    return Toy(name, start, kind, rounds, start, name, zero, no, no, no)


def wants_care(left, kind):
    """The same expression serves the lanes and the plain loop."""
    return ((kind == DECLINES) & (left % 3 == 0)) | ((kind == HARD) & (left % 5 == 0))


def step(toy):
    active = (toy.left > 0) & ~toy.declined & ~toy.done
    asks = active & wants_care(toy.left, toy.kind)
    moves = active & ~asks
    return toy._replace(
        hash=jnp.where(moves, (3 * toy.hash + toy.left) % 1009, toy.hash),
        left=toy.left - moves.astype(toy.left.dtype),
        declined=toy.declined | asks,
    )


class Answer(NamedTuple):
    """What a second or a careful try makes of a lane."""

    hash: Lane
    sure: Bool[Array, " lane"]


def careful(toy):
    return Answer((5 * toy.hash + toy.left) % 1009, jnp.ones_like(toy.done))


def second(toy):
    """What it is not sure of it gets wrong."""
    sure = toy.kind != HARD
    return Answer(jnp.where(sure, careful(toy).hash, -1.0), sure)


def settle(toy, answer, served):
    moves = served & answer.sure
    return toy._replace(
        hash=jnp.where(moves, answer.hash, toy.hash),
        left=toy.left - moves.astype(toy.left.dtype),
        careful=toy.careful + moves.astype(toy.left.dtype),
        declined=toy.declined & ~moves,
        hard=(toy.hard | served) & ~moves,
    )


def review(toy):
    ended = (toy.left <= 0) & ~toy.done
    again = ended & (toy.rounds > 1)
    return toy._replace(
        left=jnp.where(again, toy.start, toy.left),
        rounds=toy.rounds - ended.astype(toy.rounds.dtype),
        done=toy.done | (ended & ~again),
    )


PROGRAM = lane_rounds.Program(
    load=load,
    step=step,
    review=review,
    stopped=lambda toy: toy.left <= 0,
    done=lambda toy: toy.done,
    unload=lambda toy: jnp.stack([toy.name, toy.hash, toy.careful], axis=1),
    fixed=lambda toy: (toy.name, toy.start, toy.kind),
    service=lane_rounds.Service(
        declined=lambda toy: toy.declined,
        hard=lambda toy: toy.hard,
        request=lambda toy: toy,
        second=second,
        careful=careful,
        settle=settle,
    ),
)


def plain(row):
    """What becomes of one cell, in a loop of its own."""
    name, start, kind, rounds = (int(x) for x in row)
    digest, served = name, 0
    for _ in range(max(rounds, 1)):
        for left in range(start, 0, -1):
            asked = bool(wants_care(left, kind))
            digest = ((5 if asked else 3) * digest + left) % 1009
            served += asked
    return [name, digest, served]


def draw(number, kinds):
    rng = np.random.default_rng(7)
    lengths = np.where(rng.random(number) < 0.05, rng.integers(200, 400, number), rng.integers(0, 40, number))
    return np.stack([1 + np.arange(number), lengths, rng.choice(kinds, number), rng.integers(1, 4, number)], 1) * 1.0


@partial(jax.jit, static_argnames="width")
def run(cells, count, width):
    return lanes.run(PROGRAM, cells, count, OUTPUTS, width)


def results(cells, width, count=None):
    return np.asarray(run(jnp.asarray(cells), jnp.asarray(len(cells) if count is None else count, jnp.int32), width))


@pytest.mark.parametrize(
    "kinds",
    [[EASY], [EASY, DECLINES], [HARD], [EASY, EASY, DECLINES, HARD]],
    ids=["easy", "declining", "hard", "mixed"],
)
def test_every_cell_ends_as_in_a_plain_loop_of_its_own(kinds):
    cells = draw(1500, kinds)
    assert np.array_equal(results(cells, width=256), [plain(row) for row in cells])


@pytest.mark.parametrize("width", [7, 200, *(pytest.param(width, marks=pytest.mark.long) for width in (1, 128, 1024))])
def test_results_do_not_depend_on_the_number_of_lanes(width):
    cells = draw(600, [EASY, DECLINES, HARD])
    assert np.array_equal(results(cells, width), [plain(row) for row in cells])


def test_an_accelerator_is_given_no_kernels_and_the_same_results(monkeypatch):
    cells = draw(600, [EASY, DECLINES, HARD])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    @jax.jit
    def as_there(cells):
        return lanes.run(PROGRAM, cells, jnp.asarray(len(cells), jnp.int32), OUTPUTS, 100)

    assert "xla_cpu" not in as_there.lower(jnp.asarray(cells)).as_text()
    assert np.array_equal(as_there(jnp.asarray(cells)), [plain(row) for row in cells])


def in_registers(program, cells, number=256):
    """Run cells as a GPU does, their kernels interpreted here."""
    return jax.jit(lambda cells: lanes.run(program, cells, jnp.asarray(len(cells), jnp.int32), OUTPUTS, number))(cells)


@pytest.fixture
def interpreted(monkeypatch):
    """A GPU whose kernels are interpreted here; how many blocks of lanes each has."""
    blocks, stay = [], registers.stay

    def here(work, laid, number, tables, real=None):
        blocks.append(number.size // registers.LANES)
        return stay(work, laid, number, tables, real, interpret=True)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(registers, "stay", here)
    return blocks


def test_lanes_that_stay_in_registers_give_the_same_results(interpreted):
    """Lanes are stepped, reviewed and given their second tries block by block."""
    cells = draw(600, [EASY, DECLINES, HARD])
    found = in_registers(PROGRAM, cells)
    assert sorted(interpreted) == [1, 1, 8]  # a kernel of both tries for a batch, and one of steps for all
    assert np.array_equal(found, [plain(row) for row in cells])
    # Second tries are what serves the others: a careful one would be seen.
    spoiled = PROGRAM.service._replace(careful=lambda toy: Answer(-toy.hash, jnp.ones_like(toy.done)))
    program, cells = PROGRAM._replace(service=spoiled), draw(600, [EASY, DECLINES])
    assert np.array_equal(in_registers(program, cells), [plain(row) for row in cells])
    assert np.array_equal(in_registers(PROGRAM._replace(service=None, step=moves_on), cells), list(map(easily, cells)))


@pytest.mark.parametrize("number", [100, *(pytest.param(number, marks=pytest.mark.long) for number in (32, 128, 160))])
def test_a_batch_of_lanes_in_registers_is_of_whole_blocks(interpreted, number):
    """Else a kernel would leave some out, who would ask for ever; 100 lanes are held by no kernel."""
    cells = draw(200, [EASY, DECLINES, HARD])
    assert np.array_equal(in_registers(PROGRAM, cells, number), [plain(row) for row in cells])
    assert sorted(interpreted) == ([] if number == 100 else [1, 1, number // 32])


def test_chains_stay_in_registers_too(interpreted):
    links = draw_chains(64, 4)
    found = jax.jit(partial(lanes.chain, PROGRAM, succeed, outputs=OUTPUTS))(
        jnp.asarray(links), count=jnp.int32(64), length=jnp.int32(4)
    )
    assert sorted(interpreted) == [1, 1, 2]
    assert np.array_equal(found, [plain_chain(rows) for rows in links])


def moves_on(toy):
    """Count down, whatever the kind."""
    return step(toy._replace(kind=jnp.zeros_like(toy.kind)))


def easily(row):
    return plain([*row[:2], EASY, row[3]])


@pytest.mark.parametrize("number", [100, 256])
def test_chains_are_the_same_on_an_accelerator(monkeypatch, number):
    """With 256 lanes they lie in tables, which a kernel can hold."""
    links = draw_chains(number, 6)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    follow = jax.jit(partial(lanes.chain, PROGRAM, succeed, outputs=OUTPUTS))
    found = follow(jnp.asarray(links), count=jnp.int32(number), length=jnp.int32(6))
    assert np.array_equal(found, [plain_chain(rows) for rows in links])


def test_a_lane_that_an_answer_stopped_is_reviewed_although_none_of_its_block_goes_on():
    """Else it would stay where it is for ever: a GPU did not come back from a plane on which gravity holds the ball."""
    count = registers.LANES
    toy = load(jnp.asarray(of_kind(EASY, np.full(count, 5.0))))._replace(left=jnp.zeros(count))
    laid = registers.layout(toy, PROGRAM.fixed)
    at = lane_rounds.AtWork(jnp.arange(count, dtype=jnp.int32), registers.pack(laid, toy))
    found = registers.unpack(laid, held_lanes._held_steps(PROGRAM, laid, at))
    assert found.done.all()


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 599, 600])
def test_only_the_first_count_cells_run_and_the_rest_stays_zero(count):
    cells = draw(600, [EASY, DECLINES, HARD])
    expected = np.zeros((600, OUTPUTS))
    expected[:count] = np.reshape([plain(row) for row in cells[:count]], (count, OUTPUTS))
    assert np.array_equal(results(cells, width=128, count=count), expected)


def test_padding_is_never_looked_at():
    cells = draw(600, [EASY, DECLINES])
    padded = cells.copy()
    padded[77:] = np.nan  # a countdown of NaN never ends
    assert np.array_equal(results(padded, width=128, count=77)[:77], results(cells, width=128)[:77])


def test_a_cell_ends_alike_wherever_it_stands_in_the_table():
    cells = draw(600, [EASY, DECLINES, HARD])
    order = np.random.default_rng(1).permutation(600)
    assert np.array_equal(results(cells[order], width=128), results(cells, width=128)[order])


@partial(jax.jit, static_argnames="few")
def run_most(cells, count, few):
    return accelerator_lanes.run_most(PROGRAM, cells, count, OUTPUTS, 128, few)


@jax.jit
def run_rest(rows, count):
    like = jax.ShapeDtypeStruct((1, 4), rows.dtype)
    return lanes.run(accelerator_lanes.resumed(PROGRAM, like), rows, count, OUTPUTS, 16)


@pytest.mark.parametrize(
    ("count", "few"),
    [*(pytest.param(600, few, marks=pytest.mark.long) for few in (1, 128)), (600, 40), (30, 40), (0, 40)],
)
def test_the_last_cells_go_on_elsewhere_and_end_alike(count, few):
    cells = draw(600, [EASY, DECLINES, HARD])
    found, left = jax.tree.map(np.array, run_most(jnp.asarray(cells), jnp.asarray(count, jnp.int32), few))
    real = left.cell >= 0
    rest = left.cell[real]
    assert rest.size == np.unique(rest).size <= few
    assert rest.size or few == 1 or not count  # some may end in the round that leaves so few
    assert not found[rest].any()
    found[rest] = np.asarray(run_rest(jnp.asarray(left.lanes), jnp.asarray(real.sum(), jnp.int32)))[: rest.size]
    assert real[: rest.size].all()
    assert np.array_equal(found[:count], np.reshape([plain(row) for row in cells[:count]], (count, OUTPUTS)))


def of_kind(kind, starts):
    """Rows of cells that count down from these numbers, once."""
    starts = np.asarray(starts, float)
    return np.stack([np.arange(starts.size, dtype=float), starts, np.full(starts.size, kind), np.ones(starts.size)], 1)


def test_few_cells_are_flown_on_while_they_end_quickly():
    cells = of_kind(EASY, np.linspace(1, 64, 600).round())
    _, left = run_most(jnp.asarray(cells), jnp.asarray(600, jnp.int32), 128)
    assert not np.any(left.cell >= 0)


def test_a_cell_that_goes_on_for_long_is_left_to_others():
    cells = of_kind(EASY, [*np.linspace(1, 64, 599).round(), 1e6])
    _, left = run_most(jnp.asarray(cells), jnp.asarray(600, jnp.int32), 128)
    assert left.cell[left.cell >= 0].tolist() == [599]


def at_work(easy, hard, going):
    """Lanes of which so many ask for an easy answer or a hard one, and so many go on."""
    toy = load(jnp.asarray(of_kind(EASY, np.full(easy + hard + going, 5.0))))
    lane = jnp.arange(easy + hard + going)
    toy = toy._replace(declined=lane < easy + hard, hard=(lane >= easy) & (lane < easy + hard))
    return lane_rounds.AtWork(lane.astype(jnp.int32), toy)


def is_served(at, width):
    """Say whether lanes are served now, and if so whether those are easy ones."""
    if not lane_rounds._service_due(PROGRAM, width, *at):
        return None
    return "easy" if lane_rounds._ask(PROGRAM, PROGRAM.service, width, *at)[0] else "hard"


def is_served_elsewhere(at, width):
    held = held_lanes.hold(PROGRAM, 4, at.carry.left.dtype, at.cell.size)
    counted = accelerator_lanes.count(PROGRAM, held, at)
    return (None, "easy", "hard")[int(accelerator_lanes._turn(counted, width))]


@pytest.mark.parametrize(
    ("easy", "hard", "going", "on_a_cpu", "elsewhere"),
    [
        (64, 0, 90, "easy", "easy"),  # a batch is full
        (63, 0, 90, None, None),
        (15, 0, 15, "easy", "easy"),  # as many wait as go on
        (0, 3, 3, "hard", None),  # a careful try holds up an accelerator
        (0, 3, 0, "hard", "hard"),
        (2, 3, 4, "hard", None),
        (2, 3, 2, "hard", "easy"),
        (5, 4, 90, None, "hard"),  # it makes one for a sixteenth of a batch
        (64, 4, 90, "easy", "hard"),
    ],
)
def test_who_is_served_when(easy, hard, going, on_a_cpu, elsewhere):
    at = at_work(easy, hard, going)
    assert is_served(at, width=64) == on_a_cpu
    assert is_served_elsewhere(at, width=64) == elsewhere


def test_a_new_number_of_real_cells_compiles_nothing():
    cells = draw(600, [EASY])
    results(cells, width=128)
    before = run._cache_size()
    results(cells, width=128, count=5)
    assert run._cache_size() == before


# --- chains ---------------------------------------------------------------------------------------


def succeed(toy, rows):
    """The next countdown hashes on from the last one's digest."""
    return rows.at[:, 0].set(toy.hash)


@jax.jit
def chained(links, count, length):
    return lanes.chain(PROGRAM, succeed, links, count, length, OUTPUTS)


def draw_chains(chains, links):
    return draw(chains * links, [EASY, DECLINES, HARD]).reshape(chains, links, 4)


def plain_chain(rows):
    """What becomes of one chain, link after link."""
    found = []
    for row in rows:
        found.append(plain([found[-1][1] if found else row[0], *row[1:]]))
    return found


@pytest.mark.parametrize("chains", [1, 5, 40])
def test_every_link_starts_where_the_last_one_ended(chains):
    links = draw_chains(chains, 12)
    found = chained(jnp.asarray(links), jnp.asarray(chains, jnp.int32), jnp.asarray(12, jnp.int32))
    assert np.array_equal(found, [plain_chain(rows) for rows in links])


def test_chains_and_links_that_are_padding_stay_zero_and_are_never_looked_at():
    links = draw_chains(8, 6)
    links[5:], links[:, 4:] = np.nan, np.nan
    found = np.asarray(chained(jnp.asarray(links), jnp.asarray(5, jnp.int32), jnp.asarray(4, jnp.int32)))
    assert np.array_equal(found[:5, :4], [plain_chain(rows) for rows in links[:5, :4]])
    assert not found[5:].any()
    assert not found[:, 4:].any()


@pytest.mark.parametrize(("wanted", "expected"), [(1, ["a", "b"]), (2, ["a", "b"]), (5, ["a", "b", "a", "b"])])
def test_every_device_has_a_place_and_more_where_there_are_cores(monkeypatch, wanted, expected):
    monkeypatch.setattr(jax, "local_devices", lambda: ["a", "b"])
    monkeypatch.setattr(tiles, "workers", lambda: wanted)
    assert tiles.places() == expected
    with jax.default_device(jax.devices()[0]):
        assert tiles.places() == jax.devices()[:1] * wanted


@pytest.mark.parametrize(
    ("count", "size", "calls"),
    [(0, 0, 0), (1, 32, 1), (33, 32, 2), (100, 32, 4), (200, 256, 1), (400, 256, 2), (3000, 4096, 1), (9000, 4096, 3)],
)
def test_tiles_hold_every_row_once_and_little_padding(count, size, calls):
    found = tiles.tiles(count, (32, 256, 4096))
    assert [tile.rows.size for tile in found] == [size] * calls
    rows = [tile.rows[: tile.real] for tile in found]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, int), *rows]), np.arange(count))
    assert all((tile.rows[tile.real :] == count - 1).all() for tile in found)


@given(count=st.integers(0, 10**4), sizes=st.sets(st.integers(1, 5000), min_size=1))
def test_tiles_of_any_sizes_hold_every_row_once(count, sizes):
    found = tiles.tiles(count, tuple(sorted(sizes)))
    rows = [tile.rows[: tile.real] for tile in found]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, int), *rows]), np.arange(count))
    assert len({tile.rows.size for tile in found}) <= 1
    padding = sum(tile.rows.size - tile.real for tile in found)
    assert padding <= max(count, min(sizes))
