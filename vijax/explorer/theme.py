"""Colours and words of the page: those of the pictures of `vijax.plots`, and symbols as a screen writes them."""

import html

from vijax.model.quantities import AXES, parted

COLOURS = {
    "wall": "#b0b0b0",
    "membrane": "#1f77b4",
    "impact": "#d62728",
    "harvested": "#2ca02c",
    "given": "#c65f00",
    "refused": "#ff0000",
    "rising": "#1f77b4",
    "falling": "#d62728",
    "pick": "#6a3d9a",
    "unstable": "#ff0000",
}
"""Of what figures draw: as in `plots.motions`, `plots.orbit_diagrams` and `plots.branch_diagrams`."""

AXIS = {"line": "#6b6b6b", "text": "#222222"}

_GREEK = {
    "kappa": "\u03ba",
    "gamma": "\u03b3",
    "omega": "\u03c9",
    "omega0": "\u03c9\u2080",
    "beta": "\u03b2",
    "u0": "u\u2080",
    "v0": "v\u2080",
}


def symbol(name: str) -> str:
    """Write the symbol of an axis; of one wall's with the name of the wall."""
    quantity, side = parted(name)
    return " ".join(filter(None, (_GREEK.get(quantity, quantity), side)))


def written(name: str) -> str:
    """Write an axis with its unit and what it is: omega [rad/s], angular frequency of the forcing."""
    axis = AXES[name]
    unit = f" [{unit_of(name)}]" if axis.unit else ""
    return f"{symbol(name)}{unit}, {axis.text}"


def unit_of(name: str) -> str:
    """Write the unit of an axis: m/s\u00b2."""
    return AXES[name].unit.replace("^2", "\u00b2")


def amount(value: float, unit: str = "", digits: int = 6) -> str:
    """Write a number with its unit, to so many digits."""
    return f"{value:.{digits}g} {unit}".rstrip()


def plain(text: str) -> str:
    """Write a text of whatever origin into HTML, where it stays a text."""
    return html.escape(text, quote=True)
