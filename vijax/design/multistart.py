"""Surveys: which motions the devices of a design have, at values of the tuned quantities all over their bounds.

`find` is the line: a coarse survey -> a closer one where chaos, or motion that has not settled, promises more than any
orbit found, for narrow windows of periodic motion lie there. `candidates` chooses from the result what is climbed.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import LIMITS, averages
from vijax.design.design_settings import DEFAULT, DesignSettings
from vijax.design.promise import Met, at_places, highest_promise, near_limits, promise
from vijax.design.survey import Survey, stretch, survey
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.variables import cells, moving, tuned, values
from vijax.runtime import tiles
from vijax.runtime.lattice import lattice

_TILES = (512, 4096, 32768)  # cells of one compiled call
_REACH = 0.49, 0.6  # a ball starts within this part of the gap, and with at most this velocity
_KICK = 2 / math.pi  # most that the forcing adds to the speed of a ball from one wall to the other


class Effort(NamedTuple):
    """How far a survey looks.

    Attributes:
        points: Values of the first quantity.
        starts: At each of them.
        max_impacts: Of an orbit that is wanted.
        periods: Forcing periods that a start may take, in a gap that is not wide.
        settings: See there.
    """

    points: int
    starts: int
    max_impacts: int
    periods: int
    settings: DesignSettings = DEFAULT


class Looked(NamedTuple):
    """Motions that the survey of a device met.

    Attributes:
        starts: How many were flown.
        orbits, admissible: Periodic attractors that can be climbed from; those that break no constraint.
        restless: Number of values of the tuned quantities with other motion: aperiodic, not settled, or too long.
        P: Most that such motion harvests per half forcing period without breaking a constraint [J], the mean of the
            starts at one value of the tuned quantities; 0 if none does.
        values: Of the tuned quantities where it does; none if none does.
        limit, excess: Which limit the motion breaks that is nearest to breaking none, and by what part; "" and 0 where
            one keeps both, or nothing was met.
        held, silent, slow: Shares of the starts that end on one wall for ever, without an impact, and undecided.
    """

    starts: int
    orbits: int
    admissible: int
    restless: int
    P: float
    values: dict[str, float]
    limit: str
    excess: float
    held: float
    silent: float
    slow: float


class SurveyTask(NamedTuple):
    """Devices to survey, names of the tuned quantities, their bounds [device, 2, variable], objective and effort."""

    devices: list[Harvester]
    tune: tuple[str, ...]
    box: np.ndarray
    objective: str
    effort: Effort

    @property
    def points(self) -> int:
        """Return the number of values of the first quantity."""
        return 1 if first_moving(self.tune) is None else self.effort.points

    @property
    def cells(self) -> int:
        """Return the starts of a device with a narrow gap."""
        return len(self.levels) * self.points * self.effort.starts

    @property
    def starts(self) -> np.ndarray:
        """Return the starts of each device at every value: more in wide gaps, where more attractors coexist."""
        return self.effort.starts * np.minimum(self._stretch, self.effort.settings.max_wide_starts)

    @property
    def balls(self) -> np.ndarray:
        """Return the starts of each device in its first survey, the most of all."""
        return len(self.levels) * self.points * self.starts

    @property
    def flown(self) -> int:
        """Return the forcing periods that the starts of all devices take, at most."""
        return int((self.balls * self._stretch).sum()) * self.effort.periods

    @property
    def _stretch(self) -> np.ndarray:
        """Return how many times as many forcing periods flights of each device take, in the middle of its bounds."""
        given = jax.tree.map(lambda *x: np.array(x, float), *self.devices)
        own = jax.vmap(lambda one, z: tuned(one, self.tune, z))(given, self.box.mean(axis=1))
        return np.broadcast_to(stretch(own.s / own.length_unit), len(self.devices))

    @property
    def levels(self) -> np.ndarray:
        """Return values [level, quantity] of all quantities but the first, in parts of their bounds."""
        return _levels(self.tune, self.effort)


class SurveyResult(NamedTuple):
    """Motions that surveys met: orbits to climb from, all other motion, and the summary of every device."""

    task: SurveyTask
    orbits: Met
    others: Met
    looked: list[Looked]


def find(task: SurveyTask, *, orbits_alone: bool = True) -> SurveyResult:
    """Find the motions of every device.

    Args:
        task: See there; starts for tolerances are those for P.
        orbits_alone: Whether chaos is no answer, but a place where narrow windows may hide an orbit.
    """
    effort, devices = task.effort, len(task.devices)
    seen = _first_look(task) if orbits_alone else _in_two_flights(task)
    met, unrest = seen.orbits(effort.max_impacts), seen.restless(effort.max_impacts)
    if first_moving(task.tune) is not None:
        most = highest_promise(devices, *((met,) if orbits_alone else (met, at_places(unrest))))
        good = unrest.hope.total > most[unrest.owner] + math.log(effort.settings.min_promise)
        # An orbit that keeps its limits may hide in chaos that is far beyond them; the best motion of all does not.
        good &= orbits_alone | near_limits(unrest.some(good), unrest, effort.settings)
        again = _closer(unrest.some(good), task)
        if again.owner.size:
            closer = _look(task, again, 1)
            more = closer.orbits(effort.max_impacts), closer.restless(effort.max_impacts)
            met, unrest = jax.tree.map(lambda *x: np.concatenate(x), (met, unrest), more)
    return SurveyResult(task, met, unrest, _looked(task, met, unrest, seen))


def every_start(task: SurveyTask) -> tuple[Met, list[Looked]]:
    """Find what every start came to, where that is the answer, and what each device met."""
    seen = _first_look(task)
    met, unrest = seen.orbits(task.effort.max_impacts), seen.restless(task.effort.max_impacts)
    return seen.every(), _looked(task, met, unrest, seen)


def _first_look(task: SurveyTask) -> "_Seen":
    """Survey coarsely: as many starts at every value."""
    starts = task.starts
    owner = np.repeat(np.arange(len(task.devices)), len(task.levels) * task.points * starts)
    number = np.concatenate([np.arange(len(task.levels) * task.points * count) for count in starts])
    level, step = np.divmod(number // starts[owner], task.points)
    return _look(task, _Places(owner, level, step / max(task.points - 1, 1), number), 0)


def _in_two_flights(task: SurveyTask) -> "_Seen":
    """Survey coarsely, where any motion may win: what has not settled soon flies on where it may be the best."""
    effort, devices = task.effort, len(task.devices)
    short = min(effort.settings.first_periods, effort.periods)
    seen = _first_look(task._replace(effort=effort._replace(periods=short)))
    cells = seen.found.restless(effort.max_impacts)
    met, unrest = seen.orbits(effort.max_impacts), seen.motions(cells)
    most = highest_promise(devices, met, at_places(unrest))
    good = unrest.hope.total > most[unrest.owner] + math.log(effort.settings.min_rival)
    good = near_limits(unrest.some(good), unrest, effort.settings)
    if short == effort.periods or not good.any():
        return seen
    periods = effort.periods * stretch(seen.found.pair.d)
    return seen._replace(found=seen.found.onward(cells[good], seen.device, periods))


def _looked(task: SurveyTask, met: Met, unrest: Met, seen: "_Seen") -> list[Looked]:
    """Sum up what was met of every device, by the closer survey too."""
    mean = at_places(unrest._replace(hope=promise(unrest.found, unrest.device, "P"))).hope
    power = np.where(mean.lacks < 0, 0.0, np.exp(mean.value))
    owner = np.concatenate([met.owner, unrest.owner])
    every_room = np.concatenate([one.found.margins() for one in (met, unrest)])
    every_status = seen.found.ended.status

    def told(one: int) -> Looked:
        orbits, others = met.owner == one, np.flatnonzero(unrest.owner == one)
        highest = others[power[others].argmax()] if others.size else None
        best = 0.0 if highest is None else float(power[highest])
        where = np.asarray(values(task.tune, unrest.z[highest])).tolist() if best else []
        room = every_room[owner == one]
        nearest = room[np.nan_to_num(room, nan=-np.inf).min(axis=1).argmax()] if len(room) else np.zeros(2)
        breaks = bool(nearest.min() < 0)
        status = every_status[seen.places.owner == one]
        return Looked(
            starts=status.size,
            orbits=int(orbits.sum()),
            admissible=int((met.hope.lacks[orbits] >= 0).sum()),
            restless=len(np.unique(unrest.z[others[unrest.found.P[others] > 0]], axis=0)),
            P=best,
            values=dict(zip(task.tune, where, strict=bool(best))),
            limit=LIMITS[int(nearest.argmin())] if breaks else "",
            excess=math.expm1(-float(nearest.min())) if breaks else 0.0,
            held=float((status == Status.PERMANENT_CONTACT).mean()),
            silent=float((status == Status.NO_IMPACT).mean()),
            slow=float((status == Status.SLOW).mean()),
        )

    return [told(one) for one in range(len(task.devices))]


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


def first_moving(tune: tuple[str, ...]) -> int | None:
    """Find the first quantity that moves the ball, along which surveys look, by its index."""
    return next((i for i, name in enumerate(tune) if moving(name)), None)


def _levels(tune: tuple[str, ...], effort: Effort) -> np.ndarray:
    """List values [level, quantity] of the others together, in parts of their bounds, over which they lie evenly."""
    first = first_moving(tune)
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
        return self.motions(self.found.closing(impacts, self.places.owner))

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


def _look(task: SurveyTask, places: _Places, seed: int) -> _Seen:
    """Survey some places, the ball of each starting where the draw of its number says.

    Draws are the same for every device, whatever the others are: designs of one do not depend on them.
    """
    devices, tune, box, objective, effort = task
    first, parts = first_moving(tune), task.levels[places.level]
    if first is not None:
        parts[:, first] = places.part
    low, high = box[places.owner].swapaxes(0, 1)
    z = low + parts * (high - low)
    given = jax.tree.map(lambda *x: np.array(x, float)[places.owner], *devices)
    every, pair = tiles.map_tiles(lambda rows: cells(rows[0], rows[1], tune), (given, z), _TILES)
    longest, periods = (count * stretch(pair.d) for count in (effort.settings.max_period, effort.periods))
    starts = _starts(pair, places.number, task.cells, seed)
    found = survey(pair, every, starts, longest=longest, periods=periods)
    step = np.round(places.part * (effort.points - 1)).astype(int)
    return _Seen(objective, found, every, z, places, step)


def _starts(pair: ImpactPair, number: np.ndarray, cells: int, seed: int) -> Starts:
    """Draw the start of every cell by its number; wide gaps use further draws, of as many cells each.

    In a wide gap every other ball is as fast as the forcing can keep it: faster orbits harvest more, and a ball loses
    speed from one impact to the next until it meets an orbit that holds it.
    """
    reach, speed = _REACH
    draws = [
        np.random.default_rng([seed, more] if more else seed).uniform(-1, 1, (2, cells))
        for more in range(1 + int(number.max()) // cells)
    ]
    u0, v0 = np.concatenate(draws, axis=1)[:, number]
    slowest = np.maximum(pair.at(1).r, pair.at(-1).r)
    fast = np.minimum(pair.d, _KICK / np.maximum(1 - slowest, 0.1))
    quick = np.where(number % 2 == 1, np.maximum(speed, fast), speed)
    return Starts(reach * u0 * pair.d, quick * v0, np.zeros_like(v0))


def _closer(unrest: Met, task: SurveyTask) -> _Places:
    """Choose places about the steps of motion that is no orbit.

    Cells of a device, so many at most, are spread evenly over these steps, and over each of them.
    """
    effort = task.effort
    owner, level, step = np.unique(np.column_stack([unrest.owner, unrest.level, unrest.step]), axis=0).T
    places = [_Places(*np.zeros((4, 0), int))]
    for one in np.unique(owner):
        here = np.flatnonzero(owner == one)
        number = np.arange(min(here.size * effort.settings.survey_refinement * effort.starts, task.cells))
        index, turn = here[number % here.size], number // here.size
        part = (step[index] + (turn + 0.5) / (turn.max() + 1) - 0.5) / (effort.points - 1)
        places.append(_Places(owner[index], level[index], np.clip(part, 0.0, 1.0), number))
    return jax.tree.map(lambda *x: np.concatenate(x), *places)
