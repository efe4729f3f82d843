"""Colours of the page, as in the pictures of `vijax.plots`, and symbols, units and numbers as text for a screen."""

import html

from vijax.model.quantities import AXES, split_wall

COLOURS = {
    "wall": "#b0b0b0",
    "membrane": "#1f77b4",
    "impact": "#d62728",
    "harvested": "#2ca02c",
    "transferred": "#c65f00",
    "inadmissible": "#ff0000",
    "rising": "#1f77b4",
    "falling": "#d62728",
    "pick": "#6a3d9a",
    "unstable": "#ff0000",
}
"""Colours of the figures, as in `plots.motions`, `plots.orbit_diagrams` and `plots.branch_diagrams`."""

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
    """Return the symbol of an axis, followed by the wall for an axis of one wall: "\u03ba left" for kappa_left."""
    quantity, side = split_wall(name)
    return " ".join(filter(None, (_GREEK.get(quantity, quantity), side)))


def axis_text(name: str) -> str:
    """Return the symbol, unit and description of an axis: omega [rad/s], angular frequency of the forcing."""
    axis = AXES[name]
    unit = f" [{unit_of(name)}]" if axis.unit else ""
    return f"{symbol(name)}{unit}, {axis.text}"


def unit_of(name: str) -> str:
    """Return the unit of an axis as text for a screen, such as m/s\u00b2."""
    return AXES[name].unit.replace("^2", "\u00b2")


def amount(value: float, unit: str = "", digits: int = 6) -> str:
    """Return the text of a number with `digits` significant digits, and of its unit."""
    return f"{value:.{digits}g} {unit}".rstrip()


def plain(text: str) -> str:
    """Return a text escaped for HTML, so that no part of it is interpreted as markup."""
    return html.escape(text, quote=True)
