"""Small multiples of a moving ball: panels of orbit diagrams, phase planes, Poincare sections and time series."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from vijax.plots.style import STYLE, save_figure

_STYLE: Any = STYLE | {
    "axes.titlesize": "medium",
    "axes.titlepad": 3.0,
    "axes.formatter.limits": (-4, 5),
    "axes.xmargin": 0.02,
    "legend.frameon": False,
    "lines.linewidth": 0.8,
    "savefig.dpi": 200,
}
_LAYER_STYLES: dict[str, dict[str, Any]] = {
    "dots": {"linestyle": "none", "marker": ".", "markersize": 1.7, "mew": 0},
    "line": {"linestyle": "-"},
    "thick": {"linestyle": "-", "linewidth": 1.6},
    "rings": {"linestyle": "none", "marker": "o", "markersize": 5.0, "mfc": "none", "mew": 0.8},
}
_WALL: dict[str, Any] = {"color": "firebrick", "linewidth": 1.4, "zorder": 0.5}
_MARK: dict[str, Any] = {"linestyle": (0, (4, 3)), "linewidth": 0.7, "zorder": 0.6}
_UNIT_WIDTH, _UNIT_HEIGHT = 1.75, 1.85  # inches per letter of a layout
_CAPTION_LETTERS = 21  # letters in a line of a caption, per inch of the figure


class Layer(NamedTuple):
    """Points of one colour.

    Attributes:
        x, y: Coordinates of any shape; NaN draws nothing and interrupts a line.
        colour: Colour of matplotlib.
        style: Style of the points.
        text: Text of the colour in the legend; empty for none.
    """

    x: Any
    y: Any
    colour: str
    style: Literal["dots", "line", "thick", "rings"] = "dots"
    text: str = ""


class Panel(NamedTuple):
    """A panel of small multiples.

    Attributes:
        title: Title after the letter.
        x, y: Labels of the axes, in the notation of matplotlib.
        layers: Drawn layers, from the bottom to the top.
        walls: Half the gap, for vertical lines at the walls of a phase plane; None for no lines.
        upright: Places of dashed red vertical lines.
        level: Heights of dashed horizontal lines, with their colour.
        log: Logarithmic axes: "", "x", "y" or "xy".
        span: Limits of x; None for the limits of the points.
        top: Upper limit of y, with a lower limit of about 0; None for the limits of the points.
    """

    title: str
    x: str
    y: str
    layers: Sequence[Layer]
    walls: float | None = None
    upright: Sequence[float] = ()
    level: Sequence[tuple[float, str]] = ()
    log: str = ""
    span: tuple[float, float] | None = None
    top: float | None = None


def phase_plane(title: str, layers: Sequence[Layer], d: float | None) -> Panel:
    """Return a panel of u' over u with the walls at +-d/2; d is None, without walls, for layers of several gaps."""
    return Panel(title, "$u$", r"$\dot{u}$", layers, walls=None if d is None else 0.5 * d)


def time_series(title: str, line: Any, impacts: tuple[Any, Any], d: float) -> Panel:
    """Return a panel of ball and walls over time in the frame of the ground, where flights are straight lines.

    The capsule moves by z = cos(pi t)/pi^2 (Z'' = -A cos(omega tau)) and is fastest when its walls pass +-d/2, the
    dashed blue lines.

    Args:
        title: Title of the panel.
        line: A record with t and u, as `vijax.orbits.motion.curve` returns.
        impacts: Times and displacements u of the impacts marked by rings.
        d: Gap.
    """
    shift = np.cos(np.pi * line.t) / np.pi**2
    fine = np.linspace(line.t[0], line.t[-1], 600)
    walls = [Layer(fine, side * 0.5 * d + np.cos(np.pi * fine) / np.pi**2, "firebrick", "line") for side in (1, -1)]
    when, where = (np.asarray(part) for part in impacts)
    ball = Layer(line.t, line.u + shift, "black", "line")
    rings = Layer(when, where + np.cos(np.pi * when) / np.pi**2, "black", "rings", "slow impacts")
    return Panel(
        title,
        "$t$",
        r"$u + \cos(\pi t)/\pi^2$",
        [*walls, ball, rings],
        level=[(side * 0.5 * d, "tab:blue") for side in (1, -1)],
        span=(float(line.t[0]), float(line.t[-1])),
    )


def small_multiples(
    panels: dict[str, Panel], layout: Sequence[str], caption: str = "", path: str | Path | None = None
) -> Figure:
    """Return a figure of panels over a legend and a caption; panels have legends if a colour has several meanings.

    Args:
        panels: Panels by their letter in the layout; a capital continues the panel of the small letter.
        layout: Rows of letters, as `Figure.subplot_mosaic` takes; "." leaves a place empty.
        caption: Text below the legend; this function breaks it into lines.
        path: Path of the picture; the suffix selects the format. None writes no file.

    Raises:
        ValueError: If the letters of the layout differ from the letters of the panels.
    """
    named = set("".join(layout)) - {"."}
    if named != set(panels):
        raise ValueError(f"layout must name the panels {sorted(panels)}; got {sorted(named)}")
    width, height = _UNIT_WIDTH * len(layout[0]), _UNIT_HEIGHT * len(layout)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        grid = figure.subplot_mosaic("\n".join(layout))
        for letter, panel in panels.items():
            _draw(grid[letter], letter, panel, max(row.count(letter) for row in layout))
        keys = {letter: _key(panel) for letter, panel in panels.items()}
        together = {text: handle for key in keys.values() for text, handle in key.items()}
        if len({handle.get_color() for handle in together.values()}) < len(together):
            for letter, key in keys.items():
                grid[letter].legend(key.values(), key, fontsize="small", handlelength=1.2)
            together = {}
        below = _wrapped(caption, int(_CAPTION_LETTERS * width))
        legend = figure.legend(
            together.values(), together, loc="outside lower center", ncols=max(1, len(together)), title=below
        )
        legend.get_title().set_fontsize("small")
        if path is not None:
            save_figure(figure, path)
    return figure


def _draw(axes: Axes, letter: str, panel: Panel, columns: int) -> None:
    name = f"({letter}) " if letter.islower() else ""
    axes.set_title(name + panel.title, loc="left")
    axes.set(xlabel=panel.x, ylabel=panel.y)
    axes.xaxis.set_major_locator(MaxNLocator(2 * columns + 1))
    for axis in panel.log:
        axes.set(**{f"{axis}scale": "log"})
    for layer in panel.layers:
        axes.plot(
            np.ravel(layer.x), np.ravel(layer.y), color=layer.colour, **_LAYER_STYLES[layer.style], rasterized=True
        )
    if panel.walls is not None:
        for side in (1, -1):
            axes.axvline(side * panel.walls, **_WALL)
    for place in panel.upright:
        axes.axvline(place, color="red", **_MARK)
    for height, colour in panel.level:
        axes.axhline(height, color=colour, **_MARK)
    if panel.span is not None:
        axes.set_xlim(panel.span)
    if panel.top is not None:
        axes.set_ylim(-0.05 * panel.top, panel.top)


def _key(panel: Panel) -> dict[str, Line2D]:
    """Return a handle of the legend for every text of a panel's layers."""
    return {
        layer.text: Line2D([], [], color=layer.colour, **_LAYER_STYLES["rings" if layer.style == "rings" else "thick"])
        for layer in panel.layers
        if layer.text
    }


def _wrapped(text: str, width: int) -> str:
    """Wrap a text to `width` letters; formulas between dollar signs are not broken."""
    lines, words, inside = [""], text.split(" "), False
    for word in words:
        fits = inside or len(lines[-1]) + len(word) < width
        if lines[-1] and fits:
            lines[-1] += " " + word
        else:
            lines.append(word)
        inside ^= word.count("$") % 2 == 1
    return "\n".join(line for line in lines if line)
