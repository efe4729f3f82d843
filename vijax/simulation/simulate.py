"""Simulation of cells from start to summary: one compiled program per kind of run, one tile of cells per call."""

import dataclasses
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vijax.impact.exact import exact_step
from vijax.impact.gravity_regime import gravity_regime_of
from vijax.impact.method import Method
from vijax.model.device import Harvester, check_device, electrical_device
from vijax.model.pair import ImpactPair, check_pair
from vijax.model.walls.membrane import representative_law
from vijax.runtime import validation
from vijax.runtime.arrays import AnyArray, not_none
from vijax.runtime.compilation import export_cache
from vijax.runtime.public_api import public_api
from vijax.simulation.attractor.search_tolerances import MAX_PERIOD, orbit_tolerance, recurrence_tolerance
from vijax.simulation.cell import chain
from vijax.simulation.cell.cell import TRANSIENT_SHARE, Cell, Entry, Lane, Plan, Settings, walls_of
from vijax.simulation.cell.cell_program import entry_shapes, program
from vijax.simulation.scheduler import lane_scheduler, record_rows, remaining_cells
from vijax.simulation.summary import Summary, summary_shapes, unload

_FIELDS = tuple(field.name for field in dataclasses.fields(Summary))
ENERGY = frozenset({"P", "P_stderr", "energy_ratio"})
DEEP = ENERGY | {"deepest", "deepest_left", "deepest_right"}


class Scale(eqx.Module):
    """SI sizes of the units of length and speed of every cell, and factors for the variants that share its motion.

    A unit of depth of variant m of cell i is length[i] length_variant[m] in metres. The depth at a rigid wall is
    computed for kappa = 1, so that the length of a cell with rigid walls must be divided by kappa. A unit of speed is
    speed[i] speed_variant[m] in metres per second.
    """

    length: Float[AnyArray, " cell"]
    speed: Float[AnyArray, " cell"]
    length_variant: Float[AnyArray, " variant"]
    speed_variant: Float[AnyArray, " variant"]


@lru_cache(maxsize=32)
def compiled(plan: Plan, width: int) -> export_cache.TracedProgram:
    """Return the compiled program of a plan; one call simulates a whole tile of cells."""

    def tile(cells, count, settings):
        outputs = record_rows.width(summary_shapes(plan, cells.dtype))
        return lane_scheduler.run(program(plan, settings), cells, count, outputs, width)

    return export_cache.TracedProgram(tile, f"{tile.__qualname__} {plan} {width}")


def tolerances(dtype: str) -> dict[str, float]:
    """Return the tolerances of a run in the given precision, by name."""
    kind = jnp.dtype(dtype)
    return {
        "recurrence": recurrence_tolerance(kind),
        "orbit": orbit_tolerance(kind),
        "stick_speed": exact_step.stick_speed(kind),
        "max_period": float(MAX_PERIOD),
    }


def _check(pair: ImpactPair, device: Harvester, scale: Scale, starts: dict[str, Any], method: Method | None) -> None:
    """Raise ValueError unless a tile of cells can be run: one-dimensional arrays of one length."""
    if not isinstance(method, Method | None):
        raise ValueError(f"method must be a vijax.impact.method.Method, or None; got {validation.value_text(method)}")
    # If the membrane has no restitution, r is NaN and is removed before the pair is checked.
    has_restitution = method is None or representative_law(method.law).restitution
    nothing: Any = None
    validation.validate_untraced("pair", check_pair(pair if has_restitution else dataclasses.replace(pair, r=nothing)))
    check_device(device)
    validation.validate_instance("scale", scale, Scale, "vijax.simulation.simulate.Scale(...)")
    cells = np.shape(pair.d)
    if len(cells) != 1 or any(np.shape(field) != cells for field in jax.tree.leaves(pair)):
        raise ValueError(f"pair must hold 1-D arrays of one length; got shape {cells}; impact_pair broadcasts them")
    for name, start in starts.items():
        if validation.validate_finite(name, start).shape != cells:
            raise ValueError(f"{name} must hold a number a cell, shape {cells}; got shape {np.shape(start)}")


@public_api
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
    """Run a tile of cells from phase 0 in one call, each until its attractor is certified or its window is over.

    Args:
        pair: Cells; `kappa=None` for rigid walls.
        u0, v0: Starts.
        scale: SI sizes; see `Scale`.
        device: Electrical constants, mass and penetration limit.
        periods: Length of the window, or the limit of the search for an attractor.
        until: "attractor" or "window".
        transient: Periods before the window ("window" only).
        outputs: Names of the requested `Summary` fields; values that only other fields need are not computed.
        method: The stepping method (`method_choice.choose_method` makes it); None for the exact engine.
        count: Number of real cells, the rest being padding; all by default. With 0 the program is only compiled.
        padded: Smallest number of rows of the compiled call; the number of cells by default.
        on: JAX device that runs the cells; JAX's default device by default.

    Returns:
        The summary. A failed cell has a `status` that states the failure, and NaN as its results.

    Raises:
        ValueError: If an argument is invalid; the message states the requirement and the value.
    """
    _check(pair, device, scale, {"u0": u0, "v0": v0}, method)
    periods, transient = (
        validation.validate_integer("periods", periods, 1),
        validation.validate_integer("transient", transient, 0),
    )
    validation.validate_choice("until", until, ("attractor", "window"))
    outputs = frozenset(validation.validate_choices("outputs", outputs, _FIELDS))
    if on is not None:
        validation.validate_instance("on", on, jax.Device, "jax.devices()[0]")
    count = pair.d.shape[0] if count is None else validation.validate_integer("count", count, 0, pair.d.shape[0])
    dtype = pair.d.dtype
    plan = Plan(
        until=until,
        **walls_of(pair),
        gravity_regime=gravity_regime_of(pair.gamma),
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
        # The program uses only the electrical constants, not the limits that decide whether a cell is admissible.
        device=_numbers(dtype, electrical_device(device)),
        method=_numbers(dtype, method),
        length_variant=_numbers(dtype, scale.length_variant),
        speed_variant=_numbers(dtype, scale.speed_variant),
    )
    size = pair.d.shape[0] if padded is None else validation.validate_integer("padded", padded, pair.d.shape[0])
    return _run(plan, Entry(pair, scale.length, scale.speed, u0, v0, None), settings, count, size, on)


def _numbers(kind: Any, tree: Any) -> Any:
    """Return numbers as NumPy's arrays of one dtype, because JAX would compile a program for the conversion."""
    return jax.tree.map(lambda x: np.asarray(x, kind), tree)


def _run(plan: Plan, entry: Entry, settings: Settings, real: int, size: int, on: jax.Device | None = None) -> Summary:
    """Return the summary of a tile's real cells, as NumPy's arrays; the cell table has at least `size` rows."""
    cells, count = record_rows.laid_out(entry, lane_scheduler.table_rows(size, plan.variants)), _numbers(np.int32, real)
    if on is not None:
        cells, count, settings = jax.device_put((cells, count, settings), on)
    width, like = lane_scheduler.width_of(cells.shape[0]), summary_shapes(plan, cells.dtype)
    # The state of a stepping method may contain more than numbers, so its last cells cannot be passed to CPU cores as
    # rows.
    most = remaining_cells.max_remaining_cells() if settings.method is None else 0
    if not most:
        table = np.asarray(compiled(plan, width)(cells, count, settings))
        return record_rows.unpack(table[:real], like)
    return remaining_cells.run(plan, (cells, count, settings), real, most)


def blank(count: int, variants: int, dtype: str) -> Summary:
    """Return a summary of zeros, which has the shape and dtype of every field for a number of cells."""
    plan = Plan(deep=True, work=True, energies=True, asymmetry=True, has_unequal_walls=True, variants=variants)
    like = summary_shapes(plan, np.dtype(dtype))
    return record_rows.unpack(np.zeros((count, record_rows.width(like)), dtype), like)


@public_api
def run_devices(
    pair: ImpactPair,
    device: Harvester,
    starts: "Starts",
    *,
    periods: int,
    recorded_periods: int,
    padded: int,
) -> Summary:
    """Run a tile of devices with soft walls until their attractors are certified; return also their final states.

    Args:
        pair: Cells.
        device: Devices of the cells: arrays [cell].
        starts: Starts of the devices, at any phase, in flight or in contact.
        periods: Limit of the search for an attractor.
        recorded_periods: Number of periods at the end; the caller records their impacts later, from `handover.mark`.
        padded: Smallest number of rows of the compiled call.

    Returns:
        The summary with its `handover` (final states); the energies of a cell are computed for its own device.
    """
    length: Any = device.length_unit
    speed: Any = device.speed_unit
    cell_device = electrical_device(device, has_unequal_walls=pair.has_unequal_walls)
    entry = Entry(pair, length, speed, starts.u, starts.v, starts.t, cell_device)
    # Electrical constants are columns of the cell table; the settings' device is not used.
    plan = dataclasses.replace(_chained(pair), devices=True)
    settings = _chained_settings(pair, Harvester(), periods, recorded_periods, None)
    return _run(plan, entry, settings, pair.d.shape[0], padded)


def _chained(pair: ImpactPair) -> Plan:
    """Return the plan of a run that computes the final state of every cell."""
    gravity_regime = gravity_regime_of(pair.gamma)
    return Plan(**walls_of(pair), gravity_regime=gravity_regime, deep=True, work=True, energies=True, chained=True)


def _chained_settings(
    pair: ImpactPair, device: Harvester, periods: int, recorded_periods: int, method: Method | None
) -> Settings:
    numbers = partial(_numbers, pair.d.dtype)
    unit = numbers(np.ones(1))
    return Settings(
        periods=numbers(periods),
        transient=numbers(np.floor(TRANSIENT_SHARE * periods)),
        device=numbers(electrical_device(device)),
        method=numbers(method),
        length_variant=unit,
        speed_variant=unit,
        recorded_periods=numbers(recorded_periods),
    )


class Starts(eqx.Module):
    """Starts of chains: displacement, velocity and phase."""

    u: Float[AnyArray, "chain"]
    v: Float[AnyArray, "chain"]
    t: Float[AnyArray, "chain"]


class UnitRatio(eqx.Module):
    """Units of displacement and velocity of the previous cell, divided by the units of each cell."""

    u: Float[AnyArray, "chain link"]
    v: Float[AnyArray, "chain link"]


def _succeed(
    plan: Plan, settings: Settings, cell: Cell, table: Float[AnyArray, "lane in"]
) -> Float[AnyArray, "lane in"]:
    """Return the rows of the next cells, with the final states of the previous ones as starts."""
    handover = not_none(unload(plan, settings, cell).handover)
    return _start(plan, table, handover.u, handover.v, handover.t)


def _start(plan: Plan, table: Float[AnyArray, "lane in"], u: Lane, v: Lane, t: Lane) -> Float[AnyArray, "lane in"]:
    """Return rows with the unit ratios replaced by a start: u and v times these ratios, and t."""
    entry = record_rows.unpack(table, entry_shapes(plan, table.dtype))
    u = chain.within(entry.pair, u * entry.u)
    return record_rows.pack(dataclasses.replace(entry, u=u, v=v * entry.v, t=t))


@lru_cache(maxsize=32)
def _compiled_chains(plan: Plan) -> export_cache.TracedProgram:
    """Return the compiled program of chains; one call simulates all links of all chains."""

    def follow(links, starts, count, length, settings):
        first = _start(plan, links[:, 0], starts.u, starts.v, starts.t)
        links = links.at[:, 0].set(first)
        succeed = partial(_succeed, plan, settings)
        outputs = record_rows.width(summary_shapes(plan, links.dtype))
        return lane_scheduler.chain(program(plan, settings), succeed, links, count, length, outputs)

    return export_cache.TracedProgram(follow, f"{follow.__qualname__} {plan}")


@public_api
def run_chains(
    pair: ImpactPair,
    starts: Starts,
    unit_ratio: UnitRatio,
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
    """Run chains of cells in one compiled call; each cell starts in the final state of the previous one.

    Args:
        pair: Cells [chain, link]; `kappa=None` for rigid walls.
        starts: Starts of the first cells, at any phase, also in contact, in the units of the cells before them.
        unit_ratio: Factors that convert the final state of the previous cell, or `starts`, to the units of each cell.
        length, speed: SI sizes of the units of every cell; see `Scale`.
        device: Electrical constants, mass and penetration limit.
        periods: Forcing periods of a cell. The simulation of a cell stops when its attractor is certified; its final
            state is then the state of the attractor after all periods.
        recorded_periods: Number of periods at the end; the caller records their impacts later, from `handover.mark`.
        method: As in `summarise`; its forcing must repeat every period.
        count, links: Number of real chains and links, the rest being padding; all by default.

    Returns:
        The summary of every cell, with its `handover`.
    """
    cells = record_rows.pack(Entry(pair, length, speed, unit_ratio.u, unit_ratio.v, jnp.zeros_like(pair.d)), leading=2)
    chains, most = pair.d.shape
    chain_count, chain_length = (jnp.asarray(x, jnp.int32) for x in (count or chains, links or most))
    settings, plan = _chained_settings(pair, device, periods, recorded_periods, method), _chained(pair)
    table = np.asarray(_compiled_chains(plan)(cells, starts, chain_count, chain_length, settings))
    return record_rows.unpack(table, summary_shapes(plan, cells.dtype))
