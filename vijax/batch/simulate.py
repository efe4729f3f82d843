"""Cells from start to summary: one compiled program for every kind of run, a tile of cells a call."""

import dataclasses
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vijax.batch import chain, lanes, rows, stragglers
from vijax.batch.cell import TRANSIENT_SHARE, Cell, Entry, Lane, Plan, Settings, walls_of
from vijax.batch.cell_program import entry_shapes, program
from vijax.batch.recurrence import MAX_PERIOD, recurrence, settled
from vijax.batch.summary import Summary, shapes, unload
from vijax.engine import exact
from vijax.engine.ground import ground_of
from vijax.engine.method import Method
from vijax.model.device import Harvester, check_device, electrical
from vijax.model.membrane import one_of
from vijax.model.pair import ImpactPair, check_pair
from vijax.runtime import checks, export_cache
from vijax.runtime.arrays import AnyArray, present
from vijax.runtime.context import door

_FIELDS = tuple(field.name for field in dataclasses.fields(Summary))
ENERGY = frozenset({"P", "P_stderr", "energy_ratio"})
DEEP = ENERGY | {"deepest", "deepest_left", "deepest_right"}


class Scale(eqx.Module):
    """SI size of the units of every cell, times the variants that share its dynamics.

    Metres per unit of depth of variant m of cell i: length[i] length_variant[m]; a rigid wall's depth is that of
    kappa = 1, so its length is divided by kappa. Metres per second per unit of speed: likewise.
    """

    length: Float[AnyArray, " cell"]
    speed: Float[AnyArray, " cell"]
    length_variant: Float[AnyArray, " variant"]
    speed_variant: Float[AnyArray, " variant"]


@lru_cache(maxsize=32)
def compiled(plan: Plan, width: int) -> export_cache.TracedProgram:
    """Compile the program of a plan: a whole tile of cells in one call."""

    def tile(cells, count, settings):
        outputs = rows.width(shapes(plan, cells.dtype))
        return lanes.run(program(plan, settings), cells, count, outputs, width)

    return export_cache.TracedProgram(tile, f"{tile.__qualname__} {plan} {width}")


def tolerances(dtype: str) -> dict[str, float]:
    """Name the tolerances that a run in the given precision uses."""
    kind = jnp.dtype(dtype)
    return {
        "recurrence": recurrence(kind),
        "orbit": settled(kind),
        "stick_speed": exact.stick_speed(kind),
        "max_period": float(MAX_PERIOD),
    }


def _check(pair: ImpactPair, device: Harvester, scale: Scale, starts: dict[str, Any], method: Method | None) -> None:
    """Raise ValueError unless a tile of cells can be run: one-dimensional arrays of one length."""
    if not isinstance(method, Method | None):
        raise ValueError(f"method must be a vijax.engine.method.Method, or None; got {checks.shown(method)}")
    # Whoever carries cells of a membrane that takes no restitution has NaN for r.
    lossy = method is None or one_of(method.law).restitution
    nothing: Any = None
    checks.known("pair", check_pair(pair if lossy else dataclasses.replace(pair, r=nothing)))
    check_device(device)
    checks.instance("scale", scale, Scale, "vijax.batch.simulate.Scale(...)")
    cells = np.shape(pair.d)
    if len(cells) != 1 or any(np.shape(field) != cells for field in jax.tree.leaves(pair)):
        raise ValueError(f"pair must hold 1-D arrays of one length; got shape {cells}; impact_pair broadcasts them")
    for name, start in starts.items():
        if checks.finite(name, start).shape != cells:
            raise ValueError(f"{name} must hold a number a cell, shape {cells}; got shape {np.shape(start)}")


@door
def summarise(
    pair: ImpactPair,
    u0: Float[AnyArray, " cell"],
    v0: Float[AnyArray, " cell"],
    scale: Scale,
    device: Harvester,
    *,
    periods: int = 400,
    until: str = "attractor",
    transient: int = 0,
    outputs: frozenset[str] = frozenset({"P"}),
    method: Method | None = None,
    count: int | None = None,
    padded: int | None = None,
    on: jax.Device | None = None,
) -> Summary:
    """Run a tile of cells from phase 0, each until its attractor is certain or its window is over, in one jitted call.

    Args:
        pair: Cells; `kappa=None` for rigid walls.
        u0, v0: Starts.
        scale: SI sizes; see `Scale`.
        device: Electrical constants, mass and penetration limit.
        periods: Length of the window, or the most that the search for an attractor may take.
        until: "attractor" or "window".
        transient: Periods before the window ("window" only).
        outputs: Names of `Summary` fields that must be there; what only others need is not computed.
        method: The stepping method (`method_choice.choose` makes it); None for the exact engine.
        count: How many cells are real, the rest being padding; all unless given. With 0 the program is compiled.
        padded: How many rows the compiled call has, at least; as many as cells unless given.
        on: The device that runs them; JAX's default unless given.

    Returns:
        The summary; a cell that fails says so in `status` and holds NaN.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    _check(pair, device, scale, {"u0": u0, "v0": v0}, method)
    periods, transient = checks.whole("periods", periods, 1), checks.whole("transient", transient, 0)
    checks.choice("until", until, ("attractor", "window"))
    outputs = frozenset(checks.words("outputs", outputs, _FIELDS))
    if on is not None:
        checks.instance("on", on, jax.Device, "jax.devices()[0]")
    count = pair.d.shape[0] if count is None else checks.whole("count", count, 0, pair.d.shape[0])
    dtype = pair.d.dtype
    plan = Plan(
        until=until,
        **walls_of(pair),
        ground=ground_of(pair.gamma),
        deep=bool(outputs & DEEP),
        work="energy_ratio" in outputs,
        energies=bool(outputs & ENERGY),
        asymmetry="asymmetry" in outputs,
        tangent=until == "attractor" or "lyapunov" in outputs,
        variants=scale.length_variant.shape[0],
    )
    settings = Settings(
        periods=_numbers(dtype, periods),
        transient=_numbers(dtype, transient if until == "window" else np.floor(TRANSIENT_SHARE * periods)),
        # Not what decides the motion, or what is admissible: a device with a limit needs no other program.
        device=_numbers(dtype, electrical(device)),
        method=_numbers(dtype, method),
        length_variant=_numbers(dtype, scale.length_variant),
        speed_variant=_numbers(dtype, scale.speed_variant),
    )
    size = pair.d.shape[0] if padded is None else checks.whole("padded", padded, pair.d.shape[0])
    return _run(plan, Entry(pair, scale.length, scale.speed, u0, v0, None), settings, count, size, on)


def _numbers(kind: Any, tree: Any) -> Any:
    """Turn numbers into NumPy's arrays of one kind: what makes them JAX's is a program, which is compiled."""
    return jax.tree.map(lambda x: np.asarray(x, kind), tree)


def _run(plan: Plan, entry: Entry, settings: Settings, real: int, size: int, on: jax.Device | None = None) -> Summary:
    """Make the summary of the real cells of a tile, in a table of so many rows at least, of NumPy's arrays."""
    cells, count = rows.laid_out(entry, lanes.table_rows(size, plan.variants)), _numbers(np.int32, real)
    if on is not None:
        cells, count, settings = jax.device_put((cells, count, settings), on)
    width, like = lanes.width_of(cells.shape[0]), shapes(plan, cells.dtype)
    # What a lane of a method carries need not be a row of numbers.
    few = stragglers.most() if settings.method is None else 0
    if not few:
        table = np.asarray(compiled(plan, width)(cells, count, settings))
        return rows.unpack(table[:real], like)
    return stragglers.run(plan, (cells, count, settings), real, few)


def blank(count: int, variants: int, dtype: str) -> Summary:
    """Make an empty summary of so many cells: which shape and kind of number each field has."""
    plan = Plan(deep=True, work=True, energies=True, asymmetry=True, unequal=True, variants=variants)
    like = shapes(plan, np.dtype(dtype))
    return rows.unpack(np.zeros((count, rows.width(like)), dtype), like)


@door
def attractors(
    pair: ImpactPair,
    device: Harvester,
    starts: "Starts",
    *,
    periods: int,
    recorded_periods: int,
    padded: int,
) -> Summary:
    """Run a tile of devices with soft walls, each until its attractor is certain, in one jitted call; with their ends.

    Args:
        pair: Cells.
        device: Those that they are the nondimensional form of: arrays [cell].
        starts: At any phase, in contact too.
        periods: The most that the search for an attractor may take.
        recorded_periods: Periods at the end whose impacts will be wanted.
        padded: How many rows the compiled call has, at least.

    Returns:
        The summary with its `handover`; energies are those of each cell's own device.
    """
    length: Any = device.length_unit
    speed: Any = device.speed_unit
    own = electrical(device, unequal=pair.unequal)
    entry = Entry(pair, length, speed, starts.u, starts.v, starts.t, own)
    plan = dataclasses.replace(_chained(pair), devices=True)
    settings = _chained_settings(pair, Harvester(), periods, recorded_periods, None)
    return _run(plan, entry, settings, pair.d.shape[0], padded)


def _chained(pair: ImpactPair) -> Plan:
    """Make the plan of cells whose ends are wanted."""
    ground = ground_of(pair.gamma)
    return Plan(**walls_of(pair), ground=ground, deep=True, work=True, energies=True, chained=True)


def _chained_settings(
    pair: ImpactPair, device: Harvester, periods: int, recorded_periods: int, method: Method | None
) -> Settings:
    numbers = partial(_numbers, pair.d.dtype)
    one = numbers(np.ones(1))
    return Settings(
        periods=numbers(periods),
        transient=numbers(np.floor(TRANSIENT_SHARE * periods)),
        device=numbers(electrical(device)),
        method=numbers(method),
        length_variant=one,
        speed_variant=one,
        recorded_periods=numbers(recorded_periods),
    )


class Starts(eqx.Module):
    """Where chains start: displacement, velocity and phase."""

    u: Float[AnyArray, "chain"]
    v: Float[AnyArray, "chain"]
    t: Float[AnyArray, "chain"]


class Growth(eqx.Module):
    """Units of displacement and of velocity of the cell before, in those of each cell."""

    u: Float[AnyArray, "chain link"]
    v: Float[AnyArray, "chain link"]


def _succeed(
    plan: Plan, settings: Settings, cell: Cell, table: Float[AnyArray, "lane in"]
) -> Float[AnyArray, "lane in"]:
    """Make rows of the next cells, with the start that the last ones hand on in the place of their growth."""
    end = present(unload(plan, settings, cell).handover)
    return _start(plan, table, end.u, end.v, end.t)


def _start(plan: Plan, table: Float[AnyArray, "lane in"], u: Lane, v: Lane, t: Lane) -> Float[AnyArray, "lane in"]:
    """Give rows that hold a growth the start that it makes of a state."""
    entry = rows.unpack(table, entry_shapes(plan, table.dtype))
    u = chain.within(entry.pair, u * entry.u)
    return rows.pack(dataclasses.replace(entry, u=u, v=v * entry.v, t=t))


@lru_cache(maxsize=32)
def _compiled_chains(plan: Plan) -> export_cache.TracedProgram:
    """Compile the program of chains: all their links in one call."""

    def follow(links, starts, count, length, settings):
        first = _start(plan, links[:, 0], starts.u, starts.v, starts.t)
        links = links.at[:, 0].set(first)
        succeed = partial(_succeed, plan, settings)
        outputs = rows.width(shapes(plan, links.dtype))
        return lanes.chain(program(plan, settings), succeed, links, count, length, outputs)

    return export_cache.TracedProgram(follow, f"{follow.__qualname__} {plan}")


@door
def follow(
    pair: ImpactPair,
    starts: Starts,
    growth: Growth,
    length: Float[AnyArray, "chain link"],
    speed: Float[AnyArray, "chain link"],
    device: Harvester,
    *,
    periods: int = 400,
    recorded_periods: int = 25,
    method: Method | None = None,
    count: int | None = None,
    links: int | None = None,
) -> Summary:
    """Run chains of cells, each cell starting in the state in which the last one ended, in one jitted call.

    Args:
        pair: Cells [chain, link]; `kappa=None` for rigid walls.
        starts: Starts of the first cells, at any phase, in contact too, in the units of the cells before them.
        growth: How the handed-on state grows as its units change; of the first cells too.
        length, speed: SI sizes of the units of every cell; see `Scale`.
        device: Electrical constants, mass and penetration limit.
        periods: Forcing periods of a cell; one whose attractor is certain ends there, as if it had run them all.
        recorded_periods: Periods at the end whose impacts will be wanted.
        method: As in `summarise`; one whose forcing repeats every period.
        count, links: How many chains and links are real, the rest being padding; all unless given.

    Returns:
        The summary of every cell, with its `handover`.
    """
    cells = rows.pack(Entry(pair, length, speed, growth.u, growth.v, jnp.zeros_like(pair.d)), leading=2)
    chains, most = pair.d.shape
    number, long = (jnp.asarray(x, jnp.int32) for x in (count or chains, links or most))
    settings, plan = _chained_settings(pair, device, periods, recorded_periods, method), _chained(pair)
    table = np.asarray(_compiled_chains(plan)(cells, starts, number, long, settings))
    return rows.unpack(table, shapes(plan, cells.dtype))
