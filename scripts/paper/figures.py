"""Computation and drawing of the paper's figures: runs -> orbit diagrams -> panels -> a picture."""

from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scripts.paper.cached import branches, diagram, orbits
from scripts.paper.captions import BRANCHES_FROM, BRANCHES_WITHIN, FIGURES, PaperFigure, Run, Source, View
from scripts.paper.portrait import Layer, Panel, phase_plane, small_multiples, time_series
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.quantities import AXES
from vijax.orbits.motion import Curve, curve, states
from vijax.orbits.orbit_properties import orbit_path

if TYPE_CHECKING:
    import xarray as xr

MICRO = 1e6
SERIES_PERIODS = 4  # periods of a time series
CHAOS_PERIODS = 100  # periods of the gray orbit behind a Poincare section


class Quantity(NamedTuple):
    """Quantity of a panel of an orbit diagram: variable, label, factor, and powers of the units of length and time.

    The units of length and time are A pi^2/omega^2 [m] and pi/omega [s]; with both powers 0 no unit is converted.
    `top` is the upper limit of the panel; None for no limit.
    """

    variable: str
    label: str
    factor: float = 1.0
    length: int = 0
    time: int = 0
    top: float | None = None


QUANTITIES = {
    "speed": Quantity("v_in", r"$\dot{u}_j$"),
    "speed in m/s": Quantity("v_in", r"$U'_j$ [m/s]", length=1, time=-1),
    "strobe": Quantity("v_strobe", r"$\dot{u}$ at phase 0"),
    "strobe in m": Quantity("u_strobe", r"$U$ at phase 0 [m]", length=1),
    "restitution": Quantity("restitution", r"$\rho_j$", top=2.0),
    "phase": Quantity("phase", r"$\phi_j$ [rad]", factor=np.pi),
    "duration": Quantity("duration", r"$\Delta t_j$"),
    "duration in s": Quantity("duration", r"$\Delta\tau_j$ [s]", time=1),
    "energy": Quantity("E", r"$E_j$ [$\mu$J]", factor=MICRO),
    "power": Quantity("P", r"$P$ [$\mu$J]", factor=MICRO),
}
_LOGARITHMIC = {"energy", "power"}


def axis_label(name: str) -> str:
    """Return symbol and unit of a swept axis in the notation of the paper."""
    axis = AXES[name]
    return f"${axis.attributes['symbol']}$" + (f" [{axis.unit}]" if axis.unit else "")


def selected(source: Source) -> "xr.Dataset":
    """Return the part of a diagram that a source selects: the points nearest to its values."""
    dataset = _mirrored(source.run) if source.mirror else diagram(source.run)
    return dataset.sel({name: value for name, value in source.where.items() if name in dataset.dims}, method="nearest")


@lru_cache(maxsize=2)
def _mirrored(run: Run) -> "xr.Dataset":
    """Return the mirror image (u, t) -> (-u, t + 1) of a diagram; its strobes lie half a period later."""
    dataset = diagram(run)
    later = np.floor(dataset["phase"])  # the second half of a period becomes the first half of the next period
    image = {name: -dataset[name] for name in ("v_in", "v_out", "side")}
    image |= {"phase": dataset["phase"] + 1 - 2 * later, "period_number": dataset["period_number"] + later}
    halfway = 2.0 * np.arange(1, run.recorded_periods + 1) - 1.0
    strobes = [states(pair_of(point, run.wall), *_impacts(point), when=halfway) for point in _points_of(dataset, run)]
    u, v = (np.stack(rows) for rows in zip(*strobes, strict=True))
    dims = dataset["u_strobe"].dims
    return dataset.assign(image).assign(u_strobe=(dims, -u), v_strobe=(dims, -v))


def _points_of(dataset: "xr.Dataset", run: Run) -> Iterator["xr.Dataset"]:
    return (dataset.isel({run.along: i}) for i in range(len(run.values)))


def _impacts(point: "xr.Dataset") -> tuple[np.ndarray, ...]:
    """Return onset times, walls, velocities and contact durations of the impacts of a single point."""
    t = (point["phase"] + 2.0 * point["period_number"]).where(point["v_in"].notnull())
    return t.values, *(point[name].values for name in ("side", "v_in", "v_out", "duration"))


def pair_of(point: "xr.Dataset", wall: str) -> ImpactPair:
    """Return the impact pair of a single point of a diagram."""
    d, kappa, r, gamma = (float(point[name]) for name in ("d", "kappa", "r", "gamma"))
    return impact_pair(d, None if wall == "rigid" else kappa, r, gamma)


def motion(source: Source, periods: int | None = None) -> Curve:
    """Return the dense curve through the recorded impacts of a single point, or of its first `periods`."""
    point = selected(source)
    t, *rest = _impacts(point)
    if periods is not None:
        t = np.where(t - t[0] < 2.0 * periods, t, np.nan)
    return curve(pair_of(point, source.run.wall), t, *rest)


def panels(number: int) -> dict[str, Panel]:
    """Return the panels of a figure by letter."""
    figure = FIGURES[number]
    return {view.letter: _SHOWS.get(view.shows, _sweep)(figure, view) for view in figure.views}


def draw(number: int, file: str | Path | None = None) -> Any:
    """Draw a figure of the paper.

    Args:
        number: 3 to 16.
        file: Path of the picture; None writes no file.

    Returns:
        The `matplotlib.figure.Figure`.
    """
    figure = FIGURES[number]
    caption = f"Fig. {number}. {figure.title}. {figure.chosen}"
    return small_multiples(panels(number), figure.layout, caption, file)


# --- panels ---------------------------------------------------------------------------------------


def _sweep(figure: PaperFigure, view: View) -> Panel:
    """Return the panel of a quantity over the swept axis."""
    if view.shows == "energies":
        drawn_quantities = [(source, name) for source in view.sources for name in ("energy", "power")]
    else:
        drawn_quantities = [(source, view.shows) for source in view.sources]
    layers = [_points(source, name) for source, name in drawn_quantities]
    layers += _unstable_branches(view)
    run, quantity = view.sources[0].run, QUANTITIES[drawn_quantities[0][1]]
    label, level = quantity.label, [(np.pi, "tab:blue")] if view.shows == "phase" else []
    for source in view.levels:
        front = view.sources[-1]
        stiffest = front._replace(where=front.where | {run.along: max(run.values)})
        speeds = _image(motion(source), motion(stiffest)) * selected(source)["v_in"].values
        level += [(speed, "red") for speed in np.unique(speeds[np.isfinite(speeds)].round(6))]
    if view.shows == "energies":
        layers[1] = layers[1]._replace(colour="green", text="$P$, mean over the orbit")
        label = r"$E_j$, $P$ [$\mu$J]"
    return Panel(
        view.title,
        axis_label(run.along),
        label,
        layers,
        upright=figure.reference_values if view.shows.startswith("speed") else (),
        level=level,
        log=("x" if run.along == "kappa" else "") + ("y" if view.shows in _LOGARITHMIC else ""),
        top=quantity.top
        if max(np.nanmax(layer.y, initial=0.0) for layer in layers) > (quantity.top or np.inf)
        else None,
    )


def _points(source: Source, shows: str) -> Layer:
    """Return the layer of all values of a quantity over the swept axis."""
    quantity, dataset = QUANTITIES[shows], selected(source)
    length = dataset["A"] * np.pi**2 / dataset["omega"] ** 2
    time = np.pi / dataset["omega"]
    values = dataset[quantity.variable] * quantity.factor * length**quantity.length * time**quantity.time
    values = values.where(values > 0) if shows in _LOGARITHMIC else values
    x, y = np.broadcast_arrays(dataset[source.run.along], values.transpose(..., source.run.along))
    return Layer(x, y, source.colour, "dots", source.text)


def _phase_plane(figure: PaperFigure, view: View) -> Panel:
    layers, front = [], motion(view.sources[-1])
    for source in view.sources:
        line = motion(source)
        # Soft and rigid walls may settle on different members of a pair of mirror images.
        image = _image(line, front) if source.run.wall == "rigid" else 1
        layers.append(Layer(image * line.u, image * line.v, source.colour, "line", source.text))
    for line in _unstable_orbits(view):
        image = _image(line, front)
        layers.append(Layer(image * line.u, image * line.v, "red", "line", "unstable"))
    gaps = {float(selected(source)["d"]) for source in view.sources}
    return phase_plane(view.title, layers, gaps.pop() if len(gaps) == 1 else None)


def _unstable_branches(view: View) -> list[Layer]:
    """Return layers of impact velocities over d of unstable orbits between rigid walls and of their mirror images."""
    layers = []
    for walls in view.unstable:
        for branch in branches(walls, "d", BRANCHES_WITHIN, BRANCHES_FROM, None):
            is_drawn = ~branch.stable & (branch.values < max(view.sources[-1].run.values))
            speeds = np.asarray(branch.orbit.sequence.side * branch.orbit.impact_unknowns[..., 1])[is_drawn]
            x = np.broadcast_to(branch.values[is_drawn, None], speeds.shape)
            layers += [Layer(x, sign * speeds, "red", "dots", "unstable") for sign in (1, -1)]
    return layers


def _unstable_orbits(view: View) -> Iterator[Curve]:
    """Yield the curves of unstable orbits at the parameters of the last source."""
    source = view.sources[-1]
    pair = pair_of(selected(source), source.run.wall)
    for walls in view.unstable:
        orbits_of_sequence = orbits(
            walls, float(pair.d), None if pair.kappa is None else float(pair.kappa), float(pair.r)
        )
        unstable = np.flatnonzero(np.abs(np.asarray(orbits_of_sequence.multipliers)).max(axis=1) > 1)
        for instants in zip(*orbit_path(orbits_of_sequence[unstable]), strict=True):
            is_finite = np.isfinite(instants[0])
            yield Curve(*(x[is_finite] for x in instants))


def _image(line: Curve, other: Curve) -> int:
    """Return -1 if one motion resembles the mirror image of the other (mean u of opposite sign); 1 otherwise."""
    integral, other_integral = (np.trapezoid(motion_curve.u, motion_curve.t) for motion_curve in (line, other))
    return -1 if integral * other_integral < 0 else 1


def _section(figure: PaperFigure, view: View) -> Panel:
    points = [(selected(source), source) for source in view.sources]
    layers = [Layer(point["u_strobe"], point["v_strobe"], source.colour, "dots") for point, source in points]
    return phase_plane(view.title, layers, float(points[0][0]["d"]))


def _chaos(figure: PaperFigure, view: View) -> Panel:
    """Return the panel of a Poincare section over the gray orbit."""
    (source,) = view.sources
    line, section = motion(source, CHAOS_PERIODS), _section(figure, view)
    return section._replace(layers=[Layer(line.u, line.v, "0.75", "line"), *section.layers])


def _time_series(figure: PaperFigure, view: View) -> Panel:
    (source,) = view.sources
    point, line = selected(source), motion(source, SERIES_PERIODS)
    side, t = point["side"].values, point["phase"].values + 2.0 * point["period_number"].values
    repeated = np.append(False, side[1:] == side[:-1]) & (t <= line.t[-1])
    gap = float(point["d"])
    return time_series(view.title, line, (t[repeated], 0.5 * gap * side[repeated]), gap)


_SHOWS: dict[str, Callable[[PaperFigure, View], Panel]] = {
    "phase plane": _phase_plane,
    "section": _section,
    "chaos": _chaos,
    "time series": _time_series,
}
