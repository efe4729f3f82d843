"""What all pictures share: fonts, files and their mark, how quantities and their values are written."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax import checks
from vijax.files import replacing

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
# Worth a place in the title: neither the start, nor a quantity under a second name.
CONSTANTS = ("d", "kappa", "r", "gamma", "omega", "A")


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
    """What a dataset holds constant: its wall, its scalar parameters, and `further` ones where they are given."""
    names = [name for name in (*CONSTANTS, *further) if name in dataset.coords and not dataset[name].ndim]
    wall = [f"{dataset.attrs['wall']} walls"] if "wall" in dataset.attrs else []
    return ", ".join([*wall, equations(dataset, names)])


def axis_label(coordinate: "xr.DataArray") -> str:
    """Symbol and units of a coordinate: omega [rad/s]."""
    written = units(coordinate)
    return symbol(coordinate) + (f" [{written}]" if written else "")


def symbol(coordinate: "xr.DataArray") -> str:
    """Symbol of a coordinate, or its name."""
    return f"${coordinate.attrs.get('symbol', coordinate.name)}$"


def equations(dataset: "xr.Dataset", names: list[str]) -> str:
    """The values of scalar coordinates: r = 0.5, omega = 3.14 rad/s."""
    scalars = [dataset[name] for name in names]
    return ", ".join(f"{symbol(scalar)} = {float(scalar):.4g} {units(scalar)}".strip() for scalar in scalars)


def units(coordinate: "xr.DataArray") -> str:
    """Units of a coordinate for print; none of a pure number."""
    plain = coordinate.attrs.get("units", "1")
    return "" if plain == "1" else re.sub(r"(-?\d+)", r"$^{\1}$", plain)
