"""Ensembles: many balls about one design, each in a device of its own, flown together with those of other designs.

What is fitted to them, and what is made of it, is elsewhere (`response_surface`, `aperiodic_search`).
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import Averages, averages
from vijax.design.design_settings import DesignSettings
from vijax.design.survey import stretch, survey
from vijax.design.tolerance import Tolerance, drawn
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.variables import LINEAR, cells, scattered
from vijax.planes.basins import SPEED, spread
from vijax.runtime import tiles

_TILES = (512, 4096, 32768)  # cells of one compiled call
# Balls that set out from one state differ by this part of their velocity: as copies they would tell nothing new.
_ASIDE = 1e-4
_FIRST = 10  # a first flight of so much fewer periods refutes most of what a long one would
_MORE = 4  # so many times the balls of an ensemble prove a design whose balls start anywhere


class Task(NamedTuple):
    """What is sought.

    Attributes:
        devices: Where quantities that are not tuned are taken from.
        tune: Names of the others.
        box: Bounds of these, [device, 2, variable].
        objective: Of `OBJECTIVES`.
        tolerances: How constants scatter about each design.
        reliability: Share of the balls that have to keep within the limits.
        settings: See there.
    """

    devices: list[Harvester]
    tune: tuple[str, ...]
    box: np.ndarray
    objective: str
    tolerances: tuple[Tolerance, ...]
    reliability: float
    settings: DesignSettings

    @property
    def expected(self) -> bool:
        """Say whether balls start anywhere; else they start on the motion that is meant."""
        return self.objective == "expected"

    @property
    def balls(self) -> int:
        """Say how many make an ensemble."""
        return self.settings.expected_balls if self.expected else self.settings.ensemble_balls

    @property
    def last_flights(self) -> list[tuple[int, int]]:
        """List balls and forcing periods of the flights that a design has to pass in turn; the last one proves it."""
        settings = self.settings
        if self.expected:
            return [(_MORE * settings.expected_balls, settings.ensemble_periods)]
        balls, periods = settings.confirm_balls, settings.confirm_periods
        return [(balls, max(periods // _FIRST, 1)), (balls, periods)]

    def unit(self, owner: int) -> np.ndarray:
        """Say what a radius of 1 is in every variable: a factor of e; of an inclination the width of its bounds."""
        low, high = self.box[owner]
        return np.where([name in LINEAR for name in self.tune], high - low, 1.0)


class Ensemble(NamedTuple):
    """Balls about one design.

    Attributes:
        offsets: Of the balls in the variables [ball, variable].
        found, device: What they gave, and their devices.
        periods: Forcing periods of the flight.
    """

    offsets: np.ndarray
    found: Averages
    device: Harvester
    periods: int = 0

    def some(self, index: np.ndarray) -> "Ensemble":
        """Pick those with the given indices."""
        device = jax.tree.map(lambda x: x[index], self.device)
        return Ensemble(self.offsets[index], self.found.some(index), device, self.periods)


def fly(
    task: Task,
    owner: np.ndarray,
    centre: np.ndarray,
    radius: np.ndarray,
    starts: list[Starts],
    periods: int,
    balls: int,
) -> list[Ensemble]:
    """Fly so many balls about every centre.

    Args:
        task: See there.
        owner: The device of each centre.
        centre: Variables [centre, variable].
        radius: How far the balls are spread about each; 0 for all of them at the centre.
        starts: Balls on the motion that is meant, for each centre; unused where balls start anywhere.
        periods: Forcing periods of every ball; in a wide gap more, see `flown_periods`.
        balls: How many.
    """
    unit = np.array([task.unit(one) for one in owner])
    offsets = (radius[:, None] * unit)[:, None] * pairs(balls, len(task.tune))
    z = np.clip(centre[:, None] + offsets, task.box[owner, 0][:, None], task.box[owner, 1][:, None])
    each = np.repeat(owner, balls)
    given = jax.tree.map(lambda *x: np.array(x, float)[each], *task.devices)
    device, pair = _cells(given, z.reshape(-1, len(task.tune)), task.tune)
    if task.tolerances:
        names, factors = drawn(task.tolerances, balls)
        # Tuned already: what is left to do is the nondimensional form of what is off.
        device = scattered(device, names, [np.tile(x, len(owner)) for x in factors.T])
        device, pair = _cells(device, np.zeros((each.size, 0)), ())
    begun = _anywhere(pair.d, len(owner), balls) if task.expected else _joined([on_motion(x, balls) for x in starts])
    widest = np.asarray(pair.d).reshape(len(owner), balls).max(axis=1)
    most = flown_periods(task.settings, widest, periods)
    found = averages(device, survey(pair, device, begun, longest=1, periods=np.repeat(most, balls)).ended)
    whole = Ensemble((z - centre[:, None]).reshape(-1, len(task.tune)), found, device)
    ensembles = (whole.some(np.arange(i * balls, (i + 1) * balls)) for i in range(len(owner)))
    return [one._replace(periods=int(count)) for one, count in zip(ensembles, most, strict=True)]


def flown_periods(settings: DesignSettings, d: Any, periods: int) -> np.ndarray:
    """Return the forcing periods of flights in gaps d: more in wide ones, though no more than the last flight takes."""
    return np.minimum(periods * stretch(d), max(periods, settings.confirm_periods))


def _cells(device: Harvester, z: np.ndarray, names: tuple[str, ...]) -> tuple[Harvester, ImpactPair]:
    """Make devices with tuned quantities, and their pairs, as NumPy's arrays."""
    found = tiles.map_tiles(lambda rows: cells(rows[0], rows[1], names), (device, z), _TILES)
    return jax.tree.map(np.asarray, found)


def pairs(balls: int, size: int) -> np.ndarray:
    """Draw offsets in [-1, 1] [ball, variable], evenly spread in every variable, in pairs of opposite ones."""
    half = (balls + 1) // 2
    # Not a lattice: of few balls it would leave the ends of each variable out, where a surface is fixed best.
    order = np.random.default_rng(size).permuted(np.tile(np.arange(half), (size, 1)), axis=1).T
    # Opposite ones lie between them: no two balls that set out alike are in one device, where they would stay alike.
    some = (2 * order + 0.5) / half - 1
    return np.concatenate([some, -some])[:balls]


def on_motion(starts: Starts, balls: int) -> Starts:
    """Put so many balls on a motion: where some are known to be, in turn, each time a little aside."""
    u, v, t = (np.resize(x, balls) for x in jax.tree.leaves(starts))
    many: Any = u, v * (1 + _ASIDE * (np.arange(balls) // len(starts.v))), t
    return Starts(*many)


def _anywhere(d: Any, centres: int, balls: int) -> Starts:
    """Put balls anywhere in the gap, in every ensemble the same ones."""
    u, v = (np.tile(x.values, centres) for x in spread(balls, None))
    begun: Any = u * d, 2 * SPEED * v, np.zeros_like(d)
    return Starts(*begun)


def _joined(some: list[Starts]) -> Starts:
    return jax.tree.map(lambda *x: np.concatenate(x), *some)


def moving(found: Averages) -> np.ndarray:
    """Return which balls have averages of a motion with impacts."""
    return np.isfinite(found.P) & (found.P > 0) & (found.status != Status.NO_IMPACT)


def silent(found: Averages) -> np.ndarray:
    """Return which balls met no wall in all that was flown. In a wide gap that is part of an aperiodic motion."""
    return found.status == Status.NO_IMPACT


def alike(found: Averages) -> np.ndarray:
    """Return which balls are on the kind of motion that most of them are on; those of another would bend the surface.

    Balls without an impact count with those that are aperiodic.
    """
    fine = moving(found)
    restless, periodic = (fine & (found.period <= 0)) | silent(found), fine & (found.period > 0)
    return restless if fine[restless].any() and restless.sum() >= periodic.sum() else periodic
