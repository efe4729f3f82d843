"""All impacts within a number of periods, and the ball at phase 0 of each period, for many balls at once."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vijax.impact.exact import exact_step
from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.gravity_regime import GravityRegime, gravity_regime_of
from vijax.impact.impact import BallState
from vijax.impact.method import Method
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.runtime import tiles
from vijax.runtime.arrays import not_none
from vijax.runtime.compilation.programs import jitted
from vijax.simulation.exact_run import balls_at
from vijax.simulation.trajectory import complete_trajectory

# Sizes of compiled calls: number of balls that one call simulates, number of balls that one call computes at phase 0,
# and number of steps of a call, after which finished balls are removed. No result depends on these sizes: smaller ones
# need more calls, larger ones compute more unused rows.
_TILE, _STROBES, _STEPS = 256, 4096, 16


class ImpactLog(NamedTuple):
    """Impacts and stroboscopic states of every ball, in order.

    Attributes:
        impacts: By name, [ball, impact], NaN beyond `filled`: `n` (period, from 0), `t` (phase of the onset), `side`,
            `v_in`, `v_out` (signed), `duration`, `depth` and `work` (for a rigid wall, depth and work are computed for
            kappa = 1).
        filled: Number of impacts of each ball.
        u, v: The ball at phase 0 of periods 1 ... periods, [ball, period]; NaN for balls that are not simulated.
    """

    impacts: dict[str, np.ndarray]
    filled: np.ndarray
    u: np.ndarray
    v: np.ndarray


_FIELDS = ("n", "t", "side", "v_in", "v_out", "duration", "depth", "work")


class _Step(NamedTuple):
    """One step of a ball: its start and its outcome."""

    start: State
    out: exact_step.ExactResult


def record_impacts(pair: ImpactPair, starts: State, periods: int, selected: np.ndarray) -> ImpactLog:
    """Simulate balls for `periods` periods: more than 256 by the fast step with a fallback, fewer by the exact step.

    Args:
        pair: Cells [ball]; `kappa=None` for rigid walls.
        starts: Start of each ball, in flight or in contact; n < 0 if it starts before the first period.
        periods: Number of recorded periods.
        selected: True for balls to be simulated.

    Returns:
        The record. Impacts with an onset before period 0 or after the last period are omitted.
    """
    pair, starts = jax.tree.map(np.asarray, (pair, starts))
    count = starts.u.size
    active, states = np.flatnonzero(selected), jax.tree.map(lambda x: x[selected], starts)
    # If all balls fit in one call, only the exact step is used, because it takes less time than the compilation of the
    # fast step.
    many = gravity_regime_of(pair.gamma) if active.size > _TILE else None
    ball_parts: list[np.ndarray] = [np.zeros(0, int)]
    parts: list[_Step] = []

    def advance(balls_of: np.ndarray, at: State, steps: int, gravity_regime: GravityRegime | None) -> _BallStates:
        ball_states, step_rows, real = _advance(
            jax.tree.map(lambda x: x[balls_of], pair), at, periods, steps, gravity_regime
        )
        ball_parts.append(np.repeat(balls_of, steps)[real.ravel()])
        parts.append(jax.tree.map(lambda x: x[real], step_rows))
        return ball_states

    while active.size:
        states, over, waiting = advance(active, states, _STEPS, many)
        if waiting.any():
            after_fallback = advance(
                active[waiting], jax.tree.map(lambda x, waiting=waiting: x[waiting], states), 1, None
            )
            states = jax.tree.map(partial(tiles.with_replaced_rows, waiting), states, after_fallback.state)
            over = tiles.with_replaced_rows(waiting, over, after_fallback.over)
        active, states = active[~over], jax.tree.map(lambda x, over=over: x[~over], states)
    ball = np.concatenate(ball_parts)
    order = np.argsort(ball, kind="stable")
    ball = ball[order]
    steps = jax.tree.map(lambda *x: np.concatenate(x)[order], *parts) if parts else None
    return ImpactLog(*_impacts(ball, steps, count, periods), *_strobes(pair, ball, steps, count, periods))


def record_stepped(method: Method, pair: ImpactPair, starts: State, periods: int, selected: np.ndarray) -> ImpactLog:
    """Do the work of `record_impacts` by a stepping method with a forcing that repeats every period."""
    pair, starts = jax.tree.map(np.asarray, (pair, starts))
    # Shift all starts by `early` periods so that no period is negative.
    count, early = starts.u.size, max(int(-starts.n.min()), 0)
    pairs = jax.tree.map(lambda x: x[selected], pair)
    path = None
    if selected.any():
        t = 2.0 * (starts.n[selected] + early) + starts.t[selected]
        run = complete_trajectory(pairs, starts.u[selected], starts.v[selected], periods + early, t, method=method)
        path = jax.tree.map(np.asarray, run)
    table = {name: np.full((count, 0), np.nan) for name in _FIELDS}
    filled, u, v = np.zeros(count, int), *(np.full((count, periods), np.nan) for _ in range(2))
    if path is None:
        return ImpactLog(table, filled, u, v)
    real = (np.arange(path.impacts.n.shape[1]) < path.filled[:, None]) & (path.impacts.n >= early)
    order = np.argsort(~real, axis=1, kind="stable")[:, : real.sum(axis=1).max()]
    filled[selected] = real.sum(axis=1)
    for name in table:
        values = np.where(real, getattr(path.impacts, name) - (early if name == "n" else 0), np.nan)
        table[name] = np.full((count, order.shape[1]), np.nan)
        table[name][selected] = np.take_along_axis(values, order, axis=1)
    u[selected], v[selected] = path.states.u[:, early:], path.states.v[:, early:]
    return ImpactLog(table, filled, u, v)


class _BallStates(NamedTuple):
    """States of balls; `over` is True for finished balls, `waiting` for balls that await the robust fallback."""

    state: State
    over: Any
    waiting: Any


@partial(jitted, often=True, static=("steps", "gravity_regime"))
def _advance_tile(
    pair: ImpactPair, states: State, over: Any, periods: Any, *, steps: int, gravity_regime: GravityRegime | None
):
    """Advance a tile of balls; return the `_BallStates`, the steps, and a mask of the steps that were taken.

    Args:
        pair, states, over: Cells, states, and mask of the balls that have finished.
        periods: Number of recorded periods.
        steps: Number of steps.
        gravity_regime: Range of gamma for the fast step; None to use the exact step (robust fallback) instead.
    """
    walls = None if gravity_regime is None else fast_walls.prepare_walls(pair, gravity_regime=gravity_regime)

    def step(reached: _BallStates, _):
        state, over, waiting = reached
        horizon = jnp.where(over, 0.0, 2.0 * (periods - state.n).astype(state.t.dtype) - state.t)
        is_active = ~over & (horizon > 0)
        if walls is None:
            out, certified = jax.vmap(exact_step.step)(pair, state, horizon), jnp.ones_like(over)
        else:
            out, certified = _fast_result(walls, pair, state)
        waiting = waiting | (is_active & ~certified)
        ends = ~waiting & (~is_active | out.no_impact | out.permanent | (out.impact.n >= periods))
        unchanged = over | ends | waiting
        after = jax.tree.map(lambda new, old: jnp.where(unchanged, old, new), out.state, state)
        return _BallStates(after, over | ends, waiting), (_Step(state, out), is_active & ~waiting)

    return lax.scan(step, _BallStates(states, over, jnp.zeros_like(over)), None, length=steps)


def _fast_result(walls: fast_walls.TwoWalls, pair: ImpactPair, state: State) -> tuple[exact_step.ExactResult, Any]:
    """Advance balls by one impact with the fast step; also return the mask of certified results."""
    ball = BallState(state.u, state.v, state.t, state.n.astype(state.t.dtype))
    impact, _, certified, _ = fast_step.fast_step(walls, pair.gamma, ball, deep=True, work=True)
    after, integer, no = impact.after, state.n.dtype, jnp.zeros_like(certified)
    impact_record = Impact(
        n=impact.onset_n.astype(integer),
        t=impact.onset_t,
        side=impact.side.astype(integer),
        v_in=impact.v_in,
        v_out=impact.v_out,
        depth=not_none(impact.depth),
        duration=impact.duration,
        work=not_none(impact.work),
    )
    after_state = State(after.u, after.v, after.t, after.n.astype(integer), jnp.zeros_like(state.mode))
    return exact_step.ExactResult(after_state, impact_record, impact.flight, impact.duration, no, no, no), certified & (
        state.mode == 0
    )


def _advance(
    pair: ImpactPair, states: State, periods: int, steps: int, gravity_regime: GravityRegime | None
) -> tuple[_BallStates, _Step, np.ndarray]:
    """Advance balls; return the `_BallStates`, the steps [ball, step], and a mask of the steps that were taken."""
    parts = []
    for tile in tiles.tiles(states.u.size, (_TILE,)):
        pairs, start = jax.tree.map(lambda x, rows=tile.rows: x[rows], (pair, states))
        is_padding = np.arange(_TILE) >= tile.real
        reached, step_rows = _advance_tile(
            pairs, start, is_padding, np.int32(periods), steps=steps, gravity_regime=gravity_regime
        )
        step_rows = jax.tree.map(lambda x: np.asarray(x).swapaxes(0, 1), step_rows)
        parts.append(jax.tree.map(lambda x, real=tile.real: np.asarray(x)[:real], (reached, *step_rows)))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _impacts(ball: np.ndarray, steps: Any, count: int, periods: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the impacts as tables [ball, impact], padded by NaN, and the number of impacts of each ball."""
    if steps is None:
        return {name: np.full((count, 0), np.nan) for name in _FIELDS}, np.zeros(count, int)
    impact = steps.out.impact
    is_impact = (impact.side != 0) & (impact.n >= 0) & (impact.n < periods) & ~steps.out.permanent
    ball = ball[is_impact]
    filled = np.bincount(ball, minlength=count)
    # Position of each impact within its ball's row.
    place = np.arange(ball.size) - (np.cumsum(filled) - filled)[ball]
    table = {}
    for name in _FIELDS:
        table[name] = np.full((count, filled.max()), np.nan)
        table[name][ball, place] = getattr(impact, name)[is_impact]
    return table, filled


def _strobes(pair: ImpactPair, ball: np.ndarray, steps: Any, count: int, periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u and v at phase 0 of every period, [ball, period], each from the last step that began earlier."""
    u, v = (np.full((count, periods), np.nan) for _ in range(2))
    if steps is None:
        return u, v
    balls = np.unique(ball)
    cell, period = (x.ravel() for x in np.meshgrid(balls, np.arange(1, periods + 1), indexing="ij"))
    clock = 2.0 * steps.start.n + steps.start.t
    # One ascending key for all balls, so that one search serves all: the times of ball b are shifted by b * key_step,
    # and key_step exceeds the range of all times.
    key_step = 2.0 * (clock.max() - clock.min() + 2 * periods)
    index = np.searchsorted(ball * key_step + clock, cell * key_step + 2.0 * period, side="right") - 1
    when = 2.0 * (period - steps.start.n[index]) - steps.start.t[index]
    for rows, _ in tiles.tiles(cell.size, (_STROBES,)):
        last_steps = jax.tree.map(lambda x, rows=rows: x[index[rows]], steps)
        pairs = jax.tree.map(lambda x, rows=rows: x[cell[rows]], pair)
        at = balls_at((pairs, last_steps.start, last_steps.out, when[rows]))[:2]
        u[cell[rows], period[rows] - 1], v[cell[rows], period[rows] - 1] = (np.asarray(x) for x in at)
    return u, v
