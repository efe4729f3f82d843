"""Where designs set out from: attractors of a survey, of every kind the most promising.

`find` is the line: a coarse survey -> a closer one where chaos, or what has not settled, promises more than any orbit
found, for narrow windows of periodic motion lie there -> the best of every kind.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import LIMITS, averages
from vijax.design.design_settings import DEFAULT, DesignSettings
from vijax.design.promise import Met, highest_promise, near_limits, promise
from vijax.design.survey import Flown, Survey, flown, survey
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.model.variables import LINEAR, cells, moving, values
from vijax.runtime import tiles
from vijax.runtime.lattice import lattice

_TILES = (512, 4096, 32768)  # cells of one compiled call
_REACH = 0.49, 0.6  # a ball starts within this part of the gap, and with at most this velocity
_HOPELESS = -1e3  # score of what breaks a constraint, before what it lacks


class Effort(NamedTuple):
    """How far a survey looks.

    Attributes:
        points: Values of the first quantity.
        starts: At each of them.
        max_impacts: Of an orbit that is wanted.
        periods: Forcing periods that a start may take.
        settings: See there.
    """

    points: int
    starts: int
    max_impacts: int
    periods: int
    settings: DesignSettings = DEFAULT


class Looked(NamedTuple):
    """What a survey of a device met.

    Attributes:
        orbits, admissible: Periodic attractors that can be climbed from; those that break no constraint.
        restless: How many values of the tuned quantities have other motion: aperiodic, not settled, or too long.
        P: Most that such motion harvests per half forcing period without breaking a constraint [J]; 0 if none does.
        values: Of the tuned quantities where it does; none if none does.
        limit, excess: Which limit the motion breaks that is nearest to breaking none, and by what part; "" and 0 where
            one keeps both, or nothing was met.
        held, silent: Shares of the starts that end on one wall for ever, and without a wall.
    """

    orbits: int
    admissible: int
    restless: int
    P: float
    values: dict[str, float]
    limit: str
    excess: float
    held: float
    silent: float


class Begun(NamedTuple):
    """Where ascents begin, [start]: an orbit as it was flown, its device and variables, which of the devices it is."""

    flown: Flown
    device: Harvester
    z: np.ndarray
    owner: np.ndarray

    def some(self, index: np.ndarray) -> "Begun":
        """Pick those with the given indices."""
        return jax.tree.map(lambda x: x[index], self)


class _Places(NamedTuple):
    """Where a survey looks, [cell].

    Attributes:
        owner, level: See `Met`.
        part: Of the first quantity's bounds.
        number: Of the cell among those of its device.
    """

    owner: np.ndarray
    level: np.ndarray
    part: np.ndarray
    number: np.ndarray


def find(
    devices: list[Harvester],
    tune: tuple[str, ...],
    box: np.ndarray,
    objective: str,
    effort: Effort,
    *,
    orbits_alone: bool = True,
) -> tuple[Begun, Met, list[Looked]]:
    """Find the attractors to climb from, all motion that is no orbit to climb from, and what was met of every device.

    Args:
        devices: Where quantities that are not tuned are taken from.
        tune: Names of the others.
        box: Bounds of these, [device, 2, variable].
        objective: Of `OBJECTIVES`; starts for tolerances are those for P.
        effort: How far to look.
        orbits_alone: Whether chaos is no answer, but a place where narrow windows may hide an orbit.
    """
    scene = _Scene(devices, tune, box, objective, effort)
    seen = _first_look(scene) if orbits_alone else _in_two_flights(scene)
    met, unrest = seen.orbits(effort.max_impacts), seen.restless(effort.max_impacts)
    if _first(tune) is not None:
        most = highest_promise(len(devices), *((met,) if orbits_alone else (met, unrest)))
        good = unrest.hope.total > most[unrest.owner] + math.log(effort.settings.min_promise)
        # An orbit that keeps its limits may hide in chaos that is far beyond them; the best motion of all does not.
        good &= orbits_alone | near_limits(unrest.some(good), unrest, effort.settings)
        again = _closer(unrest.some(good), effort, scene.cells)
        if again.owner.size:
            closer = _look(scene, again, 1)
            more = closer.orbits(effort.max_impacts), closer.restless(effort.max_impacts)
            met, unrest = jax.tree.map(lambda *x: np.concatenate(x), (met, unrest), more)
    looked = _looked(scene, met, unrest, seen)
    chosen = met.some(_promising(met, len(devices), scene.points, effort.settings))
    if not orbits_alone:
        chosen = chosen.some(_rivals(chosen, unrest, scene))
    flights = flown(chosen.pair, chosen.ended, effort.max_impacts)
    return Begun(flights, chosen.device, chosen.z, chosen.owner), unrest, looked


def every_start(
    devices: list[Harvester], tune: tuple[str, ...], box: np.ndarray, effort: Effort
) -> tuple[Met, list[Looked]]:
    """Find what every start came to, where that is the answer, and what each device met; arguments as in `find`."""
    scene = _Scene(devices, tune, box, "expected", effort)
    seen = _first_look(scene)
    met, unrest = seen.orbits(effort.max_impacts), seen.restless(effort.max_impacts)
    return seen.every(), _looked(scene, met, unrest, seen)


def _first_look(scene: "_Scene") -> "_Seen":
    """Survey coarsely: as many balls at every value."""
    levels = len(_levels(scene.tune, scene.effort))
    shape = len(scene.devices), levels, scene.points, scene.effort.starts
    owner, level, step, _ = (x.ravel() for x in np.indices(shape))
    number = np.arange(owner.size) % scene.cells
    return _look(scene, _Places(owner, level, step / max(scene.points - 1, 1), number), 0)


def _in_two_flights(scene: "_Scene") -> "_Seen":
    """Survey coarsely, where any motion may win: what has not settled soon flies on where it may be the best."""
    effort, devices = scene.effort, len(scene.devices)
    short = min(effort.settings.first_periods, effort.periods)
    seen = _first_look(scene._replace(effort=effort._replace(periods=short)))
    cells = seen.found.restless(effort.max_impacts)
    met, unrest = seen.orbits(effort.max_impacts), seen.motions(cells)
    most = highest_promise(devices, met, unrest)
    good = unrest.hope.total > most[unrest.owner] + math.log(effort.settings.min_rival)
    good = near_limits(unrest.some(good), unrest, effort.settings)
    if short == effort.periods or not good.any():
        return seen
    return seen._replace(found=seen.found.onward(cells[good], seen.device, effort.periods))


def _looked(scene: "_Scene", met: Met, unrest: Met, seen: "_Seen") -> list[Looked]:
    """Sum up what was met of every device, by the closer survey too."""
    power = np.where(unrest.hope.lacks < 0, 0.0, np.nan_to_num(unrest.found.P))
    owner = np.concatenate([met.owner, unrest.owner])
    every_room = np.concatenate([one.found.margins() for one in (met, unrest)])
    every_status = seen.found.ended.status

    def told(one: int) -> Looked:
        orbits, others = met.owner == one, np.flatnonzero(unrest.owner == one)
        highest = others[power[others].argmax()] if others.size else None
        best = 0.0 if highest is None else float(power[highest])
        where = np.asarray(values(scene.tune, unrest.z[highest])).tolist() if best else []
        room = every_room[owner == one]
        nearest = room[np.nan_to_num(room, nan=-np.inf).min(axis=1).argmax()] if len(room) else np.zeros(2)
        breaks = bool(nearest.min() < 0)
        status = every_status[seen.places.owner == one]
        return Looked(
            orbits=int(orbits.sum()),
            admissible=int((met.hope.lacks[orbits] >= 0).sum()),
            restless=len(np.unique(unrest.z[others], axis=0)),
            P=best,
            values=dict(zip(scene.tune, where, strict=bool(best))),
            limit=LIMITS[int(nearest.argmin())] if breaks else "",
            excess=math.expm1(-float(nearest.min())) if breaks else 0.0,
            held=float((status == Status.PERMANENT_CONTACT).mean()),
            silent=float((status == Status.NO_IMPACT).mean()),
        )

    return [told(one) for one in range(len(scene.devices))]


class _Scene(NamedTuple):
    """What `find` is told."""

    devices: list[Harvester]
    tune: tuple[str, ...]
    box: np.ndarray
    objective: str
    effort: Effort

    @property
    def points(self) -> int:
        """Count the values of the first quantity at which is looked."""
        return _points(self.tune, self.effort)

    @property
    def cells(self) -> int:
        """Count the balls of a device that are flown in a look, at most."""
        return balls(self.tune, self.effort)


def balls(tune: tuple[str, ...], effort: Effort) -> int:
    """Count the balls of a device that are flown in a look, at most."""
    return len(_levels(tune, effort)) * _points(tune, effort) * effort.starts


def _points(tune: tuple[str, ...], effort: Effort) -> int:
    return 1 if _first(tune) is None else effort.points


def _first(tune: tuple[str, ...]) -> int | None:
    """Find the first quantity that moves the ball, along which surveys look, by its index."""
    return next((i for i, name in enumerate(tune) if moving(name)), None)


def _levels(tune: tuple[str, ...], effort: Effort) -> np.ndarray:
    """List values [level, quantity] of the others together, in parts of their bounds, over which they lie evenly."""
    first = _first(tune)
    others = [i for i, name in enumerate(tune) if i != first and moving(name)]
    count = effort.settings.survey_levels if others else 1
    parts = np.full((count, len(tune)), 0.5)
    if others:
        # A grid along one of them; over several a lattice of as many places.
        parts[:, others[0]] = (np.arange(count) + 0.5) / count
        if others[1:]:
            parts[:, others[1:]] = lattice(count, len(others) - 1).T
    return parts


class _Seen(NamedTuple):
    """A survey at some places, for an objective: the device and the variables of every cell."""

    objective: str
    found: Survey
    device: Harvester
    z: np.ndarray
    places: _Places
    step: np.ndarray

    def orbits(self, impacts: int) -> Met:
        """Find the periodic attractors of at most so many impacts."""
        return self.motions(self.found.closing(impacts))

    def restless(self, impacts: int) -> Met:
        """Find what was met that is no such orbit."""
        return self.motions(self.found.restless(impacts))

    def every(self) -> Met:
        """Give all that was met."""
        return self.motions(np.arange(self.step.size))

    def motions(self, cells: np.ndarray) -> Met:
        """Tell what some cells met, by their indices."""
        run = (self.found.pair, self.found.ended)
        (pair, ended), device, z, places, step = jax.tree.map(lambda x: x[cells], (run, *self[2:]))
        found = averages(device, ended)
        hope = promise(found, device, self.objective)
        return Met(found, hope, pair, ended, device, z, places.owner, places.level, step)


def _look(scene: _Scene, places: _Places, seed: int) -> _Seen:
    """Survey some places, the ball of each starting where the draw of its number says.

    Draws are the same for every device, whatever the others are: designs of one do not depend on them.
    """
    devices, tune, box, objective, effort = scene
    first, parts = _first(tune), _levels(tune, effort)[places.level]
    if first is not None:
        parts[:, first] = places.part
    low, high = box[places.owner].swapaxes(0, 1)
    z = low + parts * (high - low)
    given = jax.tree.map(lambda *x: np.array(x, float)[places.owner], *devices)
    every, pair = tiles.map_tiles(lambda rows: cells(rows[0], rows[1], tune), (given, z), _TILES)
    draw = np.random.default_rng(seed).uniform(-1, 1, (2, scene.cells))
    u0, v0 = (reach * x[places.number] for reach, x in zip(_REACH, draw, strict=True))
    starts = Starts(u0 * pair.d, v0, np.zeros_like(v0))
    found = survey(pair, every, starts, longest=effort.settings.max_period, periods=effort.periods)
    step = np.round(places.part * (effort.points - 1)).astype(int)
    return _Seen(objective, found, every, z, places, step)


def _closer(unrest: Met, effort: Effort, most_cells: int) -> _Places:
    """Choose places about the steps of motion that is no orbit.

    Cells of a device, so many at most, are spread evenly over these steps, and over each of them.
    """
    owner, level, step = np.unique(np.column_stack([unrest.owner, unrest.level, unrest.step]), axis=0).T
    places = [_Places(*np.zeros((4, 0), int))]
    for one in np.unique(owner):
        here = np.flatnonzero(owner == one)
        number = np.arange(min(here.size * effort.settings.survey_refinement * effort.starts, most_cells))
        index, turn = here[number % here.size], number // here.size
        part = (step[index] + (turn + 0.5) / (turn.max() + 1) - 0.5) / (effort.points - 1)
        places.append(_Places(owner[index], level[index], np.clip(part, 0.0, 1.0), number))
    return jax.tree.map(lambda *x: np.concatenate(x), *places)


def _promising(met: Met, devices: int, points: int, settings: DesignSettings) -> np.ndarray:
    """Choose the attractors to climb from: the best of their kind as far as so many steps away.

    A kind is given by span and impacts; the walls may change places where the tube is level.
    """
    hope = met.hope
    score = np.where(hope.lacks < 0, _HOPELESS + hope.lacks, hope.value)
    left, right = _impacts(met)
    kind = np.column_stack([met.owner, met.level, met.ended.period, left, right])
    found = highest(kind, met.step, score, max(1, points // settings.max_hills))
    enough = hope.total > highest_promise(devices, met)[met.owner] + math.log(settings.min_promise)
    return found[(enough | (left + right <= settings.max_sure_impacts))[found]]


def highest(group: np.ndarray, step: np.ndarray, score: np.ndarray, reach: int) -> np.ndarray:
    """Find the rows that none of their group beats within so many steps; of one step's rows the first best.

    Args:
        group: What rows of one group have in common, [row, ...].
        step, score: Where and how high each stands.
        reach: How many steps away a higher row beats it.
    """
    order = np.lexsort((-score, step, *group.T[::-1]))
    place = np.column_stack([group, step])[order]
    new = np.append(True, (np.diff(place, axis=0) != 0).any(axis=1))[: order.size]
    best, place = order[new], place[new]
    height, top = score[best], np.ones(best.size, bool)
    for ahead in range(1, reach + 1):
        apart = place[ahead:] - place[:-ahead]
        near = (apart[:, :-1] == 0).all(axis=1) & (apart[:, -1] <= reach)
        top[:-ahead] &= ~near | (height[:-ahead] >= height[ahead:])
        top[ahead:] &= ~near | (height[ahead:] >= height[:-ahead])
    return np.sort(best[top])


def _impacts(met: Met) -> tuple[np.ndarray, np.ndarray]:
    """Count left and right impacts of orbits; in a level tube the more and the fewer."""
    left, right = met.ended.impacts_left, met.ended.impacts_right
    swap = met.pair.symmetric & (right > left)
    return np.where(swap, right, left), np.where(swap, left, right)


def _rivals(met: Met, unrest: Met, scene: _Scene) -> np.ndarray:
    """Choose the attractors that may lead to the best design, where any motion may win.

    What promises too little, or exceeds a limit by far, never did.
    """
    settings, hope = scene.effort.settings, met.hope
    most = highest_promise(len(scene.devices), met, unrest)
    near = hope.lacks >= -_excess(scene)[met.owner]
    return np.flatnonzero(near & (hope.total >= most[met.owner] + math.log(settings.min_rival)))


def _excess(scene: _Scene) -> np.ndarray:
    """Say by how much an orbit of every device may exceed a limit to be climbed from, as a logarithm.

    Where the first quantity alone moves the ball, the survey has met the orbit nearer to where it keeps its limits.
    """
    first, settings = _first(scene.tune), scene.effort.settings
    most = np.full(len(scene.devices), settings.max_excess)
    if first is None or scene.tune[first] in LINEAR or len(_levels(scene.tune, scene.effort)) > 1:
        return most
    step = (scene.box[:, 1, first] - scene.box[:, 0, first]) / max(scene.points - 1, 1)
    return np.minimum(most, settings.max_excess_steps * step)
