"""An optimum: what it is, and the proof of one from where an ascent ended.

The exact impact map has to confirm the orbit, and its steady state that it attracts; of ends that are one place one is
kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import LIMITS
from vijax.design.candidates import Begun
from vijax.design.design_settings import DesignSettings
from vijax.design.objective import Scene
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.model.variables import tuned, values, variables
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.periodic import Orbit
from vijax.orbits.steady import Steady, steady
from vijax.runtime import tiles
from vijax.runtime.context import door
from vijax.runtime.programs import jitted

_FEW = (16, 256)  # optima of one compiled call


@dataclass(frozen=True, kw_only=True)
class AnyOptimum:
    """A design, whichever its motion is; see `Optimum` and `AperiodicOptimum`.

    Attributes:
        values: The tuned quantities by name.
        device: The device that has them.
        label: Of the motion: n:m/pT, or "aperiodic".
        height: The objective.
        P, P_stderr: Energy harvested per half forcing period, and its standard error [J]: 0 of an orbit; of chaos from
            the spread of the balls.
        gradient: Derivative of the objective's logarithm in the logarithm of each quantity (in an inclination itself).
        active: What holds it there: constraints, bounds of which quantity.
        stopped: Why the search ended there.
        path: Accepted points [point, quantity], the first one first, and the objective there.
        heights: See `path`.
    """

    values: dict[str, float]
    device: Harvester
    label: str
    height: float
    P: float
    P_stderr: float
    gradient: dict[str, float]
    active: tuple[str, ...]
    stopped: str
    path: np.ndarray
    heights: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Return the variables: the logarithm of each tuned quantity, or an inclination itself."""
        return np.asarray(variables(tuple(self.values), list(self.values.values())))


@dataclass(frozen=True, kw_only=True)
class Optimum(AnyOptimum):
    """A design at which an ascent ended, verified.

    Attributes:
        orbit: Its orbit, along a leading axis of one; multipliers are its own.
        state: Energies, depths, margins' parts, condition and clearance of the nominal device; see `Steady`.
        evaluations: Of objective and gradient that it took.

    What holds it there names impacts. `stopped` is "maximum"; "supremum", where the objective rises up to the end of
    the orbit, which no orbit attains; "evaluations", when these were spent; "stalled", where no step is higher though
    the gradient is not zero: at a kink, such as a worst case has where two devices are alike; "weighted", of
    `robustness.weighted`.
    """

    orbit: Orbit
    state: Steady
    evaluations: int


@dataclass(frozen=True, kw_only=True)
class AperiodicOptimum(AnyOptimum):
    """A design whose motion is no orbit, confirmed by a long flight of many balls at exactly its values.

    Attributes:
        power: [W].
        speed, max_penetration, energy_ratio: The largest of all that was flown [m/s], [m], [1].
        lyapunov: Largest Lyapunov exponent per forcing period, the mean of the balls; NaN where none has any.
        admissible: Share of the balls that broke no limit.
        shares: Of the balls that ended on each motion, by its label, the largest first.
        gradient_stderr: Standard errors of the gradient; both were fitted to the last ensemble.
        predicted: The objective that the ensembles promised; what the last flight measured is the height.
        ensembles: How many were flown about it.
        flown: How many balls were flown at the end, and for how many forcing periods each.
        starts: Where these were at last.

    The label is n:m/pT where the motion turned out to be an orbit too long to be climbed from. `stopped` is "maximum",
    where the slopes are known to be small or a limit holds it; "noise", where the noise hides a slope; "slope", where
    there is one, but no ensemble further along it was higher; "refused", where none was taken; "outdone", where other
    places promised more; or "ensembles", when these were spent. The path is that of the centres of ensembles, with the
    objective fitted there.
    """

    power: float
    speed: float
    max_penetration: float
    energy_ratio: float
    lyapunov: float
    admissible: float
    shares: dict[str, float]
    gradient_stderr: dict[str, float]
    predicted: float
    ensembles: int
    flown: tuple[int, int]
    starts: Starts


class DroppedCandidate(NamedTuple):
    """A candidate for the best design that promised more than the best one gives, and is none.

    Attributes:
        values: The tuned quantities by name.
        label: Of its motion.
        predicted: The objective that it promised.
        measured: The objective that was verified; NaN where none was.
        reason: Why it was dropped.
    """

    values: dict[str, float]
    label: str
    predicted: float
    measured: float
    reason: str


class End(NamedTuple):
    """Where a start ended; arrays without the leading axis of starts."""

    z: np.ndarray
    height: float
    gradient: np.ndarray
    margins: np.ndarray  # [node, two an impact], the nominal device first; then lower and upper bounds
    knots: np.ndarray
    lost: bool
    settled: bool
    evaluations: int
    path: np.ndarray
    heights: np.ndarray


class VerifiedOptima(NamedTuple):
    """The optima of every device, the best first, and the ends of ascents that are none."""

    optima: list[list[Optimum]]
    dropped: list[list[DroppedCandidate]]


# What the exact map or the steady state says of an end that is no design.
_FLAWS = {
    Status.NO_ORBIT: "the exact map has no orbit there",
    Status.VIRTUAL: "the ball would meet a wall in between",
    Status.UNSTABLE: "the orbit repels",
}


def verified(
    scene: Scene,
    starts: Begun,
    ends: list[End],
    devices: list[Harvester],
    max_evaluations: int,
    settings: DesignSettings,
) -> VerifiedOptima:
    """Verify what was reached for every device: admissible, by the exact map, each optimum once, the best first."""
    owner = starts.owner
    good = [i for i, end in enumerate(ends) if end.margins.min() >= 0 and np.isfinite(end.height)]
    good = [i for rows in apart(good, ends, owner, settings.same_optimum) for i in rows]
    if not good:
        return VerifiedOptima([[] for _ in devices], [[] for _ in devices])
    own = [jax.tree.map(float, tuned(devices[owner[i]], scene.names, ends[i].z)) for i in good]
    many = jax.tree.map(lambda *x: jnp.array(x), *own)
    width = starts.flown.side.shape[1]
    wide = [np.pad(ends[i].knots, ((0, width - len(ends[i].knots)), (0, 0))) for i in good]
    sequence = starts.some(np.array(good)).flown.sequence(width)
    found = periodic.solve(jax.vmap(lambda d: d.pair())(many), sequence, jnp.array(wide))
    seen = states(own, found)
    # Ascents follow the equations of an orbit; that the ball flies it and is drawn to it is checked for the few ends.
    flaws = [Status(int(max(found.status[row], seen[row].status))) for row in range(len(own))]
    names = orbit_properties.labels(found)
    optima: list[list[Optimum]] = [[] for _ in devices]
    dropped: list[list[DroppedCandidate]] = [[] for _ in devices]
    for row, flaw in enumerate(flaws):
        end = ends[good[row]]
        at = dict(zip(scene.names, np.asarray(values(scene.names, end.z)).tolist(), strict=True))
        if flaw != Status.OK:
            dropped[owner[good[row]]].append(_dropped(at, str(names[row]), end.height, flaw))
            continue
        there = np.isfinite(end.heights)
        one = Optimum(
            values=at,
            device=own[row],
            orbit=found[row : row + 1],
            label=str(names[row]),
            height=end.height,
            P=float(seen[row].P),
            P_stderr=0.0,
            state=seen[row],
            gradient=dict(zip(scene.names, end.gradient.tolist(), strict=True)),
            active=_active(scene, end, sequence.side[row], settings.active_margin),
            stopped=_reason(end, max_evaluations),
            evaluations=end.evaluations,
            path=np.asarray(values(scene.names, end.path[there])),
            heights=np.exp(end.heights[there]),
        )
        optima[owner[good[row]]].append(one)
    return VerifiedOptima(optima, dropped)


def _dropped(at: dict[str, float], label: str, height: float, flaw: Status) -> DroppedCandidate:
    """Return the record of an end that is no design because of a status."""
    return DroppedCandidate(at, label, height, np.nan, _FLAWS.get(flaw, flaw.name.lower()))


def _reason(end: End, max_evaluations: int) -> str:
    if end.lost:
        return "supremum"
    if end.settled:
        return "maximum"
    return "evaluations" if end.evaluations >= max_evaluations else "stalled"


def apart(good: list[int], ends: list[End], owner: np.ndarray, same: float) -> Iterator[list[int]]:
    """Give the ends that differ, of every owner, the highest first.

    Args:
        good: Indices of the ends that may be told.
        ends: All of them.
        owner: Which device each belongs to.
        same: Distance within which two are one, in the logarithm of a quantity.
    """
    for own in np.unique(owner[good]):
        kept: list[int] = []
        for i in sorted((i for i in good if owner[i] == own), key=lambda i: -ends[i].height):
            if all(np.abs(ends[i].z - ends[k].z).max() > same for k in kept):
                kept.append(i)
        yield kept


_steady_states = jitted(jax.vmap(steady), name="steady states")


@door
def states(devices: list[Harvester], orbit: Orbit) -> list[Steady]:
    """Find the steady state of every device on its known orbit, in padded tiles."""
    given, found = jax.tree.map(lambda *x: np.array(x), *devices), []
    for tile in tiles.tiles(len(orbit), _FEW):
        some = _steady_states(jax.tree.map(lambda x, rows=tile.rows: x[rows], given), orbit[tile.rows])
        some = jax.tree.map(np.asarray, some)
        found += [jax.tree.map(lambda x, row=row: x[row], some) for row in range(tile.real)]
    return found


def _active(scene: Scene, end: End, side: Any, near: float) -> tuple[str, ...]:
    """Name what holds an end where it is."""
    count, width = len(scene.names), end.knots.shape[0]
    margins, low, high = np.split(end.margins, [end.margins.size - 2 * count, end.margins.size - count])
    words = []
    for node, kind, impact in np.argwhere(margins.reshape(-1, 2, width) < near):
        wall = "left" if side[impact] < 0 else "right"
        words.append(f"{LIMITS[kind]} at the {wall} wall" + (" at an end of the tolerance" if node else ""))
    words += [f"lower bound of {name}" for name, room in zip(scene.names, low, strict=True) if room < near]
    words += [f"upper bound of {name}" for name, room in zip(scene.names, high, strict=True) if room < near]
    return tuple(dict.fromkeys(words))
