"""The search for curves over a map as the commands run it, and the lines that tell what it found."""

import time
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from vijax.cli import process
from vijax.cli.closing import how_many, pace
from vijax.cli.progress import progress, waiting

if TYPE_CHECKING:
    import xarray as xr

    from vijax.orbits.map_curves import MapCurves
    from vijax.planes.dataset import SweepPlan

_MOST_POINTS = 60  # Points of codimension 2 that are listed: all are in the store.
_ENDED = {
    "explained": "nothing is left",
    "tried": "the others were looked at in vain",
    "rounds": "all rounds were spent; more are had by --max-rounds",
    "seconds": "all seconds were spent; more are had by --max-seconds",
    "stopped": "the search was stopped",
}


def search(labelled: "xr.Dataset", budget: dict[str, Any]) -> "tuple[MapCurves, str]":
    """Find the curves over a map under a bar that counts borders; say how many points they have, and how fast."""
    from vijax.orbits.map_curves import bifurcation_curves

    began = time.perf_counter()
    with process.door(), progress(0, "borders") as show:
        waiting("orbits and curves, compiled at first")
        found = bifurcation_curves(labelled, progress=show, **budget)
    points = sum(len(curve.values) for curve in found.curves)
    return found, pace(points, time.perf_counter() - began, "points")


def summary(found: "MapCurves", dataset: "xr.Dataset | None" = None) -> Iterator[str]:
    """Say what curves there are, what of the map they explain, what is left of it, and what they meet."""
    kinds = Counter(curve.kind for curve in found.curves)
    told = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
    yield f"{how_many(len(found.curves), 'curves')}" + (f": {told}" if told else "")
    share = f", {found.explained / found.borders:.1%}" if found.borders else ""
    yield (
        f"borders between labels of periodic cells within a cell of a curve: {found.explained:,} of "
        f"{found.borders:,}{share}; {_ENDED[found.ended]}"
    )
    if found.basins.any():
        yield f"borders of basins among the others, where both motions attract on either side: {found.basins.sum():,}"
    if len(found.largest):
        low, high = found.largest.min(axis=0), found.largest.max(axis=0)
        names = found.along
        place = ", ".join(f"{name} {a:.4g} to {b:.4g}" for name, a, b in zip(names, low, high, strict=True))
        yield f"the largest piece that no curve explains: {how_many(len(found.largest), 'borders')}, {place}"
    if dataset is not None:
        yield from _points(dataset)


def _points(dataset: "xr.Dataset") -> Iterator[str]:
    """List the points of codimension 2 by the numbers that they have in the picture."""
    from vijax.orbits.curve_rows import numbered_points

    listed, names = numbered_points(dataset), dataset.attrs["along"].split()
    if listed:
        yield f"{'':>4}  {'codimension 2':<20}" + "".join(f"{name:>22}" for name in names)
    for one in listed[:_MOST_POINTS]:
        yield f"{one.number:>4}  {one.kind:<20}" + "".join(f"{value:>22.14g}" for value in one.place)
    if len(listed) > _MOST_POINTS:
        yield f"      and {len(listed) - _MOST_POINTS} more"


def check_map(planned: "SweepPlan") -> None:
    """Raise ValueError unless curves can be followed in the plane of a map that is yet to be run."""
    import xarray as xr

    from vijax.orbits import map_borders
    from vijax.orbits.parameter import MOVED
    from vijax.planes.dataset import asked, coordinates

    several = [name for name, size in planned.cells.sizes.items() if size > 1]
    if len(several) != 2 or set(several) != set(planned.cells.dynamic):
        raise ValueError(
            f"two of {', '.join(MOVED)} that the motion depends on, and nothing else, must have several values "
            f"for curves; got {', '.join(several) or 'none'}"
        )
    plane = xr.Dataset(coords=coordinates(planned.cells), attrs=asked(planned))
    map_borders.check_map(plane, planned.cells.dynamic)
