"""The motion of single starts, impact by impact: recorded, sampled at phase 0, differentiable both ways."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from vijax.batch.exact_run import exact_run
from vijax.batch.run_records import CHUNK, Asked, Room, Trajectory
from vijax.batch.stepped_run import stepped_run
from vijax.engine.method import Method
from vijax.engine.method_choice import choose
from vijax.model import units
from vijax.model.choices import MethodName, Periods, SolverName
from vijax.model.excitation import Excitation, check_excitation, counted
from vijax.model.membrane import Laws, Linear, check_restitution, of_pair
from vijax.model.pair import ImpactPair, check_pair, check_start
from vijax.model.records import Status
from vijax.runtime import checks, tiles
from vijax.runtime.context import door
from vijax.runtime.derivatives import differentiable_rows

_STARTS = {"u0": "displacement", "v0": "velocity", "t0": "phase"}
_IMPACT, _STATE = 56, 32  # bytes of a record: what a run asks of memory is told from them before it begins
# Starts fly together in calls of few sizes, so that few programs are compiled.
_TILES = (1, 8, 64, 512, 4096)
# The records of so few starts have room for so many periods at least: one program serves all shorter runs.
_FEW, _ROOMS = 64, (64, 512)
# Impacts a period that `complete_trajectory` records at most. A ball that chatters on a rigid wall has about 40 of
# them; more room costs 56 bytes an impact.
_MOST_IMPACTS = 256

_exact_traced = differentiable_rows(exact_run, tuple(size for size in _TILES if size <= _FEW))


def _precision(pair: ImpactPair) -> str:
    return str(jnp.result_type(float, pair.d))


def _told(pair: ImpactPair, method: Any, options: Mapping[str, Any], excitation: Excitation | None) -> Method | None:
    """Take the method as it is, or as `choose` makes it of a name, if the pair suits its membrane."""
    if not isinstance(method, Method):
        method = choose(method, options, wall=pair.walls, dtype=_precision(pair), excitation=excitation)
    elif excitation is not None:
        raise ValueError(f"excitation must be left out with a method of your own; got {checks.shown(excitation)}")
    check_restitution(pair, Linear() if method is None else of_pair(method.law))
    return method


def _check_starts(pair: ImpactPair, periods: int, starts: dict[str, Any]) -> tuple[Any, ...]:
    """Return the starts, lists as arrays; raise ValueError unless the ball can start there. Traced ones pass unseen."""
    starts = {name: units.given(_STARTS[name], start, name) for name, start in starts.items()}
    check_start(pair, "u0", starts["u0"])
    if checks.is_concrete(starts["t0"]):
        t0 = np.asarray(starts["t0"])
        good = (t0 >= 0) & (t0 < 2 * periods)
        if not good.all():
            raise ValueError(f"t0 must lie in [0, 2 periods), here [0, {2 * periods}); got {checks.first(t0, good)}")
    return tuple(starts.values())


@door
def trajectory(
    pair: ImpactPair,
    u0: ArrayLike | Sequence[float],
    v0: ArrayLike | Sequence[float],
    periods: Periods,
    t0: ArrayLike | Sequence[float] = 0.0,
    *,
    max_impacts: int | None = None,
    method: MethodName | Method = "exact",
    solver: SolverName | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    membrane: Laws | None = None,
    friction: float | None = None,
    steps: int | None = None,
    excitation: Excitation | None = None,
) -> Trajectory:
    """Follow one start, or an array of starts, for a number of forcing periods.

    Args:
        pair: One cell, or arrays that broadcast against the starts.
        u0, v0: Displacement and velocity at time t0.
        periods: The motion is followed to t = 2 periods; "all" of a record that ends.
        t0: Time of the start, in [0, 2 periods).
        max_impacts: Room for impacts; 16 a period and 16 more unless given.
        method: "exact", "ode" or "rk4", as in `sweep`; or a `vijax.engine.method.Method`.
        solver, rtol, atol, membrane, friction, steps: As in `sweep`. The pair's r is None with a membrane
            that takes none, as `HuntCrossley`. Numbers of the membrane are in the units of the pair, as
            `law.nondimensional(device)` gives them.
        excitation: What shakes the capsule, as in `sweep`, in the units of the pair: `record.waveform(device)` for a
            `Record`. The sine unless given.

    Returns:
        The `Trajectory`. Differentiable in pair and start, forward and reverse, by a scan of bounded length. The exact
        engine to any order; "ode" once, as the lengths of its steps are constants to a derivative; "rk4" not
        usefully, as its derivatives miss the jump at the wall.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    options = {"solver": solver, "rtol": rtol, "atol": atol, "membrane": membrane, "friction": friction, "steps": steps}
    periods = counted(periods, check_excitation(excitation, 0))
    told = _told(check_pair(pair), method, options, check_excitation(excitation, periods))
    room = _most(periods) if max_impacts is None else checks.whole("max_impacts", max_impacts, 1)
    u0, v0, t0 = _check_starts(pair, periods, {"u0": u0, "v0": v0, "t0": t0})
    count = math.prod(checks.shapes(u0=u0, v0=v0, t0=t0, pair=pair.d))
    checks.fits(("periods", "max_impacts"), count * (room * _IMPACT + periods * _STATE), "impacts and states")
    found, shape = _followed(told, pair, (u0, v0, t0), periods, max_impacts)
    return _cut(found, shape, periods, room)


def complete_trajectory(
    pair: ImpactPair,
    u0: ArrayLike,
    v0: ArrayLike,
    periods: int,
    t0: ArrayLike = 0.0,
    *,
    method: MethodName | Method = "exact",
    excitation: Excitation | None = None,
) -> Trajectory:
    """Follow starts as `trajectory` does, and again with more room until every impact is recorded.

    Args:
        pair, u0, v0, periods, t0, method, excitation: As in `trajectory`; numbers, not traced.

    Returns:
        The `Trajectory`; status EVENT_BUDGET only beyond `_MOST_IMPACTS` impacts a period.
    """
    run = trajectory(pair, u0, v0, periods, t0, method=method, excitation=excitation)
    room = _most(periods)
    while room < _MOST_IMPACTS * periods and (np.asarray(run.status) == Status.EVENT_BUDGET).any():
        room = min(4 * room, _MOST_IMPACTS * periods)
        run = trajectory(pair, u0, v0, periods, t0, max_impacts=room, method=method, excitation=excitation)
    return run


def _followed(
    method: Method | None, pair: ImpactPair, starts: tuple, periods: int, max_impacts: int | None
) -> tuple[Trajectory, tuple[int, ...]]:
    """Follow all starts as rows, records padded; give the trajectories, and the shape that the starts have."""
    dtype, own = jnp.result_type(pair.d), tiles.library((pair, starts))
    shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves((pair, starts))))
    rows = jax.tree.map(lambda x: own.broadcast_to(own.asarray(x, dtype), shape).reshape(-1), (pair, starts))
    most = _most(periods) if max_impacts is None else max_impacts
    chunks = 0 if method is None else -(-method.most_steps(pair, periods, most) // CHUNK)
    counts: Any = (np.int32(count) for count in (periods, most, chunks))
    asked = Asked(*counts)
    if method is None and own is np:
        work = partial(exact_run, asked, room=Room(periods, most, chunks))
    elif method is None:
        work = partial(_exact_traced, asked, room=_room(periods, max_impacts, tiles.padded(chunks)))
    else:
        numbers = tiles.library((pair, starts, method)) is np
        few = numbers and math.prod(shape) <= _FEW
        room = _room(periods, max_impacts, None if numbers else tiles.padded(chunks), few=few)
        method = jax.tree.map(lambda x: jnp.asarray(x, dtype), method)
        work = partial(stepped_run, asked, method, room=room)
    return tiles.map_tiles(lambda row: work(row[0], *row[1]), rows, _TILES), shape


def _room(periods: int, max_impacts: int | None, chunks: int | None, *, few: bool = False) -> Room:
    """Make room for twice what is asked for at most, as derivatives remember all of it; of few numbers for more."""
    for size in _ROOMS if few else ():
        if periods <= size and (max_impacts or 0) <= _most(size):
            return Room(size, _most(size), chunks)
    wide = tiles.padded(periods)
    return Room(wide, _most(wide) if max_impacts is None else tiles.padded(max_impacts), chunks)


def _most(periods: int) -> int:
    """Say for how many impacts there is room in so many periods, unless something else is asked for."""
    return 16 * periods + 16


def _cut(found: Trajectory, shape: tuple[int, ...], periods: int, max_impacts: int) -> Trajectory:
    """Leave out what lies beyond the numbers asked for, and give the rest the shape of the starts."""

    def shaped(leaf, width=None):
        return leaf.reshape(shape + leaf.shape[1:])[..., :width] if leaf.ndim > 1 else leaf.reshape(shape)

    impacts, states = (
        jax.tree.map(partial(shaped, width=width), part)
        for part, width in ((found.impacts, max_impacts), (found.states, periods))
    )
    impacts, states = (
        _padded_by_constants(impacts, impacts.side != 0),
        _padded_by_constants(states, states.u == states.u),
    )
    return tiles.arrays(Trajectory(impacts, shaped(found.filled), states, shaped(found.status)))


def _padded_by_constants(records: Any, real: Any) -> Any:
    """Return records whose padding is the constant NaN to a derivative.

    The derivative of a sum that masks the padding holds 0 times NaN there, which goes no further than this.
    """
    if tiles.library(records) is np:
        return records
    return jax.tree.map(lambda x: jnp.where(real, x, jnp.nan) if x.dtype.kind == "f" else x, records)
