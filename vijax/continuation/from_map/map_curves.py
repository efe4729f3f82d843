"""Curves of bifurcations that explain the borders of a map, started where orbits of its cells bifurcate.

First, orbits of a coarse lattice of cells are followed across the whole map, along both axes. Then, in rounds, orbits
on both sides of borders without a curve are followed across these borders. From every bifurcation on the way a curve is
followed, unless the bifurcation lies on a known curve.
"""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vijax.continuation.continuation_settings import ContinuationSettings, check_settings
from vijax.continuation.curves.curve_starts import CurveStart
from vijax.continuation.curves.curves import BifurcationCurve, curves_from
from vijax.continuation.from_map.map_attractors import both_attract
from vijax.continuation.from_map.map_borders import (
    Borders,
    LabelledPlane,
    borders,
    device_of,
    labelled_plane,
    largest_chain,
    limit_borders,
    near_curve,
)
from vijax.continuation.from_map.map_starts import limit_seeds, seeds
from vijax.continuation.limits import LIMITS
from vijax.model.device import Harvester, scalar_device
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

_SPREAD = 5  # cells per side of the coarse lattice that is followed across the whole map
_MOST_ROUNDS = 1000
_BRANCH_POINTS = 300  # largest number of points of each branch
_BORDER_REACH = 3.0  # cells on either side of a border over which orbits are followed
# Steps of branches across a border, as fractions of the followed range of the parameter.
_FIRST_STEP, _MAX_STEP = 0.02, 0.05

_SETTINGS = ContinuationSettings(max_grazings=0)
EndReason = Literal["explained", "tried", "rounds", "seconds", "stopped"]


class MapCurves(NamedTuple):
    """Curves of bifurcations over a map.

    Attributes:
        along: The map's two parameters, in the order of its axes.
        curves: The curves, each once.
        borders: Number of borders of the map: pairs of neighbouring periodic cells with different labels.
        explained: Number of these borders within one cell of a curve.
        unexplained: Both parameters at each border that no curve explains, one row per border.
        largest_unexplained: Both parameters along the largest connected chain of unexplained borders.
        separates_basins: For each unexplained border, True if it separates basins: the motions of both cells attract in
            both cells, and nothing bifurcates. False without a test if the search was stopped or ran out of time.
        ended: Reason for which the search ended: "explained" (all borders), "tried" (each unexplained border), "rounds"
            or "seconds" (the limit was reached), or "stopped" (by Ctrl-C).
    """

    along: tuple[str, str]
    curves: list[BifurcationCurve]
    borders: int
    explained: int
    unexplained: np.ndarray
    largest_unexplained: np.ndarray
    separates_basins: np.ndarray
    ended: EndReason


@public_api
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
    """Compute the curves of bifurcations that explain a map of labels over two parameters.

    A border is a pair of neighbouring cells with different labels; a curve within one cell explains it. Orbits of a few
    cells all over the map are followed along both of its axes. Then, in rounds, orbits on both sides of unexplained
    borders are followed across the borders. A curve is followed from each bifurcation found.

    Args:
        dataset: Result of `vijax.sweep`, over two parameters, with period, impacts and status.
        device: Device of the map; by default it is read from the map. It determines g/A along "beta", and the limits.
        max_rounds: Largest number of rounds after the first search; the search ends sooner if every border is explained
            or has been tried.
        max_seconds: Time after which nothing more is started: no round, no batch of branches or of curves. Work in
            progress is completed, and may have to be compiled first.
        round_borders: Number of borders that are tried in a round, drawn at random from the remaining ones.
        max_points: Largest number of points of a curve in each direction.
        limits: Whether to follow also the curves where orbits reach the penetration limit or the energy limit of the
            device, between admissible and inadmissible cells; the map must contain `admissible`.
        settings: Settings of steps and events. By default curves end at grazes, because other cells of the map start
            the curves after a graze.
        progress: Called with (borders explained, borders in all), first before anything is followed.

    Returns:
        The curves, the number of borders that they explain, and the unexplained borders. If Ctrl-C stops the search,
        the curves completed by then are returned.

    Raises:
        ValueError: The dataset is no map of labels over two parameters that affect its orbits, or no cell is periodic.
    """
    max_rounds, max_seconds = check_budget(max_rounds, max_seconds)
    round_borders = validation.validate_integer("round_borders", round_borders, 1, 10_000)
    max_points, settings = validation.validate_integer("max_points", max_points, 2, 10**6), check_settings(settings)
    report = validation.validate_callable("progress", progress)
    device = None if device is None else scalar_device(device)
    validation.validate_flag("limits", limits)
    plane = labelled_plane(dataset)
    device = device_of(dataset) if device is None else device
    borders_at_limits = limit_borders(plane) if limits else borders(plane)[:0]
    search = _CurveSearch(plane, device, max_points, settings, report)
    basins = None
    try:
        ended = search.run(max_rounds, round_borders, borders_at_limits, time.monotonic() + max_seconds)
        # The test of basins takes time of its own.
        basins = None if ended == "seconds" else both_attract(plane, search.unexplained)
    except KeyboardInterrupt:
        ended = "stopped"
    unexplained = search.unexplained
    parameters = unexplained.parameters(plane), largest_chain(unexplained).parameters(plane)
    separates_basins = np.full(len(unexplained), False) if basins is None else basins
    return MapCurves(
        plane.along,
        search.curves,
        search.border_count,
        search.border_count - len(unexplained),
        *parameters,
        separates_basins,
        ended,
    )


def check_budget(max_rounds: int = 8, max_seconds: float = math.inf) -> tuple[int, float]:
    """Return the largest number of rounds and of seconds of a search."""
    rounds = validation.validate_integer("max_rounds", max_rounds, 0, _MOST_ROUNDS)
    return rounds, validation.validate_real("max_seconds", max_seconds, "a positive number", lambda x: x > 0)


class _CurveSearch:
    """A search for the curves over a map: its curves so far, and the borders that none of them explains."""

    def __init__(
        self,
        plane: LabelledPlane,
        device: Harvester,
        max_points: int,
        settings: ContinuationSettings,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.unexplained, self.curves = borders(plane), list[BifurcationCurve]()
        self.border_count = len(self.unexplained)
        self._plane, self._device, self._max_points, self._settings = plane, device, max_points, settings
        self._progress = progress

    def run(self, max_rounds: int, round_borders: int, borders_at_limits: Borders, deadline: float) -> EndReason:
        """Search all over the map and at limits, then at remaining borders, in rounds.

        Returns the reason for which the search ended.
        """
        self._report_progress()
        cells = _lattice_cells(self._plane)
        axes = np.repeat([0, 1], len(cells))
        # Each cell is followed along both axes, without a bound on the distance.
        completed = self._follow_cells(np.tile(cells, (2, 1)), axes, np.inf, self._settings, deadline)
        # A fixed seed, so that the same map always gives the same curves.
        generator = np.random.default_rng(0)
        completed = completed and self._follow_limits(
            generator.permutation(len(borders_at_limits)), borders_at_limits, round_borders, deadline
        )
        # Numbers identify borders while the list of unexplained ones shrinks.
        untried, tried = self.unexplained, np.zeros(0, int)
        round_settings = dataclasses.replace(self._settings, first_step=_FIRST_STEP, max_step=_MAX_STEP)
        for _ in range(max_rounds):
            chosen = generator.permutation(len(untried))[:round_borders]
            if not chosen.size or not completed:
                break
            chosen_borders = untried[chosen]
            cells_and_axes = (
                np.concatenate([chosen_borders.cell, chosen_borders.other_cell]),
                np.tile(chosen_borders.axis, 2),
            )
            completed = self._follow_cells(*cells_and_axes, _BORDER_REACH, round_settings, deadline)
            # Borders without a result remain unexplained, and are not tried again.
            tried = np.append(tried, chosen_borders.number)
            untried = self.unexplained[~np.isin(self.unexplained.number, tried)]
        if not len(self.unexplained):
            return "explained"
        return "seconds" if not completed else "rounds" if len(untried) else "tried"

    def _follow_cells(
        self, cells: np.ndarray, axes: np.ndarray, reach: float, steps: ContinuationSettings, deadline: float
    ) -> bool:
        """Follow orbits of cells along an axis each, and curves from their bifurcations.

        Returns False if time ran out.
        """
        plane, vertical_gamma = self._plane, float(self._device.g / self._device.A)
        starts: list[CurveStart] = []
        for batch in seeds(plane, cells, axes, reach, vertical_gamma, _BRANCH_POINTS, steps):
            starts += batch
            if time.monotonic() > deadline:
                return False
        return self._follow_curves(starts, deadline)

    def _follow_limits(
        self, order: np.ndarray, borders_at_limits: Borders, round_borders: int, deadline: float
    ) -> bool:
        """Follow limits from cells next to them until a curve lies at each such border.

        Returns False if time ran out.
        """
        remaining = borders_at_limits[order]
        while len(remaining) and time.monotonic() < deadline:
            chosen_borders, remaining = (
                remaining[np.arange(len(remaining)) < round_borders],
                remaining[np.arange(len(remaining)) >= round_borders],
            )
            previous_count = len(self.curves)
            if not self._follow_curves(limit_seeds(self._plane, chosen_borders.cell, self._device), deadline):
                return False
            for curve in self.curves[previous_count:]:
                remaining = remaining[~near_curve(remaining, curve.values, self._plane)]
        return not len(remaining)

    def _follow_curves(self, starts: list[CurveStart], deadline: float) -> bool:
        """Follow curves from the starts that lie on no curve yet; return False if time ran out."""
        plane = self._plane
        with warnings.catch_warnings():
            # Suppress the warnings about starts without a real orbit next to them: many starts are tried, and some are
            # such.
            warnings.filterwarnings("ignore", message=".* begin no curve")
            existing = [*self.curves]
            for batch in curves_from(starts, plane.bounds, self._device, self._max_points, self._settings, existing):
                self.curves += batch
                # At a limit the label does not change, so that the curve of a limit explains no border.
                for curve in (item for item in batch if item.kind not in LIMITS):
                    self.unexplained = self.unexplained[~near_curve(self.unexplained, curve.values, plane)]
                self._report_progress()
                if time.monotonic() > deadline:
                    return False
        return True

    def _report_progress(self) -> None:
        if self._progress is not None:
            self._progress(self.border_count - len(self.unexplained), self.border_count)


def _lattice_cells(plane: LabelledPlane) -> np.ndarray:
    """Return periodic cells all over a map: the cells nearest to the points of a coarse lattice."""
    shape = np.array(plane.labels.shape)
    periodic = np.argwhere(plane.labels != "")
    # Points of the lattice in units of the map, half a spacing from its sides.
    lattice = (np.stack(np.meshgrid(*2 * [np.arange(_SPREAD)], indexing="ij"), axis=-1).reshape(-1, 2) + 0.5) / _SPREAD
    nearest = [np.abs(periodic / shape - point).sum(axis=1).argmin() for point in lattice]
    return periodic[np.unique(nearest)]
