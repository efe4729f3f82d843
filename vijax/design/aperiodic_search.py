"""The best motion that is no orbit: ensembles of balls climb the averages of chaos, and a long flight proves them.

`search` is the line: the most promising places of a survey -> ensembles about each, whose fitted surface optax climbs
within a trust region -> the best of every device, flown for long at exactly its design (`long_flight`).
Derivatives along a chaotic flight grow with its Lyapunov exponent and say nothing of averages; differences between
balls in devices that are a little apart do.
"""

import dataclasses
from functools import lru_cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.ascent import Box, Look, ascend
from vijax.design.candidates import KEPT
from vijax.design.design_settings import DesignSettings
from vijax.design.ensemble import Ensemble, Task, alike, fly, moving
from vijax.design.promise import Met
from vijax.design.response_surface import Surface, fit, unknown
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_FITS = (16, 128)  # surfaces that are climbed in one compiled call
_LOOKS = 60  # evaluations of a surface, which cost next to nothing
_FAR = 0.06  # what lacks more than this to its limits, as a logarithm, is no place to begin
_FEWEST = 8  # no surface is fitted to fewer balls
_NARROW = 0.25  # windows of chaos are looked at with this part of the last radius
_SURE = 3  # standard errors


@dataclasses.dataclass
class Place:
    """A design that climbs, and the motion that it climbs with.

    Attributes:
        owner: Its device.
        z: Where the next ensemble is.
        radius: How far its balls are spread, and how far the next step may lead.
        starts: Balls on the motion.
        best, surface: Where the best ensemble was, and what was fitted to it.
        ahead: The logarithm of the objective that it promises to reach, less a price where limits stay broken.
        path: Centres and fitted objectives of the ensembles that were taken.
        ensembles: How many were flown.
        stopped: Why it climbs no more: "maximum", "noise", "refused" or "outdone"; "" while it climbs.
    """

    owner: int
    z: np.ndarray
    radius: float
    starts: Starts
    best: np.ndarray
    surface: Surface
    ahead: float = -np.inf
    path: list[tuple[np.ndarray, float]] = dataclasses.field(default_factory=list)
    ensembles: int = 0
    stopped: str = ""

    @property
    def going(self) -> bool:
        """Return whether there is more to gain."""
        return not self.stopped

    @property
    def known(self) -> bool:
        """Say whether an ensemble was taken."""
        return bool(self.path)

    @property
    def sure(self) -> float:
        """Give the logarithm of the objective that it has reached for certain."""
        kept = self.known and self.surface.margins.min() >= 0
        return float(self.surface.value - _SURE * self.surface.value_error) if kept else -np.inf


def _place(owner: int, z: np.ndarray, radius: float, starts: Starts) -> Place:
    return Place(owner, z, radius, starts, z, unknown(z.size))


def search(task: Task, places: list[Place], known: np.ndarray) -> list[Place]:
    """Climb from the places of every device.

    Args:
        task: See there.
        places: Where to begin; see `PlaceCandidates`.
        known: Logarithm of the best verified objective of every device, -inf where there is none.
    """
    places = list(places)
    for _ in range(task.settings.max_ensembles):
        going = [one for one in places if one.going]
        if not going:
            break
        places += _advance(task, places, going, known)
    return [one for one in places if one.known]


# --- where to begin ---------------------------------------------------------------------------------------------------


class PlaceCandidates:
    """Values of the tuned quantities at which other motion than an orbit is climbed, in turns.

    Args:
        task: See there.
        others: What surveys met that is no orbit to climb from; of "expected" all that they met.
    """

    def __init__(self, task: Task, others: Met):
        self._task, self._others = task, others
        self._tried: dict[int, list[np.ndarray]] = {}

    def take(self, known: np.ndarray, first: bool) -> list[Place]:
        """Take the most promising places of every device, apart from each other and from those taken before.

        Args:
            known: Logarithm of the best verified objective of every device, -inf where there is none.
            first: Whether this is the first turn; in later ones a place has to promise more than what is known.
        """
        settings, places, others = self._task.settings, [], self._others
        least = known + (np.log(settings.min_chaos) if first else KEPT)
        for owner in np.unique(others.owner).tolist():
            own = np.flatnonzero(others.owner == owner)
            z, which = np.unique(others.z[own], axis=0, return_inverse=True)
            some = others.some(own)
            value, lacks, error = _told(self._task, which.ravel(), some)
            # In later turns a place that the noise of its starts alone puts above the best design is not worth it.
            score = value + settings.limit_price * lacks - (0.0 if first else error)
            score[lacks < -_FAR] = -np.inf
            reach = settings.places_apart * settings.ensemble_radius * self._task.unit(owner)
            tried, chosen = self._tried.setdefault(owner, []), 0
            for row in np.argsort(-score, kind="stable").tolist():
                if chosen == settings.max_places or not score[row] > least[owner]:
                    break
                if all((np.abs(z[row] - other) > reach).any() for other in tried):
                    tried.append(z[row])
                    chosen += 1
                    found = others.found.some(own[which.ravel() == row])
                    places.append(_place(owner, z[row], settings.ensemble_radius, found.some(moving(found)).end))
        return places


def _told(task: Task, which: np.ndarray, met: Met) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Judge each value by the balls met at it: logarithm of their mean, what lacks to the limits, the mean's error.

    The worst of them, or of the share that counts, says how much room there is.
    """
    count = np.bincount(which)
    value = np.exp(met.hope.value)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.nan_to_num(met.ended.P_stderr[:, 0] / met.found.P, nan=1.0)
        mean = np.bincount(which, value) / count
        spread = np.bincount(which, (value - mean[which]) ** 2) / np.maximum(count - 1, 1)
        # The error of one ball alone is that of its own flight.
        square = np.where(count > 1, spread, np.bincount(which, (value * own) ** 2)) / count
        error = np.nan_to_num(np.sqrt(square) / mean)
    order = np.lexsort((met.hope.lacks, which))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    lacks = met.hope.lacks[order][first + np.floor((1 - task.reliability) * (count - 1)).astype(int)]
    with np.errstate(divide="ignore"):
        return np.log(mean), lacks, error


# --- a round of ensembles ---------------------------------------------------------------------------------------------


def _advance(task: Task, places: list[Place], going: list[Place], known: np.ndarray) -> list[Place]:
    """Fly an ensemble about every place that climbs and take the step that its surface advises; give new places."""
    settings = task.settings
    owner, centre = np.array([one.owner for one in going]), np.array([one.z for one in going])
    radius = np.array([one.radius for one in going])
    starts = [one.starts for one in going]
    flown = fly(task, owner, centre, radius, starts, settings.ensemble_periods, task.balls)
    for one, ensemble in zip(going, flown, strict=True):
        _judge(task, one, ensemble)
    best = np.array(known, float)
    np.maximum.at(best, [one.owner for one in places], [one.sure for one in places])
    new = [] if task.expected else _windows(task, going, centre, radius, flown, best)
    some = [one for one in going if one.going and one.known]
    for one, ahead in zip(some, climbed(task, some) if some else (), strict=True):
        _step(task, one, ahead, best[one.owner])
    return new


def _judge(task: Task, place: Place, ensemble: Ensemble) -> None:
    """Take an ensemble as the place's best, or go back to the best and look closer about it."""
    settings = task.settings
    place.ensembles += 1
    good = np.isfinite(ensemble.found.P) if task.expected else alike(ensemble.found)
    some = ensemble.some(good)
    value = some.found.value(task.objective, some.device)
    enough = good.sum() >= max(_FEWEST, 0.5 * good.size) and value.any()
    if enough:
        surface = fit(some.offsets, value, some.found.margins(), share=task.reliability)
        noise = _SURE * float(surface.value_error + place.surface.value_error) + settings.min_gain
        here = np.zeros_like(place.z)
        enough = surface.worth(here, settings.limit_price) > place.surface.worth(here, settings.limit_price) - noise
    if not enough:
        place.radius, place.z = place.radius / 4, place.best
        if not place.known or place.radius <= 0.1 * settings.last_radius:
            place.stopped = "refused"
        return
    # A ball that is without an impact for long is part of the average, but no more ensembles set out from it.
    place.best, place.surface, place.starts = place.z, surface, some.found.some(moving(some.found)).end
    place.path.append((place.z, float(np.exp(surface.value))))


def _step(task: Task, place: Place, ahead: np.ndarray, best: float) -> None:
    """Take a place's next step, look closer where it is short, and stop where nothing is left to gain or to win."""
    settings, surface, step = task.settings, place.surface, ahead - place.best
    place.z, place.ahead = ahead, surface.worth(step, settings.limit_price)
    short = (np.abs(step) < 0.5 * place.radius * task.unit(place.owner)).all()
    if surface.margins.min() >= -settings.limit_room and short:
        noise = max(2 * float(surface.value_error), settings.min_gain)
        gain = surface.worth(step, 0.0) - float(surface.value)
        if gain < noise and place.radius <= settings.last_radius:
            place.stopped = "maximum"
        place.radius = min(place.radius, settings.last_radius)
    if not place.ahead + _SURE * float(surface.value_error) > best - settings.min_gain:
        place.stopped = "outdone"


def _windows(
    task: Task, going: list[Place], centre: np.ndarray, radius: np.ndarray, flown: list[Ensemble], best: np.ndarray
) -> list[Place]:
    """Narrow windows: where a ball has left chaos for an orbit that gives more than the best of its device."""
    settings = task.settings
    new: dict[int, Place] = {}
    for place, at, wide, (offsets, found, device, _) in zip(going, centre, radius, flown, strict=True):
        good = (found.period > 0) & moving(found) & (found.margins().min(axis=1) >= 0)
        if wide <= settings.last_radius or not good.any() or not place.known:
            continue
        value = np.where(good, found.value(task.objective, device), 0.0)
        ball = int(value.argmax())
        if np.log(value[ball]) > best[place.owner] + settings.min_gain:
            start = found.some(np.array([ball])).end
            new.setdefault(place.owner, _place(place.owner, at + offsets[ball], _NARROW * settings.last_radius, start))
    return list(new.values())


# --- the surface ------------------------------------------------------------------------------------------------------


def climbed(task: Task, some: list[Place], room: np.ndarray | float = 0.0) -> np.ndarray:
    """Find where surfaces are highest in trust regions and the limits less some room, by optax's L-BFGS."""
    centre = np.array([one.best for one in some])
    surface = Surface(*(np.array(x) for x in zip(*(one.surface for one in some), strict=True)))
    surface = surface._replace(margins=surface.margins - np.broadcast_to(room, len(some))[:, None])
    reach = np.array([one.radius * task.unit(one.owner) for one in some])
    owner = [one.owner for one in some]
    low, high = np.maximum(task.box[owner, 0], centre - reach), np.minimum(task.box[owner, 1], centre + reach)
    work = _compiled(task.settings)
    found = np.asarray(tiles.map_tiles(lambda rows: work(*rows), (centre, surface, low, high), _FITS))
    # Where limits are broken, mending them would lead out of the region where the surface is known.
    return np.clip(found, low, high)


@lru_cache(maxsize=4)
def _compiled(settings: DesignSettings):
    def climb(centre, surface, low, high):
        look, box = partial(_look, centre, surface), Box(low, high, settings.max_step)
        return ascend(look, jnp.clip(centre, low, high), centre, box, _LOOKS, settings).z

    return jitted(climb, often=True)


def _look(centre, surface: Any, z, near, memory) -> Look:
    """See what there is of surfaces at points, for `ascent.ascend`."""
    x = z - centre
    bend = (surface.curvature * x[:, None]).sum(axis=2)
    return Look(
        value=((surface.gradient + 0.5 * bend) * x).sum(axis=1),
        gradient=surface.gradient + bend,
        margins=surface.margins + (surface.slopes * x[:, None]).sum(axis=2),
        slopes=surface.slopes,
        there=jnp.ones(z.shape[0], bool),
        memory=memory,
    )
