"""Charts of curves and points: orbit diagrams, work against precision, limits of stability."""

import itertools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from vijax import checks
from vijax.style import STYLE, axis_label, check_format, save_figure, symbol, title, units

if TYPE_CHECKING:
    import xarray as xr

_OUTLINE: dict[str, Any] = {
    "color": "red",
    "linewidth": 1.2,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}


def stability_map(found: Any, path: str | Path | None = None) -> Figure:
    """Where an explicit method stays bounded over stiffness and steps per period, under the boundary of theory.

    Args:
        found: A record with `kappa` [K] and `steps` [S], both ascending, `stable` [S, K], and `least_steps` [K], the
            boundary.
        path: Where to write it, if anywhere; the ending chooses the format.

    Raises:
        ValueError: If the path does not end as a picture does.
    """
    if path is not None:
        check_format(path)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.8), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel=r"$\kappa$", ylabel="RK4 steps per period")
        axes.pcolormesh(found.kappa, found.steps, found.stable, cmap="Blues_r", vmin=-1, vmax=1.5, rasterized=True)
        axes.plot(found.kappa, found.least_steps, **_OUTLINE)
        axes.set(xlim=found.kappa[[0, -1]], ylim=found.steps[[0, -1]])
        shades = (Patch(color=mpl.colormaps["Blues_r"](shade)) for shade in (0.8, 0.4))
        handles = [*shades, Line2D([], [], **_OUTLINE)]
        texts = ["bounded", "blown up within 50 periods", "theory"]
        figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)
        if path is not None:
            save_figure(figure, path)
    return figure


# --- orbit diagrams -------------------------------------------------------------------------------

_QUANTITIES = {
    "v_in": r"$v_\mathrm{in}$, velocity at the impact",
    "v_out": r"$v_\mathrm{out}$, velocity after the impact",
    "restitution": r"$-v_\mathrm{out} / v_\mathrm{in}$, effective restitution",
    "phase": "phase of the impact [half forcing periods]",
    "duration": "duration of the contact [half forcing periods]",
    "depth": "penetration [m]",
    "E": r"$E_j$, energy of the impact [J]",
    "P": "$P$ [J per half period]",
    "u_strobe": "$u$ at phase 0",
    "v_strobe": r"$\dot{u}$ at phase 0",
}
_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#17a2b8", "#8c564b", "#e377c2", "black", "0.5")
_WAYS = {"down": r"falling $\longleftarrow$", "up": r"rising $\longrightarrow$"}
_POINT: dict[str, Any] = {"linestyle": "none", "marker": ".", "mew": 0, "rasterized": True}
_OTHER_WAY = "0.8"
# Energies of soft and stiff walls lie decades apart; grazing impacts so far below the greatest are left out.
_LOGARITHMIC, _DECADES = ("depth", "E", "P"), 8
_FURTHER = ("s", "omega0", "k", "beta")  # what a physical sweep holds constant besides


def orbit_diagram(dataset: "xr.Dataset", path: str | Path | None = None, quantity: str = "v_in") -> Figure:
    """A quantity of every kept impact against the axis swept, a colour for each value of the other axis.

    Of a diagram in both directions each has its panel, the other one's points in grey behind its own: grey that shows
    is another attractor.

    Args:
        dataset: What `vijax.diagram.orbit_diagram` returned, with at most one axis besides the one swept.
        path: Where to write it, if anywhere; the ending chooses the format.
        quantity: A variable over impacts, strobes or points.

    Raises:
        ValueError: A quantity that is none, more axes or values than a picture can hold, a format that is none.
    """
    check_quantity(quantity)
    checks.variables("dataset", dataset, ("P", quantity), "orbit_diagram")
    along = dataset.attrs["along"]
    others = check_layout(along, {str(dim): dataset.sizes[dim] for dim in dataset["P"].dims})
    if path is not None:
        check_format(path)
    ways = (
        [str(way) for way in dataset["direction"].values]
        if "direction" in dataset.dims
        else [dataset.attrs["direction"]]
    )
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 1.4 + 2.9 * len(ways)), layout="constrained")
        panels = figure.subplots(len(ways), sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, way in zip(panels, ways, strict=True):
            for other in ways:
                if other != way:
                    _cloud(axes, _way(dataset, other), quantity, others, _OTHER_WAY)
            _cloud(axes, _way(dataset, way), quantity, others)
            axes.set_title(f"{symbol(dataset[along])} {_WAYS[way]}", loc="left", fontsize="medium")
            axes.set_ylabel(_QUANTITIES[quantity])
            axes.margins(x=0.01)
        if quantity in _LOGARITHMIC:
            most = float(dataset[quantity].max())
            panels[0].set(yscale="log", ylim=(most / 10**_DECADES, 2 * most) if most > 0 else None)
        panels[-1].set_xlabel(axis_label(dataset[along]))
        figure.suptitle(title(dataset, _FURTHER), fontsize="medium")
        _explain(figure, dataset, others, ways)
        if path is not None:
            save_figure(figure, path)
    return figure


def check_quantity(quantity: str) -> None:
    """Raise ValueError unless an orbit diagram can be drawn of it."""
    checks.choice("quantity", quantity, _QUANTITIES)


def check_layout(along: str, sizes: Mapping[str, int]) -> list[str]:
    """The axis that colours stand for, if there is one.

    Raises:
        ValueError: If there are several, or more values than colours.
    """
    others = {dim: size for dim, size in sizes.items() if dim not in ("direction", along) and size > 1}
    if len(others) > 1:
        raise ValueError(f"plot must have at most one axis besides {along}; got {', '.join(others)}; keep one of them")
    for name, size in others.items():
        if size > len(_COLOURS):
            raise ValueError(f"plot must have at most {len(_COLOURS)} values of {name}, a colour each; got {size}")
    return list(others)


def _way(dataset: "xr.Dataset", way: str) -> "xr.Dataset":
    return dataset.sel(direction=way) if "direction" in dataset.dims else dataset


def _cloud(axes: Axes, dataset: "xr.Dataset", quantity: str, others: list[str], colour: str | None = None) -> None:
    """The points of one direction, in one colour or in those of the other axis."""
    along = dataset.attrs["along"]
    single = [dim for dim in dataset["P"].dims if dim != along and dim not in others]
    found = dataset[quantity].squeeze(single).transpose(*others, along, ...)
    places = dataset[along]
    for values, own in zip(found.values if others else [found.values], _COLOURS, strict=False):
        values = values.reshape(places.size, -1)
        x = np.broadcast_to(places.values[:, None], values.shape)
        there = np.isfinite(values)
        axes.plot(x[there], values[there], color=colour or own, markersize=_size(places.size), **_POINT)


def _size(columns: int) -> float:
    """Size of a point among so many columns of points."""
    return float(np.clip(300 / columns, 1.4, 2.8))


def _explain(figure: Figure, dataset: "xr.Dataset", others: list[str], ways: list[str]) -> None:
    """Which colour stands for what, below the panels."""
    colours: list[str] = []
    texts: list[str] = []
    for name in others:
        of = dataset[name]
        colours += _COLOURS[: of.size]
        texts += [f"{symbol(of)} = {value:.4g} {units(of)}".strip() for value in of.values]
    if len(ways) > 1:
        colours.append(_OTHER_WAY)
        texts.append("the other direction")
    handles = [Line2D([], [], color=colour, **_POINT | {"markersize": 8}) for colour in colours]
    if handles:
        figure.legend(
            handles, texts, loc="outside lower center", ncols=min(len(texts), 6), frameon=False, handlelength=1
        )


# --- work against precision -----------------------------------------------------------------------

# The same colour for a method everywhere: vijax in strong colours and whole lines, its peers dashed.
_METHODS: dict[str, tuple[str, str]] = {
    "exact": ("#d62728", "-"),
    "exact float32": ("#ff7f0e", "-"),
    "ode Tsit5": ("#1f77b4", "-"),
    "ode Dopri8": ("#17a2b8", "-"),
    "ode Kvaerno5": ("#7b5fc7", "-"),
    "rk4": ("#8c564b", "-"),
    "numba RK4": ("#c49a6c", "--"),
    "numba DP5 + events": ("#2ca02c", "--"),
    "diffrax restarts": ("#6baed6", "--"),
    "SciPy DOP853": ("0.35", "--"),
    "SciPy Radau": ("0.6", "--"),
}
_MEASURES = {
    "state": "error of the state",
    "power": "bias of mean $P$ / standard error",
    "gradient": "relative error of the gradient",
}
_HOW_TO_READ = (
    "down and to the left is better; the grey stairs are the best there is at each cost\n"
    "whole lines: vijax; dashed: its peers; crosses: no result"
)
_COLUMNS = 3
_ROUNDING = 1e-16  # an error below is drawn there
_NOISE = 2.0  # standard errors that mean nothing
_LEAST = 1.0  # fewer are drawn as so many: there is no better and worse among them
_LABEL_GAP = 0.052  # between labels, of the height of a panel


def work_precision(rows: Iterable[Any], path: str | Path | None = None) -> Figure:
    """Error against cost, a panel a scene: down and to the left is better, and the grey stairs are what can be had.

    Args:
        rows: Records with scene, measure ("state", "power", "gradient"), method, us (microseconds per cell-period),
            error and noise (its standard error, of averages), in the order of panels and of settings. An infinite
            error is drawn as a cross on the upper edge.
        path: Picture to write.

    Raises:
        ValueError: A format that is none.
    """
    if path is not None:
        check_format(path)
    scenes: dict[str, list[Any]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    columns = min(_COLUMNS, len(scenes))
    lines = math.ceil(len(scenes) / columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.4 * columns, 3.0 * lines + 0.3), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False)
        span = _decades([row.us for panel in scenes.values() for row in panel])
        for axes, panel in itertools.zip_longest(grid.flat, scenes.items()):
            if panel is None:
                axes.set_visible(False)
            else:
                axes.set_xlim(span)
                _work_panel(axes, *panel)
        figure.suptitle(_HOW_TO_READ, fontsize="medium")
        figure.supxlabel("microseconds per cell-period, warm", fontsize="medium")
        if path is not None:
            save_figure(figure, path)
    return figure


def _decades(values: list[float]) -> tuple[float, float]:
    """Limits of a logarithmic axis, with room for labels to the right."""
    return min(values) / 2, max(values) * 20


def _work_panel(axes: Axes, title: str, rows: list[Any]) -> None:
    measure = rows[0].measure
    errors = [row.error / row.noise if row.noise else row.error for row in rows]
    finite = [error for error in errors if math.isfinite(error)] or [1.0]
    low, high = (_LEAST if measure == "power" else _ROUNDING), max(10.0, 10 * max(finite))
    errors = [max(error, low) for error in errors]
    axes.set(title=title, xscale="log", yscale="log", ylim=(low / 3, high), ylabel=_MEASURES[measure])
    if measure == "power":
        axes.axhspan(low / 3, _NOISE, color="0.94", zorder=0)
        axes.text(0.98, 0.02, "noise", transform=axes.transAxes, ha="right", color="0.5", fontsize=7, in_layout=False)
    axes.grid(color="0.9", linewidth=0.4)
    axes.set_axisbelow(True)
    points = [(row.us, error) for row, error in zip(rows, errors, strict=True) if math.isfinite(error)]
    across, up = _stairs(points, axes.get_xlim()[1], high)
    axes.plot(across, up, color="0.8", linewidth=4, solid_joinstyle="miter", zorder=1)
    ends = []
    for method in dict.fromkeys(row.method for row in rows):
        colour, style = _METHODS[method]
        chosen = [(row.us, error) for row, error in zip(rows, errors, strict=True) if row.method == method]
        good = [(x, y) for x, y in chosen if math.isfinite(y)]
        bad = [x for x, y in chosen if not math.isfinite(y)]
        if good:
            line: dict[str, Any] = {
                "color": colour,
                "linestyle": style,
                "linewidth": 1.1,
                "marker": "o",
                "markersize": 2.5,
            }
            axes.plot(*zip(*good, strict=True), **line)
            ends.append((*min(good, key=lambda point: point[1]), method, colour))
        if bad:  # a line without points and clipping would count as one at the picture's corner
            axes.plot(bad, [high] * len(bad), color=colour, marker="x", linestyle="none", clip_on=False)
    _label_ends(axes, ends)


def _stairs(points: list[tuple[float, float]], right: float, top: float) -> tuple[list[float], list[float]]:
    """The least error that each cost buys."""
    across, up, best_yet = [], [], top
    for x, y in sorted(points):
        if y < best_yet:
            across += [x, x]
            up += [best_yet, y]
            best_yet = y
    return [*across, right], [*up, best_yet]


def _label_ends(axes: Axes, ends: list[tuple[float, float, str, str]]) -> None:
    """Name each line at its most accurate point; names that would collide give way downwards or upwards."""
    (left, right), (low, high) = np.log(axes.get_xlim()), np.log(axes.get_ylim())
    taken: list[tuple[float, float, float]] = []
    for x, y, method, colour in sorted(ends, key=lambda end: end[1]):
        place, height = (np.log(x) - left) / (right - left), (np.log(y) - low) / (high - low)
        width = 0.02 * len(method)
        begin = place + 0.015 if place + width < 1 else place - width - 0.015
        height -= 0.03
        while any(
            abs(height - other) < _LABEL_GAP and begin < end and start < begin + width for start, end, other in taken
        ):
            height += 0.01
        taken.append((begin, begin + width, height))
        style: Any = {
            "fontsize": 7,
            "in_layout": False,
            "path_effects": [Stroke(linewidth=2, foreground="white"), Normal()],
        }
        axes.text(begin, max(height, 0.01), method, transform=axes.transAxes, color=colour, **style)


# --- branches -------------------------------------------------------------------------------------

_MARKS = {"fold": "o", "flip": "s", "pitchfork": "^", "grazing": "x"}
_STABLE, _UNSTABLE = "black", "red"
_BRANCH_QUANTITIES = ("v_in", "phase", "duration", "depth", "P", "multiplier")


def branches(dataset: "xr.Dataset", path: str | Path | None = None, quantity: str = "v_in") -> Figure:
    """Branches of orbits over their parameter: stable black, unstable red, with what they met on the way.

    Args:
        dataset: What `vijax.branch.dataset` returned.
        path: Where to write it, if anywhere; the ending chooses the format.
        quantity: A variable over impacts, or over points.

    Raises:
        ValueError: A quantity that is none, a format that is none.
    """
    check_branch_quantity(quantity)
    checks.variables("dataset", dataset, (quantity, "stable", "event"), "vijax.branch.dataset")
    if path is not None:
        check_format(path)
    along = dataset[dataset.attrs["along"]]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.2), layout="constrained")
        axes = figure.subplots()
        for index in range(dataset.sizes["branch"]):
            one = dataset.isel(branch=index)
            for colour, width, kept in ((_UNSTABLE, 0.8, 0.0), (_STABLE, 1.4, 1.0)):
                # A segment belongs to the point it leads to, so that the two colours join.
                shown = (one["stable"] == kept) | (one["stable"].shift(point=-1) == kept)
                axes.plot(one[along.name], one[quantity].where(shown), color=colour, linewidth=width)
            _mark_events(axes, one, quantity)
        axes.set_xlabel(axis_label(along))
        axes.set_ylabel(_QUANTITIES.get(quantity, "largest modulus of a multiplier"))
        axes.set_title(title(dataset), fontsize="medium")
        kinds = {str(kind).split()[0] for kind in dataset["event"].values.flat if kind}
        lines = [Line2D([], [], color=_STABLE, label="stable"), Line2D([], [], color=_UNSTABLE, label="unstable")]
        lines += [_mark(kind, label=kind) for kind in _MARKS if kind in kinds]
        figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), frameon=False)
        if path is not None:
            save_figure(figure, path)
    return figure


def check_branch_quantity(quantity: str) -> None:
    """Raise ValueError unless branches have the quantity."""
    checks.choice("quantity", quantity, _BRANCH_QUANTITIES)


def _mark(kind: str, label: str | None = None) -> Line2D:
    mark = Line2D([], [], linestyle="none", marker=_MARKS[kind], markersize=5, color="tab:blue", label=label)
    mark.set_markerfacecolor("white")
    return mark


def _mark_events(axes: Axes, one: "xr.Dataset", quantity: str) -> None:
    """What one branch met, on the curves of its quantity."""
    values = one[quantity].values.reshape(one.sizes["point"], -1)
    events = (one["event"].values, one["event_value"].values, one["event_point"].values)
    for kind, value, place in zip(*events, strict=True):
        if kind:
            mark = _mark(str(kind).split()[0])
            mark.set_data(np.full(values.shape[1], value), values[int(place)])
            axes.add_line(mark)
