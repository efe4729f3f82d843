"""Every impact of a stretch of periods, and the ball at phase 0 in between, of many balls at once."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vijax.batch.exact_run import balls_at
from vijax.batch.trajectory import complete_trajectory
from vijax.engine import exact, quick, quick_wall
from vijax.engine.ground import Ground, ground_of
from vijax.engine.impact import Ball
from vijax.engine.method import Method
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.runtime import tiles
from vijax.runtime.arrays import present
from vijax.runtime.programs import jitted

# No result depends on these: how many balls fly together, how many at phase 0 are found together, and after how many
# impacts of each those that have arrived make room. Fewer are more calls, more are more rows that nobody needs.
_TILE, _STROBES, _STEPS = 256, 4096, 16


class ImpactLog(NamedTuple):
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


def record(pair: ImpactPair, starts: State, periods: int, wanted: np.ndarray) -> ImpactLog:
    """Fly balls to the end of some periods: many by the quick step, and what it declines by the careful one.

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
    # A single call of balls takes the careful step alone, which costs less than to compile another.
    many = ground_of(pair.gamma) if live.size > _TILE else None
    balls: list[np.ndarray] = [np.zeros(0, int)]
    parts: list[_Step] = []

    def onward(some: np.ndarray, at: State, steps: int, ground: Ground | None) -> _Underway:
        reached, taken, real = _advance(jax.tree.map(lambda x: x[some], pair), at, periods, steps, ground)
        balls.append(np.repeat(some, steps)[real.ravel()])
        parts.append(jax.tree.map(lambda x: x[real], taken))
        return reached

    while live.size:
        states, over, waits = onward(live, states, _STEPS, many)
        if waits.any():
            served = onward(live[waits], jax.tree.map(lambda x, waits=waits: x[waits], states), 1, None)
            states = jax.tree.map(partial(tiles.replaced, waits), states, served.state)
            over = tiles.replaced(waits, over, served.over)
        live, states = live[~over], jax.tree.map(lambda x, over=over: x[~over], states)
    ball = np.concatenate(balls)
    order = np.argsort(ball, kind="stable")
    ball = ball[order]
    flown = jax.tree.map(lambda *x: np.concatenate(x)[order], *parts) if parts else None
    return ImpactLog(*_impacts(ball, flown, count, periods), *_strobes(pair, ball, flown, count, periods))


def record_stepped(method: Method, pair: ImpactPair, starts: State, periods: int, wanted: np.ndarray) -> ImpactLog:
    """Do what `record` does, by a method that steps and whose forcing repeats every period."""
    pair, starts = jax.tree.map(np.asarray, (pair, starts))
    count, early = starts.u.size, max(int(-starts.n.min()), 0)
    some = jax.tree.map(lambda x: x[wanted], pair)
    path = None
    if wanted.any():
        t = 2.0 * (starts.n[wanted] + early) + starts.t[wanted]
        flown = complete_trajectory(some, starts.u[wanted], starts.v[wanted], periods + early, t, method=method)
        path = jax.tree.map(np.asarray, flown)
    table = {name: np.full((count, 0), np.nan) for name in _KEPT}
    filled, u, v = np.zeros(count, int), *(np.full((count, periods), np.nan) for _ in range(2))
    if path is None:
        return ImpactLog(table, filled, u, v)
    real = (np.arange(path.impacts.n.shape[1]) < path.filled[:, None]) & (path.impacts.n >= early)
    order = np.argsort(~real, axis=1, kind="stable")[:, : real.sum(axis=1).max()]
    filled[wanted] = real.sum(axis=1)
    for name in table:
        values = np.where(real, getattr(path.impacts, name) - (early if name == "n" else 0), np.nan)
        table[name] = np.full((count, order.shape[1]), np.nan)
        table[name][wanted] = np.take_along_axis(values, order, axis=1)
    u[wanted], v[wanted] = path.states.u[:, early:], path.states.v[:, early:]
    return ImpactLog(table, filled, u, v)


class _Underway(NamedTuple):
    """Where balls are, which of them have arrived, and which wait for the careful step."""

    state: State
    over: Any
    waits: Any


@partial(jitted, often=True, static=("steps", "ground"))
def _fly(pair: ImpactPair, states: State, over: Any, periods: Any, *, steps: int, ground: Ground | None):
    """Take a tile of balls some steps on: the `_Underway`, the steps, which of these are real.

    Args:
        steps: How many.
        ground: For the quick step on such ground; by the careful one where it is None.
    """
    walls = None if ground is None else quick_wall.prepare(pair, ground=ground)

    def one(reached: _Underway, _):
        state, over, waits = reached
        left = jnp.where(over, 0.0, 2.0 * (periods - state.n).astype(state.t.dtype) - state.t)
        wanted = ~over & (left > 0)
        if walls is None:
            out, sure = jax.vmap(exact.step)(pair, state, left), jnp.ones_like(over)
        else:
            out, sure = _quick_outcome(walls, pair, state)
        waits = waits | (wanted & ~sure)
        ends = ~waits & (~wanted | out.quiet | out.permanent | (out.impact.n >= periods))
        stays = over | ends | waits
        after = jax.tree.map(lambda new, old: jnp.where(stays, old, new), out.state, state)
        return _Underway(after, over | ends, waits), (_Step(state, out), wanted & ~waits)

    return lax.scan(one, _Underway(states, over, jnp.zeros_like(over)), None, length=steps)


def _quick_outcome(walls: quick_wall.TwoWalls, pair: ImpactPair, state: State) -> tuple[exact.Outcome, Any]:
    """Take balls one impact on by the quick step; say of which it is sure."""
    ball = Ball(state.u, state.v, state.t, state.n.astype(state.t.dtype))
    impact, _, sure, _ = quick.quick_step(walls, pair.gamma, ball, deep=True, work=True)
    after, whole, no = impact.after, state.n.dtype, jnp.zeros_like(sure)
    told = Impact(
        n=impact.onset_n.astype(whole),
        t=impact.onset_t,
        side=impact.side.astype(whole),
        v_in=impact.v_in,
        v_out=impact.v_out,
        depth=present(impact.depth),
        duration=impact.duration,
        work=present(impact.work),
    )
    then = State(after.u, after.v, after.t, after.n.astype(whole), jnp.zeros_like(state.mode))
    return exact.Outcome(then, told, impact.flight, impact.duration, no, no, no), sure & (state.mode == 0)


def _advance(
    pair: ImpactPair, states: State, periods: int, steps: int, ground: Ground | None
) -> tuple[_Underway, _Step, np.ndarray]:
    """Take balls some steps on: the `_Underway`, the steps [ball, step], which of these are real."""
    parts = []
    for tile in tiles.tiles(states.u.size, (_TILE,)):
        own, begun = jax.tree.map(lambda x, rows=tile.rows: x[rows], (pair, states))
        idle = np.arange(_TILE) >= tile.real
        reached, taken = _fly(own, begun, idle, np.int32(periods), steps=steps, ground=ground)
        taken = jax.tree.map(lambda x: np.asarray(x).swapaxes(0, 1), taken)
        parts.append(jax.tree.map(lambda x, real=tile.real: np.asarray(x)[:real], (reached, *taken)))
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
