"""Trajectories of single starts: every impact and the states at phase 0; differentiable forward and in reverse."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from vijax.impact.method import Method
from vijax.impact.method_choice import choose_method
from vijax.model import units
from vijax.model.choices import MethodName, Periods, SolverName
from vijax.model.forcing.excitation import Excitation, check_run_excitation, count_periods
from vijax.model.pair import ImpactPair, check_pair, check_start
from vijax.model.records import Status
from vijax.model.walls.membrane import Laws, Linear, check_pair_units, check_restitution
from vijax.runtime import tiles, validation
from vijax.runtime.numerics.derivatives import differentiable_rows
from vijax.runtime.public_api import public_api
from vijax.simulation.exact_run import exact_run
from vijax.simulation.run_records import CHUNK, Capacity, RunLimits, Trajectory
from vijax.simulation.stepped_run import stepped_run

_STARTS = {"u0": "displacement", "v0": "velocity", "t0": "phase"}
_IMPACT, _STATE = 56, 32  # bytes of an impact and of a state, to check the memory before a run
# Numbers of starts in a compiled call; there are few, so that few programs are compiled.
_TILES = (1, 8, 64, 512, 4096)
# For up to _FEW starts the records hold at least 64 (or 512) periods, so that one program serves all shorter runs.
_FEW, _CAPACITY_PERIODS = 64, (64, 512)
# Greatest number of impacts per period that `complete_trajectory` records. A ball that chatters on a rigid wall has
# about 40; each recorded impact costs 56 bytes.
_MAX_IMPACT_RATE = 256

_exact_traced = differentiable_rows(exact_run, tuple(size for size in _TILES if size <= _FEW))


def _precision(pair: ImpactPair) -> str:
    return str(jnp.result_type(float, pair.d))


def _resolve_method(
    pair: ImpactPair, method: Any, options: Mapping[str, Any], excitation: Excitation | None
) -> Method | None:
    """Return the method, as specified or chosen by name; raise ValueError unless the membrane suits the pair's r."""
    if not isinstance(method, Method):
        method = choose_method(method, options, wall=pair.walls, dtype=_precision(pair), excitation=excitation)
    elif excitation is not None:
        raise ValueError(
            f"excitation must be left out with a method of your own; got {validation.value_text(excitation)}"
        )
    check_restitution(pair, Linear() if method is None else check_pair_units(method.law))
    return method


def _check_starts(pair: ImpactPair, periods: int, starts: dict[str, Any]) -> tuple[Any, ...]:
    """Return the starts, with lists converted to arrays; raise ValueError unless the ball can start there.

    Traced starts are not checked.
    """
    starts = {name: units.validate_quantity(_STARTS[name], start, name) for name, start in starts.items()}
    check_start(pair, "u0", starts["u0"])
    if validation.is_concrete(starts["t0"]):
        t0 = np.asarray(starts["t0"])
        is_valid = (t0 >= 0) & (t0 < 2 * periods)
        if not is_valid.all():
            raise ValueError(
                f"t0 must lie in [0, 2 periods), here [0, {2 * periods}); got {validation.first_invalid(t0, is_valid)}"
            )
    return tuple(starts.values())


@public_api
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
    """Compute the motion from one start, or from an array of starts, for a number of forcing periods.

    Args:
        pair: One cell, or arrays that broadcast against the starts.
        u0, v0: Displacement and velocity at time t0.
        periods: Number of forcing periods; the motion is computed to the time t = 2 * periods. "all": all periods of a
            record that ends.
        t0: Time of the start, in [0, 2 periods).
        max_impacts: Greatest number of recorded impacts; 16 per period and 16 more by default.
        method: "exact", "ode" or "rk4", as in `sweep`; or a `vijax.impact.method.Method`.
        solver, rtol, atol, membrane, friction, steps: As in `sweep`. The pair's r is None with a membrane that has no
            restitution, such as `HuntCrossley`. The numbers of the membrane are in the units of the pair, as
            `law.nondimensional(device)` returns them.
        excitation: Acceleration of the capsule, as in `sweep`, in the units of the pair: `record.waveform(device)` for
            a `Record`. The sine by default.

    Returns:
        The `Trajectory`. It is differentiable in pair and start, forward and in reverse, by a scan of bounded length.
        "exact" is differentiable to any order; "ode" once, as derivatives treat its step sizes as constants; "rk4" has
        no useful derivatives, as they miss the jump at the wall.

    Raises:
        ValueError: If an argument is invalid; the message states the requirement and the value.
    """
    options = {"solver": solver, "rtol": rtol, "atol": atol, "membrane": membrane, "friction": friction, "steps": steps}
    periods = count_periods(periods, check_run_excitation(excitation, 0))
    resolved = _resolve_method(check_pair(pair), method, options, check_run_excitation(excitation, periods))
    recorded_impacts = (
        _default_impacts(periods) if max_impacts is None else validation.validate_integer("max_impacts", max_impacts, 1)
    )
    u0, v0, t0 = _check_starts(pair, periods, {"u0": u0, "v0": v0, "t0": t0})
    count = math.prod(validation.broadcast_shape(u0=u0, v0=v0, t0=t0, pair=pair.d))
    validation.check_memory(
        ("periods", "max_impacts"), count * (recorded_impacts * _IMPACT + periods * _STATE), "impacts and states"
    )
    run, shape = _simulate_rows(resolved, pair, (u0, v0, t0), periods, max_impacts)
    return _cut(run, shape, periods, recorded_impacts)


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
    """Compute trajectories as `trajectory` does; increase `max_impacts` until every impact is recorded.

    Args:
        pair, u0, v0, periods, t0, method, excitation: As in `trajectory`; numbers, not traced.

    Returns:
        The `Trajectory`; its status is EVENT_BUDGET only beyond `_MAX_IMPACT_RATE` impacts per period.
    """
    run = trajectory(pair, u0, v0, periods, t0, method=method, excitation=excitation)
    recorded_impacts = _default_impacts(periods)
    while recorded_impacts < _MAX_IMPACT_RATE * periods and (np.asarray(run.status) == Status.EVENT_BUDGET).any():
        recorded_impacts = min(4 * recorded_impacts, _MAX_IMPACT_RATE * periods)
        run = trajectory(pair, u0, v0, periods, t0, max_impacts=recorded_impacts, method=method, excitation=excitation)
    return run


def _simulate_rows(
    method: Method | None, pair: ImpactPair, starts: tuple, periods: int, max_impacts: int | None
) -> tuple[Trajectory, tuple[int, ...]]:
    """Compute all starts as rows with padded records; return the trajectories, and the shape of the starts."""
    dtype, library = jnp.result_type(pair.d), tiles.array_namespace((pair, starts))
    shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves((pair, starts))))
    rows = jax.tree.map(lambda x: library.broadcast_to(library.asarray(x, dtype), shape).reshape(-1), (pair, starts))
    recorded_impacts = _default_impacts(periods) if max_impacts is None else max_impacts
    chunks = 0 if method is None else -(-method.most_steps(pair, periods, recorded_impacts) // CHUNK)
    counts: Any = (np.int32(count) for count in (periods, recorded_impacts, chunks))
    limits = RunLimits(*counts)
    # Concrete numbers with the exact engine need no loop of bounded length; traced values need one, for derivatives.
    if method is None and library is np:
        work = partial(exact_run, limits, capacity=Capacity(periods, recorded_impacts, chunks))
    elif method is None:
        work = partial(_exact_traced, limits, capacity=_capacity(periods, max_impacts, tiles.padded(chunks)))
    else:
        numbers = tiles.array_namespace((pair, starts, method)) is np
        is_small = numbers and math.prod(shape) <= _FEW
        capacity = _capacity(periods, max_impacts, None if numbers else tiles.padded(chunks), is_small=is_small)
        method = jax.tree.map(lambda x: jnp.asarray(x, dtype), method)
        work = partial(stepped_run, limits, method, capacity=capacity)
    return tiles.map_tiles(lambda row: work(row[0], *row[1]), rows, _TILES), shape


def _capacity(periods: int, max_impacts: int | None, chunks: int | None, *, is_small: bool = False) -> Capacity:
    """Return the capacities of the records.

    They are at most twice the limits, because derivatives store records at full capacity. For few starts that are
    concrete numbers (`is_small`), the capacities are fixed and may be larger, so that one program serves many runs.
    """
    for size in _CAPACITY_PERIODS if is_small else ():
        if periods <= size and (max_impacts or 0) <= _default_impacts(size):
            return Capacity(size, _default_impacts(size), chunks)
    wide = tiles.padded(periods)
    return Capacity(wide, _default_impacts(wide) if max_impacts is None else tiles.padded(max_impacts), chunks)


def _default_impacts(periods: int) -> int:
    """Return the default number of recorded impacts for a number of periods."""
    return 16 * periods + 16


def _cut(run: Trajectory, shape: tuple[int, ...], periods: int, max_impacts: int) -> Trajectory:
    """Remove the records beyond the specified numbers, and reshape the rest to the shape of the starts."""

    def shaped(leaf, width=None):
        return leaf.reshape(shape + leaf.shape[1:])[..., :width] if leaf.ndim > 1 else leaf.reshape(shape)

    impacts, states = (
        jax.tree.map(partial(shaped, width=width), part)
        for part, width in ((run.impacts, max_impacts), (run.states, periods))
    )
    impacts, states = (
        _padded_by_constants(impacts, impacts.side != 0),
        _padded_by_constants(states, states.u == states.u),
    )
    return tiles.arrays(Trajectory(impacts, shaped(run.filled), states, shaped(run.status)))


def _padded_by_constants(records: Any, real: Any) -> Any:
    """Return records with the constant NaN as padding, so that the padding has no derivative.

    The derivative of a sum that masks the padding contains 0 times the derivative of the padding. This product is 0 for
    a constant, but would be NaN for padding that was computed.
    """
    if tiles.array_namespace(records) is np:
        return records
    return jax.tree.map(lambda x: jnp.where(real, x, jnp.nan) if x.dtype.kind == "f" else x, records)
