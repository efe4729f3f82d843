"""The paper's figures computed and drawn: runs -> orbit diagrams -> panels -> a picture."""

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
from vijax.orbits.orbit_properties import path

if TYPE_CHECKING:
    import xarray as xr

MICRO = 1e6
SERIES_PERIODS = 4  # of a time series
CHAOS_PERIODS = 100  # of the gray orbit behind a Poincare section


class Quantity(NamedTuple):
    """What a panel of an orbit diagram shows: a variable, its label, a factor, powers of the units it is given in.

    The units of length and time are A pi^2/omega^2 [m] and pi/omega [s]; where both powers are 0, nothing is converted.
    A panel ends at `top`, if that is given.
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
    """Write symbol and unit of the axis that a figure sweeps, as the paper writes them."""
    axis = AXES[name]
    return f"${axis.attributes['symbol']}$" + (f" [{axis.unit}]" if axis.unit else "")


def selected(source: Source) -> "xr.Dataset":
    """Pick the part of a diagram that a source names; the points nearest to its values."""
    found = _mirrored(source.run) if source.mirror else diagram(source.run)
    return found.sel({name: value for name, value in source.where.items() if name in found.dims}, method="nearest")


@lru_cache(maxsize=2)
def _mirrored(run: Run) -> "xr.Dataset":
    """Mirror a diagram along one axis, (u, t) -> (-u, t + 1): its strobes are half a period away."""
    found = diagram(run)
    later = np.floor(found["phase"])  # of two half periods, the second becomes the first of the next period
    image = {name: -found[name] for name in ("v_in", "v_out", "side")}
    image |= {"phase": found["phase"] + 1 - 2 * later, "period_number": found["period_number"] + later}
    halfway = 2.0 * np.arange(1, run.recorded_periods + 1) - 1.0
    strobes = [states(pair_of(point, run.wall), *_impacts(point), when=halfway) for point in _points_of(found, run)]
    u, v = (np.stack(rows) for rows in zip(*strobes, strict=True))
    dims = found["u_strobe"].dims
    return found.assign(image).assign(u_strobe=(dims, -u), v_strobe=(dims, -v))


def _points_of(found: "xr.Dataset", run: Run) -> Iterator["xr.Dataset"]:
    return (found.isel({run.along: i}) for i in range(len(run.values)))


def _impacts(point: "xr.Dataset") -> tuple[np.ndarray, ...]:
    """List times on one clock, walls, velocities and contact times of the impacts of a single point."""
    t = (point["phase"] + 2.0 * point["period_number"]).where(point["v_in"].notnull())
    return t.values, *(point[name].values for name in ("side", "v_in", "v_out", "duration"))


def pair_of(point: "xr.Dataset", wall: str) -> ImpactPair:
    """Make the cell of a single point of a diagram."""
    d, kappa, r, gamma = (float(point[name]) for name in ("d", "kappa", "r", "gamma"))
    return impact_pair(d, None if wall == "rigid" else kappa, r, gamma)


def motion(source: Source, periods: int | None = None) -> Curve:
    """Draw the dense curve through the kept impacts of a single point; of its first `periods` if given."""
    point = selected(source)
    t, *rest = _impacts(point)
    if periods is not None:
        t = np.where(t - t[0] < 2.0 * periods, t, np.nan)
    return curve(pair_of(point, source.run.wall), t, *rest)


def panels(number: int) -> dict[str, Panel]:
    """Make every panel of a figure, by letter."""
    figure = FIGURES[number]
    return {view.letter: _SHOWS.get(view.shows, _sweep)(figure, view) for view in figure.views}


def draw(number: int, file: str | Path | None = None) -> Any:
    """Draw a figure of the paper.

    Args:
        number: 3 to 16.
        file: Where to write it, if anywhere.

    Returns:
        The `matplotlib.figure.Figure`.
    """
    figure = FIGURES[number]
    caption = f"Fig. {number}. {figure.title}. {figure.chosen}"
    return small_multiples(panels(number), figure.layout, caption, file)


# --- panels ---------------------------------------------------------------------------------------


def _sweep(figure: PaperFigure, view: View) -> Panel:
    """Lay a quantity over the swept axis."""
    if view.shows == "energies":
        shown = [(source, name) for source in view.sources for name in ("energy", "power")]
    else:
        shown = [(source, view.shows) for source in view.sources]
    layers = [_points(source, name) for source, name in shown]
    layers += _unstable_branches(view)
    run, quantity = view.sources[0].run, QUANTITIES[shown[0][1]]
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
        upright=figure.marks if view.shows.startswith("speed") else (),
        level=level,
        log=("x" if run.along == "kappa" else "") + ("y" if view.shows in _LOGARITHMIC else ""),
        top=quantity.top
        if max(np.nanmax(layer.y, initial=0.0) for layer in layers) > (quantity.top or np.inf)
        else None,
    )


def _points(source: Source, shows: str) -> Layer:
    """Lay every value of a quantity over the swept axis."""
    quantity, found = QUANTITIES[shows], selected(source)
    length = found["A"] * np.pi**2 / found["omega"] ** 2
    time = np.pi / found["omega"]
    values = found[quantity.variable] * quantity.factor * length**quantity.length * time**quantity.time
    values = values.where(values > 0) if shows in _LOGARITHMIC else values
    x, y = np.broadcast_arrays(found[source.run.along], values.transpose(..., source.run.along))
    return Layer(x, y, source.colour, "dots", source.text)


def _phase_plane(figure: PaperFigure, view: View) -> Panel:
    layers, front = [], motion(view.sources[-1])
    for source in view.sources:
        line = motion(source)
        # Of attractors that are mirror images of each other, soft and rigid walls may settle on either.
        image = _image(line, front) if source.run.wall == "rigid" else 1
        layers.append(Layer(image * line.u, image * line.v, source.colour, "line", source.text))
    for line in _unstable_orbits(view):
        image = _image(line, front)
        layers.append(Layer(image * line.u, image * line.v, "red", "line", "unstable"))
    gaps = {float(selected(source)["d"]) for source in view.sources}
    return phase_plane(view.title, layers, gaps.pop() if len(gaps) == 1 else None)


def _unstable_branches(view: View) -> list[Layer]:
    """Lay out impact velocities of unstable orbits between rigid walls over d, and of their mirror images."""
    layers = []
    for walls in view.unstable:
        for each in branches(walls, "d", BRANCHES_WITHIN, BRANCHES_FROM, None):
            shown = ~each.stable & (each.values < max(view.sources[-1].run.values))
            speeds = np.asarray(each.orbit.sequence.side * each.orbit.knots[..., 1])[shown]
            x = np.broadcast_to(each.values[shown, None], speeds.shape)
            layers += [Layer(x, sign * speeds, "red", "dots", "unstable") for sign in (1, -1)]
    return layers


def _unstable_orbits(view: View) -> Iterator[Curve]:
    """Find unstable orbits at the parameters of the last source."""
    source = view.sources[-1]
    pair = pair_of(selected(source), source.run.wall)
    for walls in view.unstable:
        found = orbits(walls, float(pair.d), None if pair.kappa is None else float(pair.kappa), float(pair.r))
        wild = np.flatnonzero(np.abs(np.asarray(found.multipliers)).max(axis=1) > 1)
        for instants in zip(*path(found[wild]), strict=True):
            there = np.isfinite(instants[0])
            yield Curve(*(x[there] for x in instants))


def _image(line: Curve, other: Curve) -> int:
    """Give -1 where two motions lean to opposite sides, so that the mirror image of one is like the other."""
    lean, reference = (np.trapezoid(each.u, each.t) for each in (line, other))
    return -1 if lean * reference < 0 else 1


def _section(figure: PaperFigure, view: View) -> Panel:
    points = [(selected(source), source) for source in view.sources]
    layers = [Layer(point["u_strobe"], point["v_strobe"], source.colour, "dots") for point, source in points]
    return phase_plane(view.title, layers, float(points[0][0]["d"]))


def _chaos(figure: PaperFigure, view: View) -> Panel:
    """Lay the orbit in gray under its Poincare section."""
    (source,) = view.sources
    line, section = motion(source, CHAOS_PERIODS), _section(figure, view)
    return section._replace(layers=[Layer(line.u, line.v, "0.75", "line"), *section.layers])


def _time_series(figure: PaperFigure, view: View) -> Panel:
    (source,) = view.sources
    point, line = selected(source), motion(source, SERIES_PERIODS)
    side, t = point["side"].values, point["phase"].values + 2.0 * point["period_number"].values
    again = np.append(False, side[1:] == side[:-1]) & (t <= line.t[-1])
    gap = float(point["d"])
    return time_series(view.title, line, (t[again], 0.5 * gap * side[again]), gap)


_SHOWS: dict[str, Callable[[PaperFigure, View], Panel]] = {
    "phase plane": _phase_plane,
    "section": _section,
    "chaos": _chaos,
    "time series": _time_series,
}
