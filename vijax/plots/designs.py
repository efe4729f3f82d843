"""Pictures of designs: P along an axis with its cliff, the ascent and the optimum; designs along an axis."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from vijax.design.report import factors
from vijax.design.report_lines import amount
from vijax.design.tolerance_plane import TolerancePlane
from vijax.model.quantities import AXES
from vijax.model.units import UNITS
from vijax.model.variables import LINEAR, constant
from vijax.orbits.curve_dataset import curve_dataset
from vijax.plots.curve_maps import draw_curves, kind_handles
from vijax.plots.figure import label_logs, styled
from vijax.plots.style import axis_label, symbol
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# Colours of points that are admissible and that are not, and their size: the rising ones lie over the falling ones.
_WAYS = {"down": ("#1f77b4", "#aec7e8", 3.4, "falling"), "up": ("#ff7f0e", "#ffbb78", 1.7, "rising")}
_VEIL: dict[str, Any] = {"facecolor": "0.9", "edgecolor": "0.75", "hatch": "////", "linewidth": 0, "zorder": 0}
_BAND: dict[str, Any] = {"color": "#2ca02c", "alpha": 0.25, "linewidth": 0, "zorder": 1}
_WINDOW: dict[str, Any] = {"color": "#9467bd", "alpha": 0.15, "linewidth": 0, "zorder": 1}
_STAR: dict[str, Any] = {"marker": "*", "markersize": 13, "color": "#2ca02c", "markeredgecolor": "black", "mew": 0.6}
_PATH: dict[str, Any] = {
    "marker": "o",
    "markersize": 2.6,
    "color": "black",
    "linewidth": 0.7,
    "markerfacecolor": "white",
}
_NAIVE: dict[str, Any] = {"marker": "X", "markersize": 8, "color": "#d62728", "linestyle": "none", "mew": 0}
_TIP: dict[str, Any] = {"marker": "D", "markersize": 4.5, "color": "white", "markeredgecolor": "black", "mew": 0.8}
_EDGE: dict[str, Any] = {"color": "black", "linestyle": ":", "linewidth": 0.9}
_WIDE = 4.0  # ratio of the bounds from which on an axis is logarithmic
_DECADES = 6  # P is shown down to so many decades below the largest
_NEAR, _TILT = 0.25, 0.05  # the close view, to either side: in parts of the optimum; of an inclination
_HEADROOM = 1.25  # the close view shows P up to so many times the best design's
_JOULES = ("P", "mean", "worst", "expected")
_CHAOS: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 2.2, "mew": 0, "color": "#9467bd"}
_ERRORS = 3  # standard errors, half the height of the band of an average


@styled
def design(diagram: "xr.Dataset", report: dict[str, Any], plane: TolerancePlane | None = None) -> Figure:
    """Draw P along an axis, falling and rising, under the ascent, the optimum, its tolerances and what is not physical.

    Args:
        diagram: `vijax.orbit_diagram` in both directions, at the optimum.
        report: What `vijax.design.report.describe` returned, with the same diagram.
        plane: What `vijax.design_plane` returned of the optimum: a panel shows it among its curves, with the box of
            both tolerances.
    """
    checks.record("report", report, ("best",), "vijax.design.report.describe")
    if plane is not None:
        checks.instance("plane", plane, TolerancePlane, "vijax.design_plane")
    checks.variables("diagram", diagram, ("P", "admissible"), "orbit_diagram")
    along, best = str(diagram.attrs["along"]), report["best"]
    near = None if best is None else close_view(along, _here(best, along))
    count = 1 + (near is not None) + (plane is not None)
    figure = Figure(figsize=(6.4, 1.8 + 2.4 * count), layout="constrained")
    panels = figure.subplots(count, squeeze=False)[:, 0]
    extra: list[Any] = []
    if plane is not None:
        extra, panels = _in_plane(panels[-1], plane), panels[:-1]
    for axes in panels:
        _draw(axes, diagram, report)
    _whole(panels[0], diagram)
    panels[0].set_title(_title(diagram, report), fontsize="medium")
    if near is not None:
        panels[1].set(xlim=near, ylim=(0, _HEADROOM * best["P"]), ylabel="$P$ [J per half period]")
        panels[1].ticklabel_format(axis="y", scilimits=(0, 0))
    panels[-1].set_xlabel(axis_label(diagram[along]))
    handles, texts = panels[0].get_legend_handles_labels()
    handles, texts = [*handles, *extra], [*texts, *(handle.get_label() for handle in extra)]
    wide = 2.2 if extra else 1.4  # the dashes of a curve want room
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=wide)
    return figure


def _in_plane(axes: Axes, plane: TolerancePlane) -> list[Any]:
    """Draw the optimum among the curves of a plane, with the box of its tolerances; give the legend's entries."""
    (x, y), (across, up) = plane.within, plane.here
    one, other = plane.tolerances
    kinds: set[str] = set()
    if plane.curves:
        dataset = curve_dataset(plane.curves)
        kinds = draw_curves(axes, dataset, x, y, unstable=True)
    corner = across * (1 - one.spread), up * (1 - other.spread)
    axes.add_patch(Rectangle(corner, 2 * across * one.spread, 2 * up * other.spread, **_BAND))
    for found in (plane.nearest, plane.limit):
        if found is not None:
            axes.plot(*found.values, zorder=5, linestyle="none", **_TIP)
    axes.plot(across, up, zorder=6, linestyle="none", **_STAR)
    axes.set(xlim=plane.within[x], ylim=plane.within[y], xlabel=_symbol(x), ylabel=_symbol(y))
    tip = Line2D([], [], linestyle="none", label="nearest bifurcation, limit", **_TIP)
    return [*kind_handles(kinds), *([tip] if plane.nearest or plane.limit else [])]


def close_view(along: str, here: float) -> tuple[float, float]:
    """Find the ends of the part of an axis about an optimum that a picture shows closer by."""
    return (here - _TILT, here + _TILT) if along in LINEAR else (here * (1 - _NEAR), here * (1 + _NEAR))


def _draw(axes: Axes, diagram: "xr.Dataset", report: dict[str, Any]) -> None:
    along = str(diagram.attrs["along"])
    yields, good = diagram["P"] > 0, diagram["admissible"]
    bad = (yields & ~good).any("direction") & ~(yields & good).any("direction")
    ranges = _ranges(diagram[along].values, bad.values)
    for index, (low, high) in enumerate(ranges):
        axes.axvspan(low, high, label=None if index else "inadmissible", **_VEIL)
    _curves(axes, diagram, diagram[along].values)
    _unconstrained(axes, report)
    if report["best"] is not None:
        _mark(axes, report, along)


def _whole(axes: Axes, diagram: "xr.Dataset") -> None:
    """Set limits and scales that show all of a diagram."""
    x, power = diagram[diagram.attrs["along"]].values, diagram["P"]
    most, least = float(power.max()), float(power.where(power > 0).min())
    axes.set(yscale="log", xlim=(x.min(), x.max()), ylabel="$P$ [J per half period]")
    if most > 0:
        axes.set_ylim(max(least / 2, most / 10**_DECADES), 3 * most)
    if x.min() > 0 and x.max() > _WIDE * x.min():
        axes.set_xscale("log")
    label_logs(axes)


def _ranges(x: np.ndarray, which: np.ndarray) -> list[tuple[float, float]]:
    """Find the ends of the stretches of `which`, half way to the points beside them."""
    order = np.argsort(x)
    x, which = x[order], which[order]
    borders = np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1]), x[-1:]])
    steps = np.diff(np.concatenate([[0], which.astype(int), [0]]))
    return list(zip(borders[np.flatnonzero(steps == 1)], borders[np.flatnonzero(steps == -1)], strict=True))


def _curves(axes: Axes, diagram: "xr.Dataset", x: np.ndarray) -> None:
    for way, (colour, pale, size, name) in _WAYS.items():
        one = diagram.sel(direction=way)
        power, good = one["P"].values, one["admissible"].values
        style: Any = {"linestyle": "none", "marker": ".", "mew": 0, "markersize": 2 * size}
        axes.plot(x[~good], power[~good], color=pale, **style)
        axes.plot(x[good], power[good], color=colour, label=f"{name} {symbol(diagram[one.attrs['along']])}", **style)
    _averages(axes, diagram, x)


def _averages(axes: Axes, diagram: "xr.Dataset", x: np.ndarray) -> None:
    """Draw averages of admissible chaos over its orbits' dots, each with the band of its standard error."""
    if "P_stderr" not in diagram:
        return
    chaotic = ((diagram["period"] == 0) & diagram["admissible"]).values
    power, error = diagram["P"].values, _ERRORS * diagram["P_stderr"].values
    at = np.broadcast_to(x, chaotic.shape)[chaotic]
    if at.size:
        axes.plot(at, power[chaotic], label="average of chaos", zorder=3, **_CHAOS)
        axes.vlines(at, (power - error)[chaotic], (power + error)[chaotic], color=_CHAOS["color"], lw=0.7, zorder=3)


def _unconstrained(axes: Axes, report: dict[str, Any]) -> None:
    peak, best = report["highest"], report["best"]
    if not peak["admissible"] and (best is None or peak["P"] > best["P"]):
        text = f"what $P$ alone would choose: {_micro(peak['P'])}, {1e3 * peak['max_penetration']:.3g} mm deep"
        axes.plot([peak["value"]], [peak["P"]], label=text, **_NAIVE)


def _mark(axes: Axes, report: dict[str, Any], along: str) -> None:
    """Mark the optimum, how it was reached, how far it may be off, where its orbit ends."""
    best = report["best"]
    here = _here(best, along)
    band = factors(along, report["tolerances"])
    if band is not None:
        axes.axvspan(here * band[0], here * band[1], label="tolerance", **_BAND)
    if report["surroundings"]:
        _edges(axes, report["surroundings"], best.get("omega0"), here, along)
    _ends(axes, report["extents"], here, along)
    if along in report["tune"] and report["objective"] in _JOULES:
        column = np.asarray(best["path"])[:, report["tune"].index(along)]
        axes.plot(column, best["heights"], zorder=4, label="ascent", **_PATH)
    axes.plot([here], [best["P"]], zorder=5, linestyle="none", label=f"optimum: {_micro(best['P'])}", **_STAR)


def _ends(axes: Axes, extents: list[dict[str, Any]], here: float, along: str) -> None:
    """Show how far off the quantity may be before the motion is another one."""
    for one in extents:
        if one["name"] == along and not (one["below"]["lasts"] and one["above"]["lasts"]):
            low, high = (0.01 * one[side]["percent"] * sign for side, sign in (("below", -1), ("above", 1)))
            ends = (here + low, here + high) if along in LINEAR else (here * (1 + low), here * (1 + high))
            axes.axvspan(*ends, label="as far as this motion lasts", **_WINDOW)


def _edges(axes: Axes, around: dict[str, Any], omega0: float | None, here: float, along: str) -> None:
    """Show where the optimum's orbit meets its first bifurcations."""
    for side in ("below", "above"):
        edge = around[side]
        if edge and omega0 and constant(along) == "omega0" and edge["kind"] != "none":
            power = 2 if along == "k" else 1
            axes.axvline(here * (edge["omega0"] / omega0) ** power, label=edge["kind"], **_EDGE)


def _here(best: dict[str, Any], along: str) -> float:
    """Find where the optimum is on an axis."""
    known = best["values"] | best["pair"] | best["device"]
    return float(known[along] if along in known else known["m_b"] * known[constant(along)] ** 2)


def _micro(energy: float) -> str:
    return amount(energy, "J", 4).replace(" u", r" $\mu$")


def _title(diagram: "xr.Dataset", report: dict[str, Any]) -> str:
    names = [name for name in ("d", "r", "omega", "A") if name in diagram.coords and not diagram[name].ndim]
    said = [f"{symbol(diagram[name])} = {float(diagram[name]):.4g}" for name in names]
    return f"objective {report['objective']}; " + ", ".join(said)


# --- along an axis --------------------------------------------------------------------------------

_HELD = {  # what holds a design, by the words it begins with
    "penetration": ("#1f77b4", "penetration limit"),
    "energy": ("#9467bd", "energy given to the membrane"),
    "lower": ("#8c564b", "a bound"),
    "upper": ("#8c564b", "a bound"),
    "supremum": ("#d62728", "end of the orbit"),
    "unsettled": ("#7f7f7f", "a kink, or all evaluations spent"),
    "": ("#2ca02c", "nothing: interior"),
}


@styled
def design_map(report: dict[str, Any]) -> Figure:
    """Draw the best designs along an axis: the first tuned quantity, and P; coloured by what holds them.

    Args:
        report: `over` (name and values of the axis) and `designs`, one of `vijax.design.report.describe` for
            each value.
    """
    checks.record("report", report, ("over", "designs"), "scripts/design.py --over")
    over, designs = report["over"], report["designs"]
    tuned = designs[0]["tune"][0]
    found = [(x, one) for x, one in zip(over["values"], designs, strict=True) if one["best"]]
    figure = Figure(figsize=(6.4, 5.0), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    for held, (colour, name) in _HELD.items():
        mine = [(x, one["best"]) for x, one in found if _holding(one["best"]) == held]
        style: Any = {"linestyle": "none", "marker": "o", "markersize": 3, "color": colour}
        upper.plot([x for x, _ in mine], [one["values"][tuned] for _, one in mine], **style)
        known = any(text.get_label() == name for text in lower.get_lines())
        label = None if known or not mine else name
        lower.plot([x for x, _ in mine], [one["P"] for _, one in mine], label=label, **style)
    if any(one["spread"] for _, one in found):
        worst = [one["spread"]["worst"] for _, one in found]
        lower.plot([x for x, _ in found], worst, "_", color="black", label="worst within the tolerances")
    upper.set(yscale="linear" if tuned in LINEAR else "log", ylabel=f"best {_named(tuned)}")
    lower.set(yscale="log", ylabel="$P$ [J per half period]", xlabel=_named(over["name"]))
    label_logs(upper)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, handlelength=1.4)
    return figure


def _holding(best: dict[str, Any]) -> str:
    if best["stopped"] == "supremum":
        return "supremum"
    if best["active"]:
        return best["active"][0].split()[0]
    return "" if best["stopped"] == "maximum" else "unsettled"


def _symbol(name: str) -> str:
    about = AXES[name].attributes
    return f"${about['symbol']}$" + (f" [{UNITS[name]}]" if name in UNITS else "")


def _named(name: str) -> str:
    return f"{name} [{UNITS[name]}]" if name in UNITS else name
