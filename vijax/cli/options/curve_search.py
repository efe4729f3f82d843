"""Search for the bifurcation curves of a map, with a progress bar, and the lines that summarise the result."""

import time
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from vijax.cli import process
from vijax.cli.closing import format_count, rate_text
from vijax.cli.progress import progress, waiting

if TYPE_CHECKING:
    import xarray as xr

    from vijax.continuation.from_map.map_curves import MapCurves
    from vijax.maps.map_dataset import SweepPlan

_MOST_POINTS = 60  # points of codimension 2 listed in the terminal; the store has all
# Texts of the reasons why the search ended. A border is an edge between two cells with different attractors.
_ENDED = {
    "explained": "no border remains",
    "tried": "the search at the others had no result",
    "rounds": "all rounds were used; --max-rounds allows more",
    "seconds": "all seconds were used; --max-seconds allows more",
    "stopped": "the search was stopped",
}


def search(labelled: "xr.Dataset", budget: dict[str, Any]) -> "tuple[MapCurves, str]":
    """Search for the bifurcation curves of a map; return the curves, and a line with the points per second.

    A progress bar counts the borders of the map, which are edges between cells with different attractors.
    """
    from vijax.continuation.from_map.map_curves import bifurcation_curves

    began = time.perf_counter()
    with process.usage_errors(), progress(0, "borders") as show:
        waiting("orbits and curves, compiled at first")
        result = bifurcation_curves(labelled, progress=show, **budget)
    points = sum(len(curve.values) for curve in result.curves)
    return result, rate_text(points, time.perf_counter() - began, "points")


def summary(result: "MapCurves", dataset: "xr.Dataset | None" = None) -> Iterator[str]:
    """Yield lines with the curves by kind, the borders that curves explain, the others, and codimension-2 points."""
    kinds = Counter(curve.kind for curve in result.curves)
    counts = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
    yield f"{format_count(len(result.curves), 'curves')}" + (f": {counts}" if counts else "")
    share = f", {result.explained / result.borders:.1%}" if result.borders else ""
    yield (
        f"borders between labels of periodic cells within a cell of a curve: {result.explained:,} of "
        f"{result.borders:,}{share}; {_ENDED[result.ended]}"
    )
    if result.separates_basins.any():
        yield (
            "borders of basins among the others, where both motions attract on either side: "
            f"{result.separates_basins.sum():,}"
        )
    if len(result.largest_unexplained):
        low, high = result.largest_unexplained.min(axis=0), result.largest_unexplained.max(axis=0)
        names = result.along
        place = ", ".join(f"{name} {a:.4g} to {b:.4g}" for name, a, b in zip(names, low, high, strict=True))
        yield (
            "the largest piece that no curve explains: "
            f"{format_count(len(result.largest_unexplained), 'borders')}, {place}"
        )
    if dataset is not None:
        yield from _points(dataset)


def _points(dataset: "xr.Dataset") -> Iterator[str]:
    """Yield the lines of a table of the codimension-2 points, each with its number in the picture."""
    from vijax.continuation.curves.curve_table import numbered_points

    listed, names = numbered_points(dataset), dataset.attrs["along"].split()
    if listed:
        yield f"{'':>4}  {'codimension 2':<20}" + "".join(f"{name:>22}" for name in names)
    for point in listed[:_MOST_POINTS]:
        yield f"{point.number:>4}  {point.kind:<20}" + "".join(f"{value:>22.14g}" for value in point.parameters)
    if len(listed) > _MOST_POINTS:
        yield f"      and {len(listed) - _MOST_POINTS} more"


def check_map(sweep_plan: "SweepPlan") -> None:
    """Raise ValueError unless the planned map is a plane of two parameters where curves can be continued."""
    import xarray as xr

    from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS
    from vijax.continuation.from_map import map_borders
    from vijax.maps.map_dataset import coordinates, request_attributes

    several = [name for name, size in sweep_plan.cells.sizes.items() if size > 1]
    if len(several) != 2 or set(several) != set(sweep_plan.cells.dynamic):
        raise ValueError(
            f"two of {', '.join(AFFECTED_CONSTANTS)} that the motion depends on, "
            "and nothing else, must have several values "
            f"for curves; got {', '.join(several) or 'none'}"
        )
    plane = xr.Dataset(coords=coordinates(sweep_plan.cells), attrs=request_attributes(sweep_plan))
    map_borders.check_map(plane, sweep_plan.cells.dynamic)
