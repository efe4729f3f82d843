"""Orbit diagrams: attractors along an axis, each point simulated from the final state of the previous point.

Many chains of points run side by side. `plan` validates, `run` simulates, `orbit_diagram` does both.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from vijax.maps.axes import Axes, check_axis
from vijax.maps.cells import cells
from vijax.maps.execution import estimate
from vijax.maps.map_dataset import SweepPlan, coordinates, provenance, warn_if_permanent_contact
from vijax.maps.outputs import OUTPUTS, LimitViolation, flagged, violation
from vijax.maps.sweep_settings import DiagramSettings
from vijax.model import energy
from vijax.model.choices import Direction, Precision, Walls
from vijax.model.device import Harvester, scalar_device
from vijax.model.forcing.excitation import Excitation
from vijax.model.pair import pair_of
from vijax.model.quantities import PARAMETERS, RESULT_QUANTITIES, STARTS
from vijax.model.records import State, Status
from vijax.model.units import QuantityLike
from vijax.model.walls.sides import values_by_name
from vijax.runtime import validation
from vijax.runtime.public_api import pool, public_api
from vijax.runtime.tiles import arrays, padded, workers
from vijax.simulation import simulate
from vijax.simulation.impact_log import ImpactLog, record_impacts, record_stepped

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)
_STATUS_LOG = logging.getLogger("vijax.waiting")  # As in `dispatch`.
_DIRECTIONS: dict[Direction, tuple[str, ...]] = {"down": ("down",), "up": ("up",), "both": ("down", "up")}
_DEFAULT = DiagramSettings()
_Fields = dict[str, np.ndarray]  # by name, [chain, point, ...]
# Points of a chain in one compiled call. Shorter chains are padded, so that one program serves all lengths.
_POINTS_PER_CALL = 64
# Least number (fewer chains are padded) and greatest number of chains that run side by side in a call.
_FEWEST_LANES, _MOST_LANES = 8, 512
_POINTS = {
    **{name: OUTPUTS[name][:2] for name in ("P", "P_stderr", "period", "impacts_left", "impacts_right")},
    "status": ("1", "how the point ended"),
    "filled": ("1", "impacts in the recorded periods"),
    **{name: OUTPUTS[name][:2] for name in ("max_penetration", "energy_ratio", "admissible", "violated_limits")},
}
_IMPACTS = {
    "phase": ("1", f"{RESULT_QUANTITIES['phase'].text} from that of the greatest forcing"),
    "period_number": ("1", "forcing period of the onset, from the first recorded one"),
    **{key: RESULT_QUANTITIES[key][:2] for key in ("side", "v_in", "v_out", "restitution", "duration", "depth", "E")},
}
_STROBES = {name: RESULT_QUANTITIES[name][:2] for name in ("u_strobe", "v_strobe")}


@public_api
def orbit_diagram(
    *,
    along: str,
    values: QuantityLike,
    direction: Direction = DiagramSettings.direction,
    periods: int = DiagramSettings.periods,
    recorded_periods: int = DiagramSettings.recorded_periods,
    wall: Walls = DiagramSettings.wall,
    device: Harvester | None = None,
    dtype: Precision = DiagramSettings.dtype,
    excitation: Excitation | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Axes],
) -> "xr.Dataset":
    """Record attractors along an axis, impact by impact: every point starts in the final state of the previous one.

    ::

        orbit_diagram(along="d", values=np.linspace(0.3, 0.05, 126), kappa=[400, 40, 4], r=0.5, direction="both")
        orbit_diagram(along="omega", values=np.linspace(0.5, 15, 200), s=0.2, direction="up")  # one device

    Physical displacement, velocity and phase are carried from point to point, so u and v are converted where their
    units change with omega or A. If the gap shrinks past the ball, the ball starts in contact; at a rigid wall, it
    starts at `|u| = 0.49 d` instead. The chains of other axes, and of both directions, run side by side.

    The simulation of a point ends early if its attractor is certified: the polished orbit replaces the other periods.
    Otherwise all periods are simulated. The next point starts from the final state at phase 0; if a contact spans phase
    0, from its exit, with the phase of the exit; after a failed point, from the start of the failed point.

    Args:
        along: The axis to sweep; not u0 or v0.
        values: Its values [point], visited in falling order, in rising order, or in both.
        direction: "down", "up" or "both".
        periods: Forcing periods of every point.
        recorded_periods: Number of recorded periods, at the end.
        wall: "soft", "rigid", "rigid_left" or "rigid_right".
        device: Constants of the device; Tables I and II by default.
        dtype: "float64", or "float32" with wider tolerances.
        excitation: `Harmonics`, because attractors require a forcing that repeats every period; the sine by default.
        progress: Called with (points done, points in all) from the calling thread, first with 0 done.
        axes: As in `sweep`: numbers or 1-D arrays. u0 and v0 are the starts of the first points.

    Returns:
        A dataset with the dimensions "direction" (of both), the other axes in the order specified, `along`, and
        "impact" or "strobe". Over impacts, in order, with impacts of whole orbits repeated, NaN beyond `filled`:
        `phase` in [0, 2), `period_number`, `side`, `v_in`, `v_out`, `restitution`, `duration`, `depth` [m], `E` [J].
        Over strobes: `u_strobe`, `v_strobe` at the end of every recorded period. Over points: `P` [J per half period]
        (over whole periods of the orbit; of an aperiodic motion over its last three quarters), `period`,
        `impacts_left`, `impacts_right`, `status`, `filled`, and, over the same impacts as P, `max_penetration` [m],
        `energy_ratio` and `admissible`.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.

    Source: the procedure of the paper's bifurcation diagrams.
    """
    settings = DiagramSettings(
        periods=periods,
        wall=wall,
        dtype=dtype,
        excitation=excitation,
        direction=direction,
        recorded_periods=recorded_periods,
    )
    return run(plan(along, values, axes, device, settings), progress)


@dataclass(frozen=True)
class DiagramPlan:
    """A validated orbit diagram.

    Attributes:
        plan: Plan of a sweep with the points of the diagram as its cells.
        along: The axis to sweep.
        settings: Settings of the plan, with the directions and the number of recorded periods.
    """

    plan: SweepPlan
    along: str
    settings: DiagramSettings

    @property
    def directions(self) -> tuple[str, ...]:
        """Names of the sweep directions along the axis."""
        return _DIRECTIONS[self.settings.direction]

    @property
    def dims(self) -> dict[str, int]:
        """Sizes of all dimensions except impacts and strobes, in the order of the dataset."""
        others = {dim: size for dim, size in self.plan.cells.sizes.items() if dim != self.along}
        both = {"direction": len(self.directions)} if len(self.directions) > 1 else {}
        return {**both, **others, self.along: self.points}

    @property
    def points(self) -> int:
        """Number of points of a chain."""
        return self.plan.cells.sizes[self.along]

    @property
    def count(self) -> int:
        """Number of points of all chains."""
        return math.prod(self.dims.values())

    @property
    def expected(self) -> estimate.Estimate:
        """Estimated duration and size."""
        return estimate.estimate_recorded_run(self.count, self.settings.periods, self.size)

    @property
    def size(self) -> int:
        """Bytes of the dataset, assuming two impacts per period."""
        return 8 * self.count * (self.settings.recorded_periods * (2 * len(_IMPACTS) + len(_STROBES)) + len(_POINTS))


@public_api
def plan(
    along: str,
    values: Any,
    axes: Mapping[str, Any],
    device: Harvester | None = None,
    settings: DiagramSettings = _DEFAULT,
) -> DiagramPlan:
    """Validate the arguments of an orbit diagram; simulates nothing.

    Args:
        along, values, device: As in `orbit_diagram`.
        axes: Value or values of each other axis; None means that the axis is absent.
        settings: How the points are simulated.

    Raises:
        ValueError, TypeError: If an argument is invalid; the message states the requirement and the value.
    """
    validation.validate_choice("along", along, PARAMETERS)
    others = {name: value for name, value in axes.items() if value is not None}
    if along in others:
        raise ValueError(f"{along} must be specified once; got it as `along` and as another axis")
    points = check_axis("values", values, along)
    if not points.ndim:
        raise ValueError(f"values must be a 1-D array of {along}; got {points}")
    device = scalar_device(device)
    # A start outside a rigid gap is put back into it, so the start is validated as with soft walls.
    laid_out = cells({**others, along: points}, device, "soft")
    outputs = (*_POINTS, *_IMPACTS, *_STROBES)
    diagram = DiagramPlan(SweepPlan(laid_out, settings, settings.integrator(device), outputs, device), along, settings)
    names = ["recorded_periods", "values", *(name for name in diagram.dims if name in others)]
    validation.check_memory(names, diagram.size, f"the impacts of {diagram.count:,} points")
    return diagram


@public_api
def run(diagram: DiagramPlan, progress: Callable[[int, int], None] | None = None) -> "xr.Dataset":
    """Simulate the chains of a plan tile by tile on every core, and return the dataset; see `orbit_diagram`."""
    notify = validation.validate_callable("progress", progress) or (lambda done, total: None)
    if diagram.expected.needs_confirmation:
        _LOG.warning("a long run starts: %s", diagram.expected)
    notify(0, diagram.count)
    table = _chain_table(diagram)
    chain_fields: dict[int, _Fields] = {}
    done = 0
    for index, part in _simulate_all(diagram, table):
        chain_fields |= {int(chain): {name: x[i] for name, x in part.items()} for i, chain in enumerate(index)}
        done += index.size * diagram.points
        notify(done, diagram.count)
    widest = max(chain["v_in"].shape[-1] for chain in chain_fields.values())
    order = [chain_fields[chain] for chain in sorted(chain_fields)]
    fields = {name: np.stack([_pad_impacts(chain[name], widest, name) for chain in order]) for name in order[0]}
    dataset = _make_dataset(diagram, fields)
    warn_if_permanent_contact(dataset)
    return dataset


def _pad_impacts(values: np.ndarray, widest: int, name: str) -> np.ndarray:
    """Pad a variable over impacts with NaN to the length `widest`; return other variables unchanged."""
    if name not in _IMPACTS:
        return values
    return np.pad(values, ((0, 0), (0, widest - values.shape[-1])), constant_values=np.nan)


def _visit_order(diagram: DiagramPlan) -> np.ndarray:
    """Return the indices of the points of every chain in the order of their visit, [chain, point]."""
    rising = np.argsort(diagram.plan.cells.axes[diagram.along].values, kind="stable")
    per_direction = diagram.count // (diagram.points * len(diagram.directions))
    return np.concatenate(
        [np.tile(rising[::-1] if way == "down" else rising, (per_direction, 1)) for way in diagram.directions]
    )


def _chain_table(diagram: DiagramPlan) -> _Fields:
    """Return parameters, units and starts of every chain in the order of the visit, [chain, point]."""
    of, orders = diagram.plan.cells, _visit_order(diagram)
    dims = {dim: size for dim, size in diagram.dims.items() if dim != "direction"}

    def column(quantity: "xr.Variable") -> np.ndarray:
        over_points = quantity.set_dims(dims).transpose(*dims).values.reshape(-1, diagram.points)
        return np.take_along_axis(np.tile(over_points, (len(diagram.directions), 1)), orders, axis=1)

    table = {name: column(of.quantities[name]) for name in (*of.pair_names, "u0", "v0")}
    # Metres per unit of displacement; with rigid walls, the unit of penetration is this unit over kappa.
    table |= {"metres": column(of.length), "speed": column(of.speed)}
    stiff = "kappa_left" if of.has_unequal_walls else "kappa"
    rigid = diagram.settings.wall == "rigid"
    table["depth"] = table["metres"] / table[stiff] if rigid else table["metres"]
    return table


def _simulate_all(diagram: DiagramPlan, table: _Fields) -> Iterator[tuple[np.ndarray, _Fields]]:
    """Yield chain indices and fields of every tile of chains, as the tiles complete."""
    level = (table["gamma"] == 0).all(axis=1)
    threads = pool(workers())
    try:
        for group in (np.flatnonzero(level), np.flatnonzero(~level)):
            if not group.size:
                continue
            share = math.ceil(group.size / workers())
            lanes = min(max(padded(share), _FEWEST_LANES), _MOST_LANES)
            number = math.ceil(group.size / lanes)
            tiles = [group[first::number] for first in range(number)]
            chains = f"{tiles[0].size:,} chains of {diagram.points:,} points side by side"
            if number > 1:
                _STATUS_LOG.info("compiling")
                # One short call compiles the program; otherwise all threads would compile it at once.
                first_points = {name: x[:, :1] for name, x in table.items()}
                threads.submit(_simulate, diagram, tiles[0][:1], first_points, lanes, 1, 1).result()
                _STATUS_LOG.info("running %s", chains)
            else:
                _STATUS_LOG.info("compiling, then running %s", chains)
            arguments = table, lanes, diagram.settings.periods, diagram.settings.recorded_periods
            running = {threads.submit(_simulate, diagram, tile, *arguments): tile for tile in tiles}
            for future in as_completed(running):
                yield running.pop(future), future.result()
    finally:
        # After Ctrl-C the waiting tiles are dropped; running tiles end by themselves.
        threads.shutdown(wait=False, cancel_futures=True)


def _simulate(
    diagram: DiagramPlan, index: np.ndarray, table: _Fields, lanes: int, periods: int, recorded_periods: int
) -> _Fields:
    """Return the fields of the dataset for these chains, [chain, point] or [chain, point, impact or strobe]."""
    plan = diagram.plan
    table = {name: x[index].astype(plan.settings.dtype) for name, x in table.items()}
    summary = _summarise(plan, table, lanes, periods, recorded_periods)
    log = _record_impacts(plan, table, summary, recorded_periods)
    impacts, shape = log.impacts, table["d"].shape
    depth = impacts["depth"] * table["depth"].reshape(-1, 1)
    fields = {
        "filled": log.filled,
        "phase": impacts["t"],
        "period_number": impacts["n"],
        "restitution": -impacts["v_out"] / impacts["v_in"],
        "depth": depth,
        "E": np.asarray(energy.harvested_energy(plan.device.at(impacts["side"]), depth)),
        **{name: impacts[name] for name in ("side", "v_in", "v_out", "duration")},
        "u_strobe": log.u,
        "v_strobe": log.v,
    }
    points = {name: getattr(summary, name)[..., 0] for name in ("P", "P_stderr", "energy_ratio")}
    points["max_penetration"] = summary.deepest * table["depth"]
    limits = values_by_name("deepest", plan.device.depth_limit)
    depths = [(getattr(summary, name) * table["depth"], limit) for name, limit in limits.items()]
    points["violated_limits"] = violation(points["energy_ratio"], depths, plan.device)
    points["admissible"] = points["violated_limits"] == LimitViolation.NONE
    points |= {name: getattr(summary, name) for name in ("period", "impacts_left", "impacts_right", "status")}
    return points | {name: values.reshape(shape + values.shape[1:]) for name, values in fields.items()}


def _summarise(plan: SweepPlan, table: _Fields, lanes: int, periods: int, recorded_periods: int) -> Any:
    """Summarise every point, [chain, point]; every call advances all chains by up to `_POINTS_PER_CALL` points."""
    chains, points = table["d"].shape
    growth = {name: np.ones_like(table[name]) for name in ("metres", "speed")}
    # Unit of the previous point over the unit of this one: the factor that converts u and v.
    for name, units in growth.items():
        units[:, 1:] = table[name][:, :-1] / table[name][:, 1:]
    state, parts = (table["u0"][:, 0], table["v0"][:, 0], np.zeros_like(table["u0"][:, 0])), []
    for first in range(0, points, _POINTS_PER_CALL):
        links = min(_POINTS_PER_CALL, points - first)

        def extended(x: np.ndarray, first: int = first, links: int = links) -> jax.Array:
            widths = ((0, lanes - chains), (0, _POINTS_PER_CALL - links))
            return jnp.asarray(np.pad(x[:, first : first + links], widths, mode="edge"))

        pair = pair_of({name: extended(table[name]) for name in plan.cells.pair_names}, plan.settings.wall)
        summary = simulate.run_chains(
            pair,
            simulate.Starts(*(jnp.asarray(np.pad(x, (0, lanes - chains), mode="edge")) for x in state)),
            simulate.UnitRatio(extended(growth["metres"]), extended(growth["speed"])),
            extended(table["depth"]),
            extended(table["speed"]),
            plan.device,
            periods=periods,
            recorded_periods=recorded_periods,
            method=plan.method,
            count=chains,
            links=links,
        )
        part = jax.tree.map(lambda x, links=links: x[:chains, :links], summary)
        end = part.handover
        state = (end.u[:, -1], end.v[:, -1], end.t[:, -1])
        parts.append(part)
    return jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)


def _record_impacts(plan: SweepPlan, table: _Fields, summary: Any, recorded_periods: int) -> ImpactLog:
    """Simulate the recorded periods of every point again, from their beginning, and record the impacts."""
    pair = arrays(pair_of({name: table[name].ravel() for name in plan.cells.pair_names}, plan.settings.wall))
    u, v, t, n, in_contact = (x.ravel() for x in jax.tree.leaves((summary.handover.mark, summary.handover.mode)))
    integers = (x.astype(np.int32) for x in (n, in_contact))
    failed = np.isin(summary.status, (Status.EVENT_BUDGET, Status.NONFINITE)).ravel()
    starts, method = State(u, v, t, *integers), plan.method
    if method is None:
        return record_impacts(pair, starts, recorded_periods, ~failed)
    return record_stepped(method, pair, starts, recorded_periods, ~failed)


def _make_dataset(diagram: DiagramPlan, fields: _Fields) -> "xr.Dataset":
    """Return the dataset made of the fields of all chains, each in the order of the visit."""
    import xarray as xr  # here, as importing vijax must not load it

    plan, sizes = diagram.plan, diagram.dims
    axis_order = np.argsort(_visit_order(diagram), axis=1)
    variables = {}
    for further, descriptions in (((), _POINTS), (("impact",), _IMPACTS), (("strobe",), _STROBES)):
        for name, (units, text) in descriptions.items():
            values = fields[name][np.arange(len(axis_order))[:, None], axis_order]
            values = values.reshape(*sizes.values(), *values.shape[2:])
            values = values.astype(plan.settings.dtype) if values.dtype.kind == "f" else values
            variables[name] = xr.Variable((*sizes, *further), values, {"units": units, "long_name": text})
    for name, kinds in (("status", Status), ("violated_limits", LimitViolation)):
        variables[name] = flagged(variables[name], kinds)
    # u0 and v0 are the starts of the first points only: they are coordinates only if the user specified them.
    coords = {name: x for name, x in coordinates(plan.cells).items() if name in plan.cells.axes or name not in STARTS}
    # Variable-length strings, because zarr format 3 has no stable type for text of fixed width.
    names = np.array(diagram.directions, dtype=np.dtypes.StringDType())
    ways = {"direction": ("direction", names)} if "direction" in sizes else {}
    title = {"title": "Orbit diagram of a vibro-impact pair"}
    return xr.Dataset(variables, coords=ways | coords, attrs=provenance(plan, along=diagram.along) | title)
