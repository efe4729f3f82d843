"""What all pictures share: fonts, files and their mark, how quantities are written, in how many panels a map fits.

Known before a run: nothing here loads matplotlib.
"""

import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.model.quantities import MEASURED, PARAMETERS, synonyms
from vijax.runtime import checks
from vijax.runtime.files import replacing

if TYPE_CHECKING:
    import xarray as xr


STYLE: Any = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9,
    "axes.linewidth": 0.6,
    "hatch.linewidth": 0.4,
    "savefig.dpi": 250,
}
# Endings of pictures, each with the entry of its metadata that names what drew it.
_DRAWN_WITH = {".png": "Software", ".pdf": "Creator", ".svg": "Creator", ".eps": "Creator"}
_MARK = "drawn by vijax"
# Worth a place in the title: neither the start, nor a quantity under a second name. Those a physical sweep may hold.
CONSTANTS = tuple(name for name in PARAMETERS if name == synonyms(name)[0])
FURTHER = tuple(name for name in PARAMETERS if name not in CONSTANTS)


def check_format(path: str | Path) -> None:
    """Raise ValueError unless the path ends as a picture does."""
    if checks.path("plot", path).suffix not in _DRAWN_WITH:
        raise ValueError(f"plot must end in {', '.join(_DRAWN_WITH)}; got {checks.shown(str(path))}")


def save_figure(figure: Any, path: str | Path) -> None:
    """Save a picture, whole or not at all, with a mark by which `is_drawn` knows it."""
    check_format(path)
    with replacing(Path(path)) as part:
        figure.savefig(part, metadata={_DRAWN_WITH[part.suffix]: _MARK})


def is_drawn(path: Path) -> bool:
    """Tell whether a file is a picture that vijax drew and nothing else has saved since."""
    return path.is_file() and _MARK.encode() in path.read_bytes()


def title(dataset: "xr.Dataset", further: tuple[str, ...] = ()) -> str:
    """Say what a dataset holds constant: its wall, its scalar parameters, and `further` ones where they are given."""
    names = [name for name in (*CONSTANTS, *further) if name in dataset.coords and not dataset[name].ndim]
    wall = [f"{dataset.attrs['wall']} walls"] if "wall" in dataset.attrs else []
    return ", ".join([*wall, equations(dataset, names)])


def axis_label(coordinate: "xr.DataArray") -> str:
    """Write symbol and units of a coordinate: omega [rad/s]."""
    written = units(coordinate)
    return symbol(coordinate) + (f" [{written}]" if written else "")


def symbol(coordinate: "xr.DataArray") -> str:
    """Give the symbol of a coordinate, or its name."""
    return f"${coordinate.attrs.get('symbol', coordinate.name)}$"


def equations(dataset: "xr.Dataset", names: list[str]) -> str:
    """Write the values of scalar coordinates: r = 0.5, omega = 3.14 rad/s."""
    scalars = [dataset[name] for name in names]
    return ", ".join(f"{symbol(scalar)} = {float(scalar):.4g} {units(scalar)}".strip() for scalar in scalars)


def units(coordinate: "xr.DataArray") -> str:
    """Give the units of a coordinate for print; none of a pure number."""
    plain = coordinate.attrs.get("units", "1")
    return "" if plain == "1" else re.sub(r"(-?\d+)", r"$^{\1}$", plain)


NEEDS = ("P", "period", "admissible")
EXPECTED_NEEDS = ("P", "attractors", "undecided", "admissible")
LABEL_NEEDS = ("period", "impacts_left", "impacts_right", "status")
MOST_PANELS = 36  # A map has so many at most: more are too small to read.


def layout(sizes: Mapping[str, int]) -> tuple[int, int]:
    """Lay panels in rows and columns for a map whose dimensions are, in order, x, y, columns and rows.

    Args:
        sizes: Length of every dimension of P; those of length one are not drawn.

    Raises:
        ValueError: If no picture can be made of it: why, and what to take away.
    """
    drawn = {dim: size for dim, size in sizes.items() if size > 1}
    if not drawn:
        raise ValueError("plot must have an axis of more than one value; got a single cell")
    if len(drawn) > 4:
        raise ValueError(f"plot must have at most 4 axes; got {', '.join(drawn)}; keep some of them at one value")
    panels = dict(itertools.islice(drawn.items(), 2, None))
    count = math.prod(panels.values())
    if count > MOST_PANELS:
        got = " x ".join(f"{size} values of {dim}" for dim, size in panels.items())
        raise ValueError(f"plot must have at most {MOST_PANELS} panels; got {got}; give the two longest axes first")
    columns = min(count, 3) if len(panels) < 2 else next(iter(panels.values()))
    return math.ceil(count / columns), columns


def layout_of_kinds(sizes: Mapping[str, int]) -> tuple[int, int]:
    """Lay panels as `layout` does, for a map of labels or basins, which a curve cannot show."""
    drawn = [dim for dim, size in sizes.items() if size > 1]
    if len(drawn) == 1:
        raise ValueError(f"plot must have two axes of more than one value; got {drawn[0]} alone")
    return layout(sizes)


def is_kind(variable: Any) -> bool:
    """Say whether a variable tells of what kind a cell is, and not how much there is of something."""
    return variable.dtype == bool or "flag_values" in variable.attrs


QUANTITIES = {name: measured.label for name, measured in MEASURED.items() if measured.label}
