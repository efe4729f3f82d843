"""The curves that explain a map: begun where orbits of its cells bifurcate, until its borders lie at curves."""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.orbits.continuation_settings import ContinuationSettings, check_settings
from vijax.orbits.curve_starts import CurveStart
from vijax.orbits.curves import BifurcationCurve, curves_from
from vijax.orbits.limits import LIMITS
from vijax.orbits.map_borders import (
    Borders,
    LabelledPlane,
    borders,
    device_of,
    labelled_plane,
    largest_piece,
    limit_borders,
    near,
)
from vijax.orbits.map_motions import both_attract
from vijax.orbits.map_seeds import limit_seeds, seeds
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

_SPREAD = 5  # so many cells a side are followed across the whole map at first
_MOST_ROUNDS = 1000
_WHOLE_POINTS = 300  # Most points of each such branch.
_REACH = 3.0  # cells on either side of a border that is looked at
_FIRST_STEP, _MAX_STEP = 0.02, 0.05  # across them, in units of all that way

_SETTINGS = ContinuationSettings(max_grazings=0)
Ended = Literal["explained", "tried", "rounds", "seconds", "stopped"]


class MapCurves(NamedTuple):
    """Curves of bifurcations over a map.

    Attributes:
        along: The map's two parameters, in the order of its axes.
        curves: Each once.
        borders: How many pairs of neighbouring periodic cells of the map differ in their label.
        explained: How many of these lie within one cell of a curve.
        left: Both parameters at the others, a row each.
        largest: Those of them that are the longest chain of neighbours.
        basins: At which of the others basins are parted: the motions of both cells attract in both, so that nothing
            bifurcates there. Not asked, and False, where the search was stopped or had no more seconds.
        ended: Why the search for more came to its end: all borders are "explained", each of the others was "tried",
            "rounds" or "seconds" were spent, or it was "stopped" by Ctrl-C.
    """

    along: tuple[str, str]
    curves: list[BifurcationCurve]
    borders: int
    explained: int
    left: np.ndarray
    largest: np.ndarray
    basins: np.ndarray
    ended: Ended


@door
def bifurcation_curves(
    dataset: "xr.Dataset",
    *,
    device: Harvester | None = None,
    max_rounds: int = 8,
    max_seconds: float = math.inf,
    round_borders: int = 48,
    max_points: int = 2000,
    limits: bool = False,
    settings: ContinuationSettings = _SETTINGS,
    progress: Callable[[int, int], None] | None = None,
) -> MapCurves:
    """Find the curves of bifurcations that explain a map of labels over two parameters.

    Orbits of a few cells all over the map are followed along both of its axes, and curves from what they meet. Then, in
    rounds, orbits on both sides of borders at which no curve lies are followed across these, and curves from there.

    Args:
        dataset: What `vijax.sweep` returned, over two parameters, with period, impacts and status.
        device: Of the map, unless it says so itself: along "beta" g/A is read.
        max_rounds: Rounds, after the first look, at most; it ends sooner where one finds nothing.
        max_seconds: After these nothing more is begun: no round, no batch of branches or of curves. What is under way
            is finished, and may have to be compiled first.
        round_borders: Borders that are looked at in a round, drawn from all that are left.
        max_points: Most points of a curve each way.
        limits: Whether to follow also where orbits meet the penetration limit and the energy limit of the device,
            between cells that are admissible and cells that are not; the map must hold `admissible`.
        settings: Of steps and events. By default curves end at grazes: beyond, other cells of the map begin others.
        progress: Called with (borders explained, borders in all), first before anything is followed.

    Returns:
        The curves, and which borders of the map they explain, and which of the others are those of basins. Where Ctrl-C
        stops the search, the curves that were found until then.

    Raises:
        ValueError: No map of labels over two parameters that its orbits depend on, or one without periodic cells.
    """
    max_rounds, max_seconds = check_budget(max_rounds, max_seconds)
    round_borders = checks.whole("round_borders", round_borders, 1, 10_000)
    max_points, settings = checks.whole("max_points", max_points, 2, 10**6), check_settings(settings)
    tell = checks.function("progress", progress)
    device = None if device is None else one_device(device)
    checks.flag("limits", limits)
    plane = labelled_plane(dataset)
    device = device_of(dataset) if device is None else device
    beside = limit_borders(plane) if limits else borders(plane)[:0]
    search = _CurveSearch(plane, device, max_points, settings, tell)
    basins = None
    try:
        ended = search.run(max_rounds, round_borders, beside, time.monotonic() + max_seconds)
        basins = None if ended == "seconds" else both_attract(plane, search.left)
    except KeyboardInterrupt:
        ended = "stopped"
    left = search.left
    where = left.places(plane), largest_piece(left).places(plane)
    told = np.full(len(left), False) if basins is None else basins
    return MapCurves(plane.along, search.found, search.borders, search.borders - len(left), *where, told, ended)


def check_budget(max_rounds: int = 8, max_seconds: float = math.inf) -> tuple[int, float]:
    """Take the rounds and the seconds that a search may spend."""
    rounds = checks.whole("max_rounds", max_rounds, 0, _MOST_ROUNDS)
    return rounds, checks.real("max_seconds", max_seconds, "a positive number", lambda x: x > 0)


class _CurveSearch:
    """A search for the curves over a map: what it has found so far, and the borders that are left."""

    def __init__(
        self,
        plane: LabelledPlane,
        device: Harvester,
        max_points: int,
        settings: ContinuationSettings,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.left, self.found = borders(plane), list[BifurcationCurve]()
        self.borders = len(self.left)
        self._plane, self._device, self._max_points, self._settings = plane, device, max_points, settings
        self._progress = progress

    def run(self, max_rounds: int, round_borders: int, beside: Borders, deadline: float) -> Ended:
        """Look all over the map and beside limits, then at borders that are left, in rounds; say why no further."""
        self._tell()
        cells = _spread(self._plane)
        ways = np.repeat([0, 1], len(cells))
        whole = self._look(np.tile(cells, (2, 1)), ways, np.inf, self._settings, deadline)
        draw = np.random.default_rng(0)
        whole = whole and self._look_at_limits(draw.permutation(len(beside)), beside, round_borders, deadline)
        untried, tried = self.left, np.zeros(0, int)
        short = dataclasses.replace(self._settings, first_step=_FIRST_STEP, max_step=_MAX_STEP)
        for _ in range(max_rounds):
            chosen = draw.permutation(len(untried))[:round_borders]
            if not chosen.size or not whole:
                break
            some = untried[chosen]
            both = np.concatenate([some.cell, some.beyond]), np.tile(some.axis, 2)
            whole = self._look(*both, _REACH, short, deadline)
            # Those of which nothing came are left, and not tried again.
            tried = np.append(tried, some.number)
            untried = self.left[~np.isin(self.left.number, tried)]
        if not len(self.left):
            return "explained"
        return "seconds" if not whole else "rounds" if len(untried) else "tried"

    def _look(
        self, cells: np.ndarray, ways: np.ndarray, reach: float, steps: ContinuationSettings, deadline: float
    ) -> bool:
        """Follow orbits of cells along an axis each, and curves from what they meet; say whether time did for all."""
        plane, steepest = self._plane, float(self._device.g / self._device.A)
        starts: list[CurveStart] = []
        for some in seeds(plane, cells, ways, reach, steepest, _WHOLE_POINTS, steps):
            starts += some
            if time.monotonic() > deadline:
                return False
        return self._follow(starts, deadline)

    def _look_at_limits(self, order: np.ndarray, beside: Borders, round_borders: int, deadline: float) -> bool:
        """Follow limits from cells beside them until a curve lies at each; say whether time did for all."""
        left = beside[order]
        while len(left) and time.monotonic() < deadline:
            some, left = left[np.arange(len(left)) < round_borders], left[np.arange(len(left)) >= round_borders]
            known = len(self.found)
            if not self._follow(limit_seeds(self._plane, some.cell, self._device), deadline):
                return False
            for curve in self.found[known:]:
                left = left[~near(left, curve.values, self._plane)]
        return not len(left)

    def _follow(self, starts: list[CurveStart], deadline: float) -> bool:
        """Follow curves from starts that lie on none yet; say whether time did for all."""
        plane = self._plane
        with warnings.catch_warnings():
            # Many are tried, and some lie where a ball just no longer flies.
            warnings.filterwarnings("ignore", message=".* begin no curve")
            known = [*self.found]
            for some in curves_from(starts, plane.bounds, self._device, self._max_points, self._settings, known):
                self.found += some
                # Where a limit is met the label stays.
                for curve in (one for one in some if one.kind not in LIMITS):
                    self.left = self.left[~near(self.left, curve.values, plane)]
                self._tell()
                if time.monotonic() > deadline:
                    return False
        return True

    def _tell(self) -> None:
        if self._progress is not None:
            self._progress(self.borders - len(self.left), self.borders)


def _spread(plane: LabelledPlane) -> np.ndarray:
    """Choose periodic cells all over a map: those next to the points of a coarse lattice."""
    shape = np.array(plane.names.shape)
    periodic = np.argwhere(plane.names != "")
    lattice = (np.stack(np.meshgrid(*2 * [np.arange(_SPREAD)], indexing="ij"), axis=-1).reshape(-1, 2) + 0.5) / _SPREAD
    away = [np.abs(periodic / shape - point).sum(axis=1).argmin() for point in lattice]
    return periodic[np.unique(away)]
