"""Search for the best motion that is not an orbit: ensembles of samples climb the averages of aperiodic motion.

A place is a combination of values of the tuned quantities. `PlaceCandidates` selects the places with the highest scores
of a survey. `climb_places` then simulates an ensemble about each place, fits a surface to it and climbs the surface
with optax within a trust region. Long simulations at exactly the best places confirm the designs
(`design_confirmation`). Ensembles are necessary because derivatives along a chaotic trajectory grow with its Lyapunov
exponent and do not converge to derivatives of averages. Differences between samples in neighbouring devices do converge
to them.
"""

import dataclasses
from functools import lru_cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from vijax.design.aperiodic.ensemble import DesignTask, Ensemble, is_impacting, is_majority_kind, simulate_ensembles
from vijax.design.aperiodic.response_surface import Surface, fit_surface, lowest_surface
from vijax.design.ascent import Box, Evaluation, ascend
from vijax.design.design_settings import DesignSettings
from vijax.design.survey.motion_scores import SurveyMotions
from vijax.design.survey.orbit_candidates import SCORE_TOLERANCE
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted
from vijax.simulation.simulate import Starts

_SURFACES_PER_CALL = (16, 128)  # numbers of surfaces in one compiled call
_SURFACE_EVALUATIONS = 60  # largest number of evaluations of a surface in one ascent
_LARGEST_VIOLATION = 0.06  # ln(value / limit) above which a motion is not climbed
_MIN_SAMPLES = 8  # smallest number of samples for the fit of a surface
_WINDOW_RADIUS = 0.25  # radius of the ensemble in a window, divided by `last_radius`
_STANDARD_ERRORS = 3  # width of a confidence interval to one side, in standard errors


@dataclasses.dataclass
class AscentPlace:
    """A start of a climb of averages, and the current state of the climb.

    Attributes:
        device_index: Index of the device.
        z: Variables at the centre of the next ensemble.
        radius: Spread of the samples of the next ensemble; also the trust region of the step from it.
        starts: Initial states of the samples of the next ensemble, on the motion.
        best, surface: Variables at the centre of the last accepted ensemble, and the surface fitted to it.
        predicted_log: Predicted logarithm of the objective after the step, less a penalty where limits stay broken.
        path: Centres and fitted objectives of the accepted ensembles.
        ensembles: Number of simulated ensembles.
        stopped: Reason why the climb ended: "maximum", "noise", "refused" or "outdone"; "" while it continues.
    """

    device_index: int
    z: np.ndarray
    radius: float
    starts: Starts
    best: np.ndarray
    surface: Surface
    predicted_log: float = -np.inf
    path: list[tuple[np.ndarray, float]] = dataclasses.field(default_factory=list)
    ensembles: int = 0
    stopped: str = ""

    @property
    def unfinished(self) -> bool:
        """Return True if the climb has not ended."""
        return not self.stopped

    @property
    def has_surface(self) -> bool:
        """Return True if an ensemble was accepted."""
        return bool(self.path)

    @property
    def certain_value(self) -> float:
        """Return the logarithm of the objective less three standard errors; -inf if a limit is broken."""
        admissible = self.has_surface and self.surface.margins.min() >= 0
        return float(self.surface.value - _STANDARD_ERRORS * self.surface.value_error) if admissible else -np.inf


def _new_place(device_index: int, z: np.ndarray, radius: float, starts: Starts) -> AscentPlace:
    """Return a place that has no surface yet."""
    return AscentPlace(device_index, z, radius, starts, z, lowest_surface(z.size))


def climb_places(task: DesignTask, places: list[AscentPlace], best_verified: np.ndarray) -> list[AscentPlace]:
    """Climb from all places and return the places with an accepted ensemble, places of new windows included.

    Args:
        task: The search.
        places: Initial places; see `PlaceCandidates`.
        best_verified: Logarithm of the best verified objective of every device, -inf where there is none.
    """
    places = list(places)
    for _ in range(task.settings.max_ensembles):
        unfinished = [place for place in places if place.unfinished]
        if not unfinished:
            break
        places += _advance(task, places, unfinished, best_verified)
    return [place for place in places if place.has_surface]


# --- where to begin ---------------------------------------------------------------------------------------------------


class PlaceCandidates:
    """Candidates for `climb_places`: values of the tuned quantities where motion other than an orbit has a high score.

    Args:
        task: The search.
        others: Motions of the surveys except the orbits that are climbed as orbits; for the objective "expected", all
            motions.
    """

    def __init__(self, task: DesignTask, others: SurveyMotions):
        self._task, self._others = task, others
        self._tried: dict[int, list[np.ndarray]] = {}

    def take(self, best_verified: np.ndarray, first: bool) -> list[AscentPlace]:
        """Return new places with the highest scores of every device, at a distance from each other and earlier ones.

        Args:
            best_verified: Logarithm of the best verified objective of every device, -inf where there is none.
            first: True in the first round, where the score must exceed `min_aperiodic_share` of the best verified
                objective. In later rounds the score must exceed this objective itself.
        """
        settings, places, others = self._task.settings, [], self._others
        # In the first round the score must exceed a share of the best verified objective, in later rounds all of it.
        threshold = best_verified + (np.log(settings.min_aperiodic_share) if first else SCORE_TOLERANCE)
        for device_index in np.unique(others.device_index).tolist():
            rows = np.flatnonzero(others.device_index == device_index)
            # A place collects all motions with the same values of the tuned quantities.
            z, place_index = np.unique(others.z[rows], axis=0, return_inverse=True)
            motions = others.select(rows)
            value, margin, error = _score_places(self._task, place_index.ravel(), motions)
            # In later rounds the standard error is subtracted, so that noise alone does not lift a place above the best
            # design. The margin is negative where a limit is broken, so the term with the margin is a penalty.
            score = value + settings.violation_exponent * margin - (0.0 if first else error)
            score[margin < -_LARGEST_VIOLATION] = -np.inf
            spacing = settings.place_spacing * settings.ensemble_radius * self._task.unit(device_index)
            tried, chosen = self._tried.setdefault(device_index, []), 0
            for row in np.argsort(-score, kind="stable").tolist():
                if chosen == settings.max_places or not score[row] > threshold[device_index]:
                    break
                if all((np.abs(z[row] - other) > spacing).any() for other in tried):
                    tried.append(z[row])
                    chosen += 1
                    results = others.averages.select(rows[place_index.ravel() == row])
                    places.append(
                        _new_place(
                            device_index, z[row], settings.ensemble_radius, results.select(is_impacting(results)).end
                        )
                    )
        return places


def _score_places(
    task: DesignTask, place_index: np.ndarray, motions: SurveyMotions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log mean objective, margin to the limits and relative error of the mean for each place.

    If all samples must keep within the limits, the margin is the smallest one of the motions of a place. If only the
    share `task.reliability` must, the margin is the corresponding quantile.
    """
    count = np.bincount(place_index)
    value = np.exp(motions.scores.value)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative_error = np.nan_to_num(motions.summary.P_stderr[:, 0] / motions.averages.P, nan=1.0)
        mean = np.bincount(place_index, value) / count
        spread = np.bincount(place_index, (value - mean[place_index]) ** 2) / np.maximum(count - 1, 1)
        # If a place has one motion, its error is the standard error of the average of this motion.
        variance = np.where(count > 1, spread, np.bincount(place_index, (value * relative_error) ** 2)) / count
        error = np.nan_to_num(np.sqrt(variance) / mean)
    # Within each place the margins are sorted, so that a quantile is an index.
    order = np.lexsort((motions.scores.margin, place_index))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    margin = motions.scores.margin[order][first + np.floor((1 - task.reliability) * (count - 1)).astype(int)]
    with np.errstate(divide="ignore"):
        return np.log(mean), margin, error


# --- a round of ensembles ---------------------------------------------------------------------------------------------


def _advance(
    task: DesignTask, places: list[AscentPlace], unfinished: list[AscentPlace], best_verified: np.ndarray
) -> list[AscentPlace]:
    """Simulate an ensemble about every unfinished place, step to the maximum of its surface, and return new places."""
    settings = task.settings
    device_index, centre = (
        np.array([place.device_index for place in unfinished]),
        np.array([place.z for place in unfinished]),
    )
    radius = np.array([place.radius for place in unfinished])
    starts = [place.starts for place in unfinished]
    ensembles = simulate_ensembles(task, device_index, centre, radius, starts, settings.ensemble_periods, task.samples)
    for place, ensemble in zip(unfinished, ensembles, strict=True):
        _update_place(task, place, ensemble)
    best = np.array(best_verified, float)
    # A place must also exceed the lower confidence bounds that other places of its device have reached.
    np.maximum.at(best, [place.device_index for place in places], [place.certain_value for place in places])
    new = [] if task.expected else _find_windows(task, unfinished, centre, radius, ensembles, best)
    climbing = [place for place in unfinished if place.unfinished and place.has_surface]
    for place, target in zip(climbing, maximise_surfaces(task, climbing) if climbing else (), strict=True):
        _take_step(task, place, target, best[place.device_index])
    return new


def _update_place(task: DesignTask, place: AscentPlace, ensemble: Ensemble) -> None:
    """Accept an ensemble as the best of its place, or return to the best centre with a smaller radius."""
    settings = task.settings
    place.ensembles += 1
    is_used = np.isfinite(ensemble.averages.P) if task.expected else is_majority_kind(ensemble.averages)
    used = ensemble.select(is_used)
    value = used.averages.value(task.objective, used.device)
    accepted = is_used.sum() >= max(_MIN_SAMPLES, 0.5 * is_used.size) and value.any()
    if accepted:
        surface = fit_surface(used.offsets, value, used.averages.margins(), share=task.reliability)
        # An ensemble is refused only if it is lower than the best one by more than the noise.
        noise = _STANDARD_ERRORS * float(surface.value_error + place.surface.value_error) + settings.min_gain
        centre = np.zeros_like(place.z)
        accepted = (
            surface.penalised_value(centre, settings.violation_exponent)
            > place.surface.penalised_value(centre, settings.violation_exponent) - noise
        )
    if not accepted:
        # The ensemble is refused. The next one is narrower and has the best centre.
        place.radius, place.z = place.radius / 4, place.best
        if not place.has_surface or place.radius <= 0.1 * settings.last_radius:
            place.stopped = "refused"
        return
    # Samples without an impact are part of the average, but further ensembles do not start from them.
    place.best, place.surface, place.starts = place.z, surface, used.averages.select(is_impacting(used.averages)).end
    place.path.append((place.z, float(np.exp(surface.value))))


def _take_step(task: DesignTask, place: AscentPlace, target: np.ndarray, best: float) -> None:
    """Move a place to the maximum of its surface.

    The radius is reduced if the step is short. The climb ends at a maximum, or if the place cannot exceed the best
    design.
    """
    settings, surface, step = task.settings, place.surface, target - place.best
    place.z, place.predicted_log = target, surface.penalised_value(step, settings.violation_exponent)
    # A step well inside the trust region means that the maximum of the surface is near.
    is_short = (np.abs(step) < 0.5 * place.radius * task.unit(place.device_index)).all()
    if surface.margins.min() >= -settings.limit_reserve and is_short:
        noise = max(2 * float(surface.value_error), settings.min_gain)
        gain = surface.penalised_value(step, 0.0) - float(surface.value)
        if gain < noise and place.radius <= settings.last_radius:
            place.stopped = "maximum"
        place.radius = min(place.radius, settings.last_radius)
    if not place.predicted_log + _STANDARD_ERRORS * float(surface.value_error) > best - settings.min_gain:
        place.stopped = "outdone"


def _find_windows(
    task: DesignTask,
    unfinished: list[AscentPlace],
    centre: np.ndarray,
    radius: np.ndarray,
    ensembles: list[Ensemble],
    best: np.ndarray,
) -> list[AscentPlace]:
    """Return new places in narrow windows of periodic motion.

    A window is an interval of periodic motion within chaos. It is detected by a sample that has settled on an orbit
    with a higher objective than the best one of its device.
    """
    settings = task.settings
    new: dict[int, AscentPlace] = {}
    for place, place_z, width, (offsets, averages, device, _) in zip(
        unfinished, centre, radius, ensembles, strict=True
    ):
        # Only orbits within all limits are windows.
        is_window = (averages.period > 0) & is_impacting(averages) & (averages.margins().min(axis=1) >= 0)
        if width <= settings.last_radius or not is_window.any() or not place.has_surface:
            continue
        value = np.where(is_window, averages.value(task.objective, device), 0.0)
        sample = int(value.argmax())
        if np.log(value[sample]) > best[place.device_index] + settings.min_gain:
            start = averages.select(np.array([sample])).end
            new.setdefault(
                place.device_index,
                _new_place(place.device_index, place_z + offsets[sample], _WINDOW_RADIUS * settings.last_radius, start),
            )
    return list(new.values())


# --- the surface ------------------------------------------------------------------------------------------------------


def maximise_surfaces(task: DesignTask, places: list[AscentPlace], reserve: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the variables of the maximum of each surface in its trust region, computed by `ascend`.

    Args:
        task: The search.
        places: Places with surfaces.
        reserve: Margin to the limits that the maximum keeps, as a logarithm; one value, or one per place.
    """
    centre = np.array([place.best for place in places])
    # The surfaces of all places are stacked, [place, ...], for one compiled call.
    surface = Surface(*(np.array(x) for x in zip(*(place.surface for place in places), strict=True)))
    surface = surface._replace(margins=surface.margins - np.broadcast_to(reserve, len(places))[:, None])
    trust_region = np.array([place.radius * task.unit(place.device_index) for place in places])
    device_index = [place.device_index for place in places]
    low, high = (
        np.maximum(task.box[device_index, 0], centre - trust_region),
        np.minimum(task.box[device_index, 1], centre + trust_region),
    )
    program = _compiled(task.settings)
    maxima = np.asarray(tiles.map_tiles(lambda rows: program(*rows), (centre, surface, low, high), _SURFACES_PER_CALL))
    # Where limits are broken, the ascent raises the margins first and may leave the trust region.
    return np.clip(maxima, low, high)


@lru_cache(maxsize=4)
def _compiled(settings: DesignSettings):
    """Return the compiled function that maximises fitted surfaces."""

    def climb(centre, surface, low, high):
        evaluate, box = partial(_evaluate_surfaces, centre, surface), Box(low, high, settings.max_step)
        return ascend(evaluate, jnp.clip(centre, low, high), centre, box, _SURFACE_EVALUATIONS, settings).z

    return jitted(climb, often=True)


def _evaluate_surfaces(centre, surface: Any, z, near, memory) -> Evaluation:
    """Evaluate surfaces, relative to their value at the centre, and their margins at z, for `ascent.ascend`."""
    x = z - centre
    curvature_term = (surface.curvature * x[:, None]).sum(axis=2)
    return Evaluation(
        value=((surface.gradient + 0.5 * curvature_term) * x).sum(axis=1),
        gradient=surface.gradient + curvature_term,
        margins=surface.margins + (surface.slopes * x[:, None]).sum(axis=2),
        slopes=surface.slopes,
        # Unlike an orbit, a surface exists at every point.
        exists=jnp.ones(z.shape[0], bool),
        memory=memory,
    )
