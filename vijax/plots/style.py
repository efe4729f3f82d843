"""Shared properties of all pictures: fonts, file formats and their mark, text of quantities, layout of panels.

This module does not load matplotlib, so that its checks can precede a simulation without delay.
"""

import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.model.quantities import PARAMETERS, RESULT_QUANTITIES, synonyms
from vijax.runtime import validation
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
# Endings of picture files, each with the metadata entry that names the drawing program.
_DRAWN_WITH = {".png": "Software", ".pdf": "Creator", ".svg": "Creator", ".eps": "Creator"}
_MARK = "drawn by vijax"
# Parameters in a title, one name per quantity and without the start. `FURTHER` are the other names of these quantities,
# which sweeps of physical parameters have.
CONSTANTS = tuple(name for name in PARAMETERS if name == synonyms(name)[0])
FURTHER = tuple(name for name in PARAMETERS if name not in CONSTANTS)


def check_format(path: str | Path) -> None:
    """Raise ValueError unless the path has the ending of a picture."""
    if validation.validate_path("plot", path).suffix not in _DRAWN_WITH:
        raise ValueError(f"plot must end in {', '.join(_DRAWN_WITH)}; got {validation.value_text(str(path))}")


def save_figure(figure: Any, path: str | Path) -> None:
    """Save a picture, completely or not at all, with the mark that `is_drawn` recognises."""
    check_format(path)
    with replacing(Path(path)) as part:
        figure.savefig(part, metadata={_DRAWN_WITH[part.suffix]: _MARK})


def is_drawn(path: Path) -> bool:
    """Return True if a file is a picture drawn by vijax and not saved by another program since."""
    return path.is_file() and _MARK.encode() in path.read_bytes()


def title(dataset: "xr.Dataset", further: tuple[str, ...] = ()) -> str:
    """Return the constants of a dataset as text: its wall, its scalar parameters, and `further` ones if present."""
    names = [name for name in (*CONSTANTS, *further) if name in dataset.coords and not dataset[name].ndim]
    wall = [f"{dataset.attrs['wall']} walls"] if "wall" in dataset.attrs else []
    return ", ".join([*wall, equations(dataset, names)])


def axis_label(coordinate: "xr.DataArray") -> str:
    """Return symbol and units of a coordinate: omega [rad/s]."""
    unit_text = units(coordinate)
    return symbol(coordinate) + (f" [{unit_text}]" if unit_text else "")


def symbol(coordinate: "xr.DataArray") -> str:
    """Return the symbol of a coordinate, or its name."""
    return f"${coordinate.attrs.get('symbol', coordinate.name)}$"


def equations(dataset: "xr.Dataset", names: list[str]) -> str:
    """Return the values of scalar coordinates as text: r = 0.5, omega = 3.14 rad/s."""
    scalars = [dataset[name] for name in names]
    return ", ".join(f"{symbol(scalar)} = {float(scalar):.4g} {units(scalar)}".strip() for scalar in scalars)


def units(coordinate: "xr.DataArray") -> str:
    """Return the units of a coordinate with exponents as superscripts of mathtext; "" for a pure number."""
    unit_text = coordinate.attrs.get("units", "1")
    return "" if unit_text == "1" else re.sub(r"(-?\d+)", r"$^{\1}$", unit_text)


NEEDS = ("P", "period", "admissible")
EXPECTED_NEEDS = ("P", "attractors", "undecided", "admissible")
LABEL_NEEDS = ("period", "impacts_left", "impacts_right", "status")
MOST_PANELS = 36  # most panels of a map; more would be too small to read


def layout(sizes: Mapping[str, int]) -> tuple[int, int]:
    """Return the rows and columns of panels for a map with the dimensions x, y, columns and rows, in this order.

    Args:
        sizes: Length of every dimension of P; dimensions of length one are not drawn.

    Raises:
        ValueError: No picture can show the map; the message states the reason and the dimensions to remove.
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
    """Return the rows and columns of panels as `layout` does; raise ValueError if a map of kinds has a single axis."""
    drawn = [dim for dim, size in sizes.items() if size > 1]
    if len(drawn) == 1:
        raise ValueError(f"plot must have two axes of more than one value; got {drawn[0]} alone")
    return layout(sizes)


def is_kind(variable: Any) -> bool:
    """Return True if a variable is a kind (boolean or with flags) and not an amount."""
    return variable.dtype == bool or "flag_values" in variable.attrs


QUANTITIES = {name: measured.label for name, measured in RESULT_QUANTITIES.items() if measured.label}
