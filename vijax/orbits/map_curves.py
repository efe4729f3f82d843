"""The curves that explain a map: begun where orbits of its cells bifurcate, until its borders lie at curves."""

import dataclasses
import warnings
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.orbits.continuation_settings import ContinuationSettings, check_settings
from vijax.orbits.curve_starts import CurveStart
from vijax.orbits.curves import BifurcationCurve, curves_from
from vijax.orbits.map_borders import Borders, LabelledPlane, borders, labelled_plane, near
from vijax.orbits.map_seeds import seeds
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

_SPREAD = 5  # so many cells a side are followed across the whole map at first
_WHOLE_POINTS = 300  # Most points of each such branch.
_REACH = 3.0  # cells on either side of a border that is looked at
_FIRST_STEP, _MAX_STEP = 0.02, 0.05  # across them, in units of all that way

_SETTINGS = ContinuationSettings(max_grazings=0)


class MapCurves(NamedTuple):
    """Curves of bifurcations over a map.

    Attributes:
        curves: Each once.
        borders: How many pairs of neighbouring periodic cells of the map differ in their label.
        explained: How many of these lie within one cell of a curve.
    """

    curves: list[BifurcationCurve]
    borders: int
    explained: int


@door
def bifurcation_curves(
    dataset: "xr.Dataset",
    *,
    device: Harvester | None = None,
    max_rounds: int = 8,
    round_borders: int = 48,
    max_points: int = 2000,
    settings: ContinuationSettings = _SETTINGS,
) -> MapCurves:
    """Find the curves of bifurcations that explain a map of labels over two parameters.

    Orbits of a few cells all over the map are followed along both of its axes, and curves from what they meet. Then, in
    rounds, orbits on both sides of borders at which no curve lies are followed across these, and curves from there.

    Args:
        dataset: What `vijax.sweep` returned, over two parameters, with period, impacts and status.
        device: Of the map, where one is not Tables I and II: along "beta" g/A is read.
        max_rounds: Rounds, after the first look, at most; it ends sooner where one finds nothing.
        round_borders: Borders that are looked at in a round, drawn from all that are left.
        max_points: Most points of a curve each way.
        settings: Of steps and events. By default curves end at grazes: beyond, other cells of the map begin others.

    Returns:
        The curves, and how many borders of the map they explain. Others may be those of basins, not of bifurcations.

    Raises:
        ValueError: No map of labels over two parameters, or one without periodic cells.
    """
    max_rounds = checks.whole("max_rounds", max_rounds, 0, 1000)
    round_borders = checks.whole("round_borders", round_borders, 1, 10_000)
    max_points, settings = checks.whole("max_points", max_points, 2, 10**6), check_settings(settings)
    device = one_device(device)
    plane = labelled_plane(dataset)
    steepest = float(device.g / device.A)
    left, draw = borders(plane), np.random.default_rng(0)
    total, found = len(left), list[BifurcationCurve]()

    def go_on(starts: list[CurveStart]) -> None:
        nonlocal left
        with warnings.catch_warnings():
            # Many are tried, and some lie where a ball just no longer flies.
            warnings.filterwarnings("ignore", message=".* begin no curve")
            new = curves_from(starts, plane.bounds, device, max_points, settings, found)
        found.extend(new)
        for curve in new:
            left = left[~near(left, curve.values, plane)]

    cells = _spread(plane)
    both = np.repeat([0, 1], len(cells))
    go_on(seeds(plane, np.tile(cells, (2, 1)), both, np.inf, steepest, _WHOLE_POINTS, settings))
    short = dataclasses.replace(settings, first_step=_FIRST_STEP, max_step=_MAX_STEP)
    untried = left
    for _ in range(max_rounds):
        chosen = draw.permutation(len(untried))[:round_borders]
        if not chosen.size:
            break
        some = untried[chosen]
        across = some.cell + np.eye(2, dtype=int)[some.axis]
        cells, ways = np.concatenate([some.cell, across]), np.tile(some.axis, 2)
        go_on(seeds(plane, cells, ways, _REACH, steepest, _WHOLE_POINTS, short))
        untried = _without(left, some)
    return MapCurves(found, total, total - len(left))


def _spread(plane: LabelledPlane) -> np.ndarray:
    """Choose periodic cells all over a map: those next to the points of a coarse lattice."""
    shape = np.array(plane.names.shape)
    periodic = np.argwhere(plane.names != "")
    lattice = (np.stack(np.meshgrid(*2 * [np.arange(_SPREAD)], indexing="ij"), axis=-1).reshape(-1, 2) + 0.5) / _SPREAD
    away = [np.abs(periodic / shape - point).sum(axis=1).argmin() for point in lattice]
    return periodic[np.unique(away)]


def _without(left: Borders, tried: Borders) -> Borders:
    """Keep the borders that were not tried."""

    def keys(of: Borders) -> list[tuple[int, ...]]:
        return [(*map(int, cell), int(axis)) for cell, axis in zip(of.cell, of.axis, strict=True)]

    known = set(keys(tried))
    return left[np.array([key not in known for key in keys(left)], bool)]
