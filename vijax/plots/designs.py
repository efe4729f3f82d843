"""Pictures of designs: P along an axis with the ascent and the optimum; best designs along an axis."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from vijax.continuation.curves.curve_dataset import curve_dataset
from vijax.design.report import tolerance_factors
from vijax.design.report_lines import format_amount
from vijax.design.robustness.tolerance_plane import TolerancePlane
from vijax.model.quantities import AXES
from vijax.model.tuned_quantities import LINEAR, constant
from vijax.model.units import UNITS
from vijax.plots.curve_maps import draw_curves, kind_handles
from vijax.plots.figure import label_logs, styled
from vijax.plots.style import axis_label, symbol
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# By direction: colours of admissible and inadmissible points, marker size, name; rising points lie over falling ones.
_DIRECTIONS = {"down": ("#1f77b4", "#aec7e8", 3.4, "falling"), "up": ("#ff7f0e", "#ffbb78", 1.7, "rising")}
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
_WIDE = 4.0  # ratio of the axis' ends above which the axis is logarithmic
_DECADES = 6  # decades of P shown below the largest value
_NEAR, _TILT = 0.25, 0.05  # half width of the close view: relative, or absolute for an inclination [rad]
_HEADROOM = 1.25  # top of the close view, relative to P of the best design
_JOULES = ("P", "mean", "worst", "expected")
_CHAOS: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 2.2, "mew": 0, "color": "#9467bd"}
_ERRORS = 3  # half height of an average's band, in standard errors


@styled
def design(diagram: "xr.Dataset", report: dict[str, Any], plane: TolerancePlane | None = None) -> Figure:
    """Draw P along an axis, rising and falling, with the ascent, the optimum, its tolerances and inadmissible ranges.

    Args:
        diagram: `vijax.orbit_diagram` in both directions, through the optimum.
        report: Result of `vijax.design.report.describe` with the same diagram.
        plane: Result of `vijax.tolerance_plane` for the optimum. If it is given, a further panel shows the optimum
            among the bifurcation curves of this plane, with a box of the tolerances of both parameters.
    """
    validation.validate_dict("report", report, ("best",), "vijax.design.report.describe")
    if plane is not None:
        validation.validate_instance("plane", plane, TolerancePlane, "vijax.tolerance_plane")
    validation.validate_dataset("diagram", diagram, ("P", "admissible"), "orbit_diagram")
    along, best = str(diagram.attrs["along"]), report["best"]
    near = None if best is None else close_view(along, _optimum_value(best, along))
    count = 1 + (near is not None) + (plane is not None)
    figure = Figure(figsize=(6.4, 1.8 + 2.4 * count), layout="constrained")
    panels = figure.subplots(count, squeeze=False)[:, 0]
    plane_handles: list[Any] = []
    if plane is not None:
        plane_handles, panels = _in_plane(panels[-1], plane), panels[:-1]
    for axes in panels:
        _draw(axes, diagram, report)
    _show_full_range(panels[0], diagram)
    panels[0].set_title(_title(diagram, report), fontsize="medium")
    if near is not None:
        panels[1].set(xlim=near, ylim=(0, _HEADROOM * best["P"]), ylabel="$P$ [J per half period]")
        panels[1].ticklabel_format(axis="y", scilimits=(0, 0))
    panels[-1].set_xlabel(axis_label(diagram[along]))
    handles, texts = panels[0].get_legend_handles_labels()
    handles, texts = [*handles, *plane_handles], [*texts, *(handle.get_label() for handle in plane_handles)]
    handle_length = 2.2 if plane_handles else 1.4  # long enough for the dashes of a curve
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=handle_length)
    return figure


def _in_plane(axes: Axes, plane: TolerancePlane) -> list[Any]:
    """Draw the optimum among the curves of a plane, with the box of its tolerances; return the legend entries."""
    (x, y), (across, up) = plane.bounds, plane.centre
    x_tolerance, y_tolerance = plane.tolerances
    kinds: set[str] = set()
    if plane.curves:
        dataset = curve_dataset(plane.curves)
        kinds = draw_curves(axes, dataset, x, y, unstable=True)
    corner = across * (1 - x_tolerance.spread), up * (1 - y_tolerance.spread)
    axes.add_patch(Rectangle(corner, 2 * across * x_tolerance.spread, 2 * up * y_tolerance.spread, **_BAND))
    for event in (plane.nearest, plane.limit):
        if event is not None:
            axes.plot(*event.values, zorder=5, linestyle="none", **_TIP)
    axes.plot(across, up, zorder=6, linestyle="none", **_STAR)
    axes.set(xlim=plane.bounds[x], ylim=plane.bounds[y], xlabel=_symbol(x), ylabel=_symbol(y))
    tip = Line2D([], [], linestyle="none", label="nearest bifurcation, limit", **_TIP)
    return [*kind_handles(kinds), *([tip] if plane.nearest or plane.limit else [])]


def close_view(along: str, optimum: float) -> tuple[float, float]:
    """Return the ends of the close view, the part of an axis around the optimum."""
    return (optimum - _TILT, optimum + _TILT) if along in LINEAR else (optimum * (1 - _NEAR), optimum * (1 + _NEAR))


def _draw(axes: Axes, diagram: "xr.Dataset", report: dict[str, Any]) -> None:
    along = str(diagram.attrs["along"])
    harvests, admissible = diagram["P"] > 0, diagram["admissible"]
    inadmissible = (harvests & ~admissible).any("direction") & ~(harvests & admissible).any("direction")
    ranges = _ranges(diagram[along].values, inadmissible.values)
    for index, (low, high) in enumerate(ranges):
        axes.axvspan(low, high, label=None if index else "inadmissible", **_VEIL)
    _curves(axes, diagram, diagram[along].values)
    _unconstrained(axes, report)
    if report["best"] is not None:
        _mark(axes, report, along)


def _show_full_range(axes: Axes, diagram: "xr.Dataset") -> None:
    """Set limits and scales that show a whole diagram."""
    x, power = diagram[diagram.attrs["along"]].values, diagram["P"]
    largest, smallest = float(power.max()), float(power.where(power > 0).min())
    axes.set(yscale="log", xlim=(x.min(), x.max()), ylabel="$P$ [J per half period]")
    if largest > 0:
        axes.set_ylim(max(smallest / 2, largest / 10**_DECADES), 3 * largest)
    if x.min() > 0 and x.max() > _WIDE * x.min():
        axes.set_xscale("log")
    label_logs(axes)


def _ranges(x: np.ndarray, which: np.ndarray) -> list[tuple[float, float]]:
    """Return intervals of x that contain the runs of true values in `which`, extended halfway to the next points."""
    order = np.argsort(x)
    x, which = x[order], which[order]
    borders = np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1]), x[-1:]])
    steps = np.diff(np.concatenate([[0], which.astype(int), [0]]))
    return list(zip(borders[np.flatnonzero(steps == 1)], borders[np.flatnonzero(steps == -1)], strict=True))


def _curves(axes: Axes, diagram: "xr.Dataset", x: np.ndarray) -> None:
    for direction, (colour, inadmissible_colour, size, name) in _DIRECTIONS.items():
        branch = diagram.sel(direction=direction)
        power, admissible = branch["P"].values, branch["admissible"].values
        style: Any = {"linestyle": "none", "marker": ".", "mew": 0, "markersize": 2 * size}
        axes.plot(x[~admissible], power[~admissible], color=inadmissible_colour, **style)
        axes.plot(
            x[admissible],
            power[admissible],
            color=colour,
            label=f"{name} {symbol(diagram[branch.attrs['along']])}",
            **style,
        )
    _averages(axes, diagram, x)


def _averages(axes: Axes, diagram: "xr.Dataset", x: np.ndarray) -> None:
    """Draw averages of admissible chaotic motions over their points, with bands of the standard error."""
    if "P_stderr" not in diagram:
        return
    chaotic = ((diagram["period"] == 0) & diagram["admissible"]).values
    power, error = diagram["P"].values, _ERRORS * diagram["P_stderr"].values
    positions = np.broadcast_to(x, chaotic.shape)[chaotic]
    if positions.size:
        axes.plot(positions, power[chaotic], label="average of chaos", zorder=3, **_CHAOS)
        axes.vlines(
            positions, (power - error)[chaotic], (power + error)[chaotic], color=_CHAOS["color"], lw=0.7, zorder=3
        )


def _unconstrained(axes: Axes, report: dict[str, Any]) -> None:
    peak, best = report["highest"], report["best"]
    if not peak["admissible"] and (best is None or peak["P"] > best["P"]):
        text = f"unconstrained maximum of $P$: {_micro(peak['P'])}, {1e3 * peak['max_penetration']:.3g} mm deep"
        axes.plot([peak["value"]], [peak["P"]], label=text, **_NAIVE)


def _mark(axes: Axes, report: dict[str, Any], along: str) -> None:
    """Mark the optimum, the ascent that led to it, its tolerance, and the range in which its motion persists."""
    best = report["best"]
    optimum = _optimum_value(best, along)
    band = tolerance_factors(along, report["tolerances"])
    if band is not None:
        axes.axvspan(optimum * band[0], optimum * band[1], label="tolerance", **_BAND)
    if report["surroundings"]:
        _edges(axes, report["surroundings"], best.get("omega0"), optimum, along)
    _ends(axes, report["parameter_ranges"], optimum, along)
    if along in report["tune"] and report["objective"] in _JOULES:
        column = np.asarray(best["path"])[:, report["tune"].index(along)]
        axes.plot(column, best["path_objective"], zorder=4, label="ascent", **_PATH)
    axes.plot([optimum], [best["P"]], zorder=5, linestyle="none", label=f"optimum: {_micro(best['P'])}", **_STAR)


def _ends(axes: Axes, parameter_ranges: list[dict[str, Any]], optimum: float, along: str) -> None:
    """Shade the range of the quantity within which the motion remains the same."""
    for extent in parameter_ranges:
        if extent["name"] == along and not (extent["below"]["persists"] and extent["above"]["persists"]):
            low, high = (0.01 * extent[side]["percent"] * sign for side, sign in (("below", -1), ("above", 1)))
            ends = (optimum + low, optimum + high) if along in LINEAR else (optimum * (1 + low), optimum * (1 + high))
            axes.axvspan(*ends, label="range of this motion", **_WINDOW)


def _edges(axes: Axes, surroundings: dict[str, Any], omega0: float | None, optimum: float, along: str) -> None:
    """Draw lines at the first bifurcations of the optimum's orbit."""
    for side in ("below", "above"):
        edge = surroundings[side]
        if edge and omega0 and constant(along) == "omega0" and edge["kind"] != "none":
            # k is proportional to omega0^2.
            power = 2 if along == "k" else 1
            axes.axvline(optimum * (edge["omega0"] / omega0) ** power, label=edge["kind"], **_EDGE)


def _optimum_value(best: dict[str, Any], along: str) -> float:
    """Return the optimum's value of the quantity on an axis."""
    quantities = best["values"] | best["pair"] | best["device"]
    # If the report contains omega0 but not the stiffness k, then k = m_b omega0^2.
    return float(quantities[along] if along in quantities else quantities["m_b"] * quantities[constant(along)] ** 2)


def _micro(energy: float) -> str:
    return format_amount(energy, "J", 4).replace(" u", r" $\mu$")


def _title(diagram: "xr.Dataset", report: dict[str, Any]) -> str:
    names = [name for name in ("d", "r", "omega", "A") if name in diagram.coords and not diagram[name].ndim]
    equations = [f"{symbol(diagram[name])} = {float(diagram[name]):.4g}" for name in names]
    return f"objective {report['objective']}; " + ", ".join(equations)


# --- along an axis --------------------------------------------------------------------------------

_LIMITS = {  # limits of a design, by the first word of the report's limit
    "penetration": ("#1f77b4", "penetration limit"),
    "energy": ("#9467bd", "energy given to the membrane"),
    "lower": ("#8c564b", "a bound"),
    "upper": ("#8c564b", "a bound"),
    "supremum": ("#d62728", "end of the orbit"),
    "unsettled": ("#7f7f7f", "a kink, or all evaluations spent"),
    "": ("#2ca02c", "no active limit"),
}


@styled
def design_map(report: dict[str, Any]) -> Figure:
    """Draw the best designs along an axis: the first tuned quantity, and P, coloured by the active limit.

    Args:
        report: `over` (name and values of the axis) and `designs`, a result of `vijax.design.report.describe` for each
            value.
    """
    validation.validate_dict("report", report, ("over", "designs"), "scripts/design.py --over")
    over, designs = report["over"], report["designs"]
    tuned = designs[0]["tune"][0]
    optima = [(x, result) for x, result in zip(over["values"], designs, strict=True) if result["best"]]
    figure = Figure(figsize=(6.4, 5.0), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    for limit, (colour, name) in _LIMITS.items():
        selected = [(x, result["best"]) for x, result in optima if _limit_of(result["best"]) == limit]
        style: Any = {"linestyle": "none", "marker": "o", "markersize": 3, "color": colour}
        upper.plot([x for x, _ in selected], [result["values"][tuned] for _, result in selected], **style)
        is_in_legend = any(text.get_label() == name for text in lower.get_lines())
        label = None if is_in_legend or not selected else name
        lower.plot([x for x, _ in selected], [result["P"] for _, result in selected], label=label, **style)
    if any(result["spread"] for _, result in optima):
        worst = [result["spread"]["worst"] for _, result in optima]
        lower.plot([x for x, _ in optima], worst, "_", color="black", label="worst within the tolerances")
    upper.set(yscale="linear" if tuned in LINEAR else "log", ylabel=f"best {_name_with_unit(tuned)}")
    lower.set(yscale="log", ylabel="$P$ [J per half period]", xlabel=_name_with_unit(over["name"]))
    label_logs(upper)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, handlelength=1.4)
    return figure


def _limit_of(best: dict[str, Any]) -> str:
    if best["stopped"] == "supremum":
        return "supremum"
    if best["active"]:
        return best["active"][0].split()[0]
    return "" if best["stopped"] == "maximum" else "unsettled"


def _symbol(name: str) -> str:
    about = AXES[name].attributes
    return f"${about['symbol']}$" + (f" [{UNITS[name]}]" if name in UNITS else "")


def _name_with_unit(name: str) -> str:
    return f"{name} [{UNITS[name]}]" if name in UNITS else name
