"""Every impact of a stretch of periods, and the ball at phase 0 in between, of many balls at once."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vijax.batch.exact_run import balls_at
from vijax.engine import exact
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

# No result depends on these: how many balls fly together, how many at phase 0 are found together, and after how many
# impacts of each those that have arrived make room. Fewer are more calls, more are more rows that nobody needs.
_TILE, _STROBES, _STEPS = 256, 4096, 16


class Record(NamedTuple):
    """What happened to every ball, in order.

    Attributes:
        impacts: By name, [ball, impact], NaN beyond `filled`: `n` (period, from 0), `t` (phase of the onset), `side`,
            `v_in`, `v_out` (signed), `duration`, `depth` and `work` (of a rigid wall those of kappa = 1).
        filled: Impacts of each ball.
        u, v: The ball at phase 0 of periods 1 ... periods, [ball, period]; NaN of balls that were not flown.
    """

    impacts: dict[str, np.ndarray]
    filled: np.ndarray
    u: np.ndarray
    v: np.ndarray


_KEPT = ("n", "t", "side", "v_in", "v_out", "duration", "depth", "work")


class _Step(NamedTuple):
    """One step of a ball: where it began, what came of it."""

    begun: State
    out: exact.Outcome


def record(pair: ImpactPair, starts: State, periods: int, wanted: np.ndarray) -> Record:
    """Fly balls to the end of some periods, by the careful step.

    Args:
        pair: Cells [ball]; `kappa=None` for rigid walls.
        starts: Where each begins, in flight or in contact; n < 0 where it does so before the first period.
        periods: How many periods are looked at.
        wanted: Which balls fly at all.

    Returns:
        The record; impacts whose onset lies before period 0 or after the last one are not in it.
    """
    pair, starts = jax.tree.map(np.asarray, (pair, starts))
    count = starts.u.size
    live, states = np.flatnonzero(wanted), jax.tree.map(lambda x: x[wanted], starts)
    balls: list[np.ndarray] = [np.zeros(0, int)]
    parts: list[_Step] = []
    while live.size:
        taken = jax.tree.map(lambda x, live=live: x[live], pair)
        after, over, steps, real = _advance(taken, states, periods)
        balls.append(np.repeat(live, _STEPS)[real.ravel()])
        parts.append(jax.tree.map(lambda x, real=real: x[real], steps))
        live, states = live[~over], jax.tree.map(lambda x, over=over: x[~over], after)
    ball = np.concatenate(balls)
    order = np.argsort(ball, kind="stable")
    ball = ball[order]
    flown = jax.tree.map(lambda *x: np.concatenate(x)[order], *parts) if parts else None
    return Record(*_impacts(ball, flown, count, periods), *_strobes(pair, ball, flown, count, periods))


@jitted
def _some_steps(pair: ImpactPair, states: State, over: Any, periods: Any):
    """Take a tile of balls some steps on: where they are, which have arrived, the steps, which of these are real."""

    def one(carry, _):
        state, over = carry
        left = jnp.where(over, 0.0, 2.0 * (periods - state.n).astype(state.t.dtype) - state.t)
        out = jax.vmap(exact.step)(pair, state, left)
        ends = over | out.quiet | out.permanent | (left <= 0) | (out.impact.n >= periods)
        after = jax.tree.map(lambda new, old: jnp.where(ends, old, new), out.state, state)
        return (after, ends), (_Step(state, out), ~over & (left > 0))

    return lax.scan(one, (states, over), None, length=_STEPS)


def _advance(pair: ImpactPair, states: State, periods: int) -> tuple[State, np.ndarray, _Step, np.ndarray]:
    """Take balls some steps on: where they are, which have arrived, the steps [ball, step], which of these are real."""
    parts = []
    for tile in tiles.tiles(states.u.size, (_TILE,)):
        own, begun = jax.tree.map(lambda x, rows=tile.rows: x[rows], (pair, states))
        idle = np.arange(_TILE) >= tile.real
        (after, over), (steps, real) = _some_steps(own, begun, idle, np.int32(periods))
        steps, real = jax.tree.map(lambda x: np.asarray(x).swapaxes(0, 1), (steps, real))
        parts.append(jax.tree.map(lambda x, real=tile.real: np.asarray(x)[:real], (after, over, steps, real)))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _impacts(ball: np.ndarray, steps: Any, count: int, periods: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Pick the impacts among the steps, as a padded table."""
    if steps is None:
        return {name: np.full((count, 0), np.nan) for name in _KEPT}, np.zeros(count, int)
    impact = steps.out.impact
    real = (impact.side != 0) & (impact.n >= 0) & (impact.n < periods) & ~steps.out.permanent
    ball = ball[real]
    filled = np.bincount(ball, minlength=count)
    place = np.arange(ball.size) - (np.cumsum(filled) - filled)[ball]
    table = {}
    for name in _KEPT:
        table[name] = np.full((count, filled.max()), np.nan)
        table[name][ball, place] = getattr(impact, name)[real]
    return table, filled


def _strobes(pair: ImpactPair, ball: np.ndarray, steps: Any, count: int, periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the balls at phase 0 of every period: in the last step that began before."""
    u, v = (np.full((count, periods), np.nan) for _ in range(2))
    if steps is None:
        return u, v
    flown = np.unique(ball)
    cell, period = (x.ravel() for x in np.meshgrid(flown, np.arange(1, periods + 1), indexing="ij"))
    clock = 2.0 * steps.begun.n + steps.begun.t
    # One ascending key of all balls: their clocks one after another.
    apart = 2.0 * (clock.max() - clock.min() + 2 * periods)
    index = np.searchsorted(ball * apart + clock, cell * apart + 2.0 * period, side="right") - 1
    when = 2.0 * (period - steps.begun.n[index]) - steps.begun.t[index]
    for some, _ in tiles.tiles(cell.size, (_STROBES,)):
        taken = jax.tree.map(lambda x, some=some: x[index[some]], steps)
        own = jax.tree.map(lambda x, some=some: x[cell[some]], pair)
        at = balls_at((own, taken.begun, taken.out, when[some]))[:2]
        u[cell[some], period[some] - 1], v[cell[some], period[some] - 1] = (np.asarray(x) for x in at)
    return u, v
