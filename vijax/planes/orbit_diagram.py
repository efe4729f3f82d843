"""Orbit diagrams: attractors along an axis, each point starting in the state in which the last one ended.

`plan` checks everything that can be wrong and starts nothing, `run` does the work, `orbit_diagram` is both.
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

from vijax.batch import simulate
from vijax.batch.impact_log import ImpactLog, record, record_stepped
from vijax.model import energy
from vijax.model.choices import Direction, Precision, Walls
from vijax.model.device import Harvester, one_device
from vijax.model.excitation import Excitation
from vijax.model.pair import pair_of
from vijax.model.quantities import MEASURED, PARAMETERS, STARTS
from vijax.model.records import State, Status
from vijax.model.sides import named
from vijax.model.units import Given
from vijax.planes import estimate
from vijax.planes.axes import Axes, check_axis
from vijax.planes.cells import cells
from vijax.planes.dataset import SweepPlan, coordinates, provenance, warn_if_held
from vijax.planes.outputs import OUTPUTS, LimitViolation, flagged, violation
from vijax.planes.sweep_settings import DiagramSettings
from vijax.runtime import checks, context
from vijax.runtime.context import door
from vijax.runtime.tiles import arrays, padded, workers

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)
_WAITING = logging.getLogger("vijax.waiting")  # As in `dispatch`.
_WAYS: dict[Direction, tuple[str, ...]] = {"down": ("down",), "up": ("up",), "both": ("down", "up")}
_DEFAULT = DiagramSettings()
# Points that a call takes chains further, so that one compiled program serves diagrams of every length: a short one is
# padded to as many.
_LINKS = 64
# Chains that run side by side in a call, at least, where others are padding, and at most.
_FEWEST_LANES, _MOST_LANES = 8, 512
_POINTS = {
    **{name: OUTPUTS[name][:2] for name in ("P", "P_stderr", "period", "impacts_left", "impacts_right")},
    "status": ("1", "how the point ended"),
    "filled": ("1", "impacts in the kept periods"),
    **{name: OUTPUTS[name][:2] for name in ("max_penetration", "energy_ratio", "admissible", "violated_limits")},
}
_IMPACTS = {
    "phase": ("1", f"{MEASURED['phase'].text} from that of the greatest forcing"),
    "period_number": ("1", "forcing period of the onset, from the first one kept"),
    **{name: MEASURED[name][:2] for name in ("side", "v_in", "v_out", "restitution", "duration", "depth", "E")},
}
_STROBES = {name: MEASURED[name][:2] for name in ("u_strobe", "v_strobe")}


@door
def orbit_diagram(
    *,
    along: str,
    values: Given,
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
    """Record attractors along an axis, impact by impact: every point starts where the last one ended.

    ::

        orbit_diagram(along="d", values=np.linspace(0.3, 0.05, 126), kappa=[400, 40, 4], r=0.5, direction="both")
        orbit_diagram(along="omega", values=np.linspace(0.5, 15, 200), s=0.2, direction="up")  # one device

    What is carried from point to point is the physical displacement and velocity, and the phase: so u and v change
    with their units where omega or A do, and a wall may move over the ball, which then starts in contact; a rigid one
    puts it back to `|u| = 0.49 d`. All other axes, and both directions, run side by side.

    A point whose attractor is certain ends there: its orbit, polished, is what it would have come to, and is taken to
    the end of its periods as it is. Elsewhere all periods are run. What is handed on is the ball at phase 0; where a
    contact spans that moment, the ball at its exit, with its phase; where a point fails, the state it started from.

    Args:
        along: The axis that is swept, any but u0 and v0.
        values: Its values [point], visited in falling order, in rising order, or in both.
        direction: "down", "up" or "both".
        periods: Forcing periods of every point.
        recorded_periods: How many of these, at the end, are recorded.
        wall: "soft", "rigid", "rigid_left" or "rigid_right".
        device: Constants of the device; Tables I and II unless given.
        dtype: "float64", or "float32" with tolerances to match.
        excitation: `Harmonics`, as attractors want a forcing that repeats every period; the sine unless given.
        progress: Called with (points done, points in all) from the calling thread, first with 0 done.
        axes: As in `sweep`: numbers or 1-D arrays. u0 and v0 are the starts of the first points.

    Returns:
        A dataset with the dimensions "direction" (of both), the other axes in the order given, `along`, and
        "impact" or "strobe". Over impacts, in order, those of whole orbits repeated, NaN beyond `filled`: `phase` in
        [0, 2), `period_number`, `side`, `v_in`, `v_out`, `restitution`, `duration`, `depth` [m], `E` [J]. Over
        strobes: `u_strobe`, `v_strobe` at the end of every kept period. Over points: `P` [J per half period] (over
        whole periods of the orbit; of an aperiodic motion over its last three quarters), `period`, `impacts_left`,
        `impacts_right`, `status`, `filled`, and, over the same impacts as P, `max_penetration` [m], `energy_ratio` and
        `admissible`.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.

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
class Diagram:
    """An orbit diagram that has passed the door.

    Attributes:
        planned: What a sweep's plan holds.
        along: The axis swept.
        settings: Those of the plan, with the directions and how much is kept.
    """

    planned: SweepPlan
    along: str
    settings: DiagramSettings

    @property
    def ways(self) -> tuple[str, ...]:
        """Name the directions in which the axis is gone along."""
        return _WAYS[self.settings.direction]

    @property
    def dims(self) -> dict[str, int]:
        """Give the sizes of all dimensions but that of impacts, in order."""
        others = {dim: size for dim, size in self.planned.cells.sizes.items() if dim != self.along}
        both = {"direction": len(self.ways)} if len(self.ways) > 1 else {}
        return {**both, **others, self.along: self.points}

    @property
    def points(self) -> int:
        """Count the points of a chain."""
        return self.planned.cells.sizes[self.along]

    @property
    def count(self) -> int:
        """Count the points in all."""
        return math.prod(self.dims.values())

    @property
    def expected(self) -> estimate.Estimate:
        """Estimate what it asks of the machine."""
        return estimate.of_recorded(self.count, self.settings.periods, self.size)

    @property
    def size(self) -> int:
        """Count the bytes of the dataset where there are two impacts a period."""
        return 8 * self.count * (self.settings.recorded_periods * (2 * len(_IMPACTS) + len(_STROBES)) + len(_POINTS))


@door
def plan(
    along: str,
    values: Any,
    axes: Mapping[str, Any],
    device: Harvester | None = None,
    settings: DiagramSettings = _DEFAULT,
) -> Diagram:
    """Check what an orbit diagram is asked for; runs nothing.

    Args:
        along, values, device: As in `orbit_diagram`.
        axes: Value or values of each other axis; None counts as not given.
        settings: How the points are run.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came.
    """
    checks.choice("along", along, PARAMETERS)
    given = {name: value for name, value in axes.items() if value is not None}
    if along in given:
        raise ValueError(f"{along} must not be given twice; got it as the axis swept and as another")
    points = check_axis("values", values, along)
    if not points.ndim:
        raise ValueError(f"values must be a 1-D array of {along}; got {points}")
    device = one_device(device)
    # A start that a rigid gap does not hold is put back into it: to this door all walls are soft.
    laid_out = cells({**given, along: points}, device, "soft")
    outputs = (*_POINTS, *_IMPACTS, *_STROBES)
    diagram = Diagram(SweepPlan(laid_out, settings, settings.integrator(device), outputs, device), along, settings)
    names = ["recorded_periods", "values", *(name for name in diagram.dims if name in given)]
    checks.fits(names, diagram.size, f"the impacts of {diagram.count:,} points")
    return diagram


@door
def run(diagram: Diagram, progress: Callable[[int, int], None] | None = None) -> "xr.Dataset":
    """Run the chains of a plan tile by tile on every core, and make the dataset; see `orbit_diagram`."""
    tell = checks.function("progress", progress) or (lambda done, total: None)
    if diagram.expected.long:
        _LOG.warning("a long run begins: %s", diagram.expected)
    tell(0, diagram.count)
    table = _table(diagram)
    found: dict[int, dict[str, np.ndarray]] = {}
    done = 0
    for index, part in _simulate_all(diagram, table):
        found |= {int(chain): {name: x[i] for name, x in part.items()} for i, chain in enumerate(index)}
        done += index.size * diagram.points
        tell(done, diagram.count)
    widest = max(chain["v_in"].shape[-1] for chain in found.values())
    order = [found[chain] for chain in sorted(found)]
    fields = {name: np.stack([_widened(chain[name], widest, name) for chain in order]) for name in order[0]}
    dataset = _label(diagram, fields)
    warn_if_held(dataset)
    return dataset


def _widened(values: np.ndarray, widest: int, name: str) -> np.ndarray:
    """Pad the impacts of a chain as those of the chain with the most."""
    if name not in _IMPACTS:
        return values
    return np.pad(values, ((0, 0), (0, widest - values.shape[-1])), constant_values=np.nan)


def _orders(diagram: Diagram) -> np.ndarray:
    """Find where every chain has its points in the order in which it visits them, [chain, point]."""
    rising = np.argsort(diagram.planned.cells.given[diagram.along].values, kind="stable")
    each = diagram.count // (diagram.points * len(diagram.ways))
    return np.concatenate([np.tile(rising[::-1] if way == "down" else rising, (each, 1)) for way in diagram.ways])


def _table(diagram: Diagram) -> dict[str, np.ndarray]:
    """Give parameters, units and starts of every chain in the order of its visit, [chain, point]."""
    of, orders = diagram.planned.cells, _orders(diagram)
    dims = {dim: size for dim, size in diagram.dims.items() if dim != "direction"}

    def column(quantity: "xr.Variable") -> np.ndarray:
        full = quantity.set_dims(dims).transpose(*dims).values.reshape(-1, diagram.points)
        return np.take_along_axis(np.tile(full, (len(diagram.ways), 1)), orders, axis=1)

    table = {name: column(of.quantities[name]) for name in (*of.pair_names, "u0", "v0")}
    # In metres per unit of displacement; of a rigid wall the engine's depth is that of kappa = 1.
    table |= {"metres": column(of.length), "speed": column(of.speed)}
    stiff = "kappa_left" if of.unequal else "kappa"
    rigid = diagram.settings.wall == "rigid"
    table["depth"] = table["metres"] / table[stiff] if rigid else table["metres"]
    return table


def _simulate_all(diagram: Diagram, table: dict[str, np.ndarray]) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Yield indices and fields of every tile of chains, as the tiles are done."""
    level = (table["gamma"] == 0).all(axis=1)
    pool = context.pool(workers())
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
                _WAITING.info("compiling")
                # One short call compiles before all threads would do so at once.
                brief = {name: x[:, :1] for name, x in table.items()}
                pool.submit(_simulate, diagram, tiles[0][:1], brief, lanes, 1, 1).result()
                _WAITING.info("running %s", chains)
            else:
                _WAITING.info("compiling, then running %s", chains)
            told = table, lanes, diagram.settings.periods, diagram.settings.recorded_periods
            running = {pool.submit(_simulate, diagram, tile, *told): tile for tile in tiles}
            for future in as_completed(running):
                yield running.pop(future), future.result()
    finally:
        # After Ctrl-C the waiting tiles are dropped, and those that run end by themselves.
        pool.shutdown(wait=False, cancel_futures=True)


def _simulate(
    diagram: Diagram, index: np.ndarray, table: dict[str, np.ndarray], lanes: int, periods: int, recorded_periods: int
) -> dict[str, np.ndarray]:
    """Compute the fields of the dataset for these chains, [chain, point] or [chain, point, impact or strobe]."""
    planned = diagram.planned
    table = {name: x[index].astype(planned.settings.dtype) for name, x in table.items()}
    summary = _follow(planned, table, lanes, periods, recorded_periods)
    flown = _fly(planned, table, summary, recorded_periods)
    impacts, shape = flown.impacts, table["d"].shape
    depth = impacts["depth"] * table["depth"].reshape(-1, 1)
    fields = {
        "filled": flown.filled,
        "phase": impacts["t"],
        "period_number": impacts["n"],
        "restitution": -impacts["v_out"] / impacts["v_in"],
        "depth": depth,
        "E": np.asarray(energy.harvested_energy(planned.device.at(impacts["side"]), depth)),
        **{name: impacts[name] for name in ("side", "v_in", "v_out", "duration")},
        "u_strobe": flown.u,
        "v_strobe": flown.v,
    }
    points = {name: getattr(summary, name)[..., 0] for name in ("P", "P_stderr", "energy_ratio")}
    points["max_penetration"] = summary.deepest * table["depth"]
    limits = named("deepest", planned.device.depth_limit)
    depths = [(getattr(summary, name) * table["depth"], limit) for name, limit in limits.items()]
    points["violated_limits"] = violation(points["energy_ratio"], depths, planned.device)
    points["admissible"] = points["violated_limits"] == LimitViolation.NONE
    points |= {name: getattr(summary, name) for name in ("period", "impacts_left", "impacts_right", "status")}
    return points | {name: values.reshape(shape + values.shape[1:]) for name, values in fields.items()}


def _follow(planned: SweepPlan, table: dict[str, np.ndarray], lanes: int, periods: int, recorded_periods: int) -> Any:
    """Summarise every point, [chain, point], the chains taken so many points further by every call."""
    chains, points = table["d"].shape
    growth = {name: np.ones_like(table[name]) for name in ("metres", "speed")}
    for name, units in growth.items():
        units[:, 1:] = table[name][:, :-1] / table[name][:, 1:]
    state, parts = (table["u0"][:, 0], table["v0"][:, 0], np.zeros_like(table["u0"][:, 0])), []
    for first in range(0, points, _LINKS):
        links = min(_LINKS, points - first)

        def extended(x: np.ndarray, first: int = first, links: int = links) -> jax.Array:
            widths = ((0, lanes - chains), (0, _LINKS - links))
            return jnp.asarray(np.pad(x[:, first : first + links], widths, mode="edge"))

        pair = pair_of({name: extended(table[name]) for name in planned.cells.pair_names}, planned.settings.wall)
        summary = simulate.follow(
            pair,
            simulate.Starts(*(jnp.asarray(np.pad(x, (0, lanes - chains), mode="edge")) for x in state)),
            simulate.Growth(extended(growth["metres"]), extended(growth["speed"])),
            extended(table["depth"]),
            extended(table["speed"]),
            planned.device,
            periods=periods,
            recorded_periods=recorded_periods,
            method=planned.method,
            count=chains,
            links=links,
        )
        part = jax.tree.map(lambda x, links=links: x[:chains, :links], summary)
        end = part.handover
        state = (end.u[:, -1], end.v[:, -1], end.t[:, -1])
        parts.append(part)
    return jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)


def _fly(planned: SweepPlan, table: dict[str, np.ndarray], summary: Any, recorded_periods: int) -> ImpactLog:
    """Fly the kept periods of every point again, from where they begin."""
    pair = arrays(pair_of({name: table[name].ravel() for name in planned.cells.pair_names}, planned.settings.wall))
    u, v, t, n, held = (x.ravel() for x in jax.tree.leaves((summary.handover.mark, summary.handover.held)))
    whole_numbers = (x.astype(np.int32) for x in (n, held))
    lost = np.isin(summary.status, (Status.EVENT_BUDGET, Status.NONFINITE)).ravel()
    starts, method = State(u, v, t, *whole_numbers), planned.method
    if method is None:
        return record(pair, starts, recorded_periods, ~lost)
    return record_stepped(method, pair, starts, recorded_periods, ~lost)


def _label(diagram: Diagram, fields: dict[str, np.ndarray]) -> "xr.Dataset":
    """Make the dataset of the fields of all chains, each in the order of its visit."""
    import xarray as xr  # here, as importing vijax must not load it

    planned, sizes = diagram.planned, diagram.dims
    given_order = np.argsort(_orders(diagram), axis=1)
    variables = {}
    for further, descriptions in (((), _POINTS), (("impact",), _IMPACTS), (("strobe",), _STROBES)):
        for name, (units, text) in descriptions.items():
            values = fields[name][np.arange(len(given_order))[:, None], given_order]
            values = values.reshape(*sizes.values(), *values.shape[2:])
            values = values.astype(planned.settings.dtype) if values.dtype.kind == "f" else values
            variables[name] = xr.Variable((*sizes, *further), values, {"units": units, "long_name": text})
    for name, kinds in (("status", Status), ("violated_limits", LimitViolation)):
        variables[name] = flagged(variables[name], kinds)
    of = planned.cells
    # Later points start where the one before ended: a start that was not given is no coordinate.
    known = {name: x for name, x in coordinates(of).items() if name in of.given or name not in STARTS}
    # The third format of zarr has no lasting place for text of fixed width.
    names = np.array(diagram.ways, dtype=np.dtypes.StringDType())
    ways = {"direction": ("direction", names)} if "direction" in sizes else {}
    title = {"title": "Orbit diagram of a vibro-impact pair"}
    return xr.Dataset(variables, coords=ways | known, attrs=provenance(planned, along=diagram.along) | title)
