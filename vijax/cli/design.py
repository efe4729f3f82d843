"""`vijax design`: the best membrane, what surrounds it, and what tolerances make of it."""

import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import options, process
from vijax.cli.arguments import about, at_one_point, device, part, take_axes
from vijax.cli.closing import close, how_many, wide_gap_advice
from vijax.cli.kinds import Choice, Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress, waiting
from vijax.cli.targets import targets
from vijax.model.quantities import PARAMETERS

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from vijax.design.optimise import Design
    from vijax.design.tolerance import Tolerance
    from vijax.design.tolerance_plane import TolerancePlane
    from vijax.model.device import Harvester

_FILES = ("design.json", "design.png")
_OF_SCATTER = ("mean", "worst", "expected")  # objectives that ask what devices give that are off by the tolerances
_MOST_POINTS = 100_000  # The picture is computed at so many points at most; each is a flight or an orbit.
_STAGES = 3  # ascent, diagram, surroundings; along an axis the first and the last


@dataclass(frozen=True)
class DesignRequest:
    """Designs that are asked for.

    Attributes:
        devices: One, or one for each value of the axis `over`.
        over: The axis along which designs are wanted, and its values.
        tolerances: By how much constants may be off.
        plane: Two of them, in whose plane curves are wanted; or none.
        diagram_points: Values at which the picture shows P, half as many more close by the best design.
        basin_starts: Starts that show what attracts there.
        search: Of the arguments of `optimise_all` all the others.
    """

    devices: "list[Harvester]"
    over: "tuple[str, np.ndarray] | None"
    tolerances: "tuple[Tolerance, ...]"
    plane: "tuple[Tolerance, ...]"
    diagram_points: int
    basin_starts: int
    search: dict[str, Any]


def best(out: str | None, csv: str | None, plot: str | None, overwrite: bool, yes: bool, **given: Any) -> None:
    """Find the membrane that harvests most and can be built.

    Tuned are omega0 (or k, or kappa), s or d, r, A, omega, beta or gamma, and the constants of the membrane. With
    --over the best design is found for every value of an axis.
    """
    with process.door():
        written, picture, rows = targets(out, plot, _FILES, overwrite, ".json", csv=csv)
        if picture is not None:
            _check_format(picture)
        asked = _asked(**given)
        _agree(asked, yes)
    whole, diagram, plane, climbed = _run(asked)
    _write(whole, diagram, plane, written, picture)
    if rows is not None:
        _write_optima(whole, rows)
    close("\n".join([climbed, *_wide_gap(asked), *_lines(whole)]), written, rows, picture)


def _check_format(picture: Path) -> None:
    from vijax.plots.style import check_format

    check_format(picture)


def _asked(
    tune: str,
    bounds: tuple[str, ...],
    tolerance: tuple[str, ...],
    curves: str | None,
    objective: str,
    motion: str,
    reliability: str,
    over: str | None,
    constants: tuple[str, ...],
    survey_points: int,
    starts: int,
    max_impacts: int,
    diagram_points: int,
    basin_starts: int,
    **given: Any,
) -> DesignRequest:
    from vijax.design import optimise
    from vijax.planes.sweep_settings import MOST_STARTS
    from vijax.runtime import checks

    names = tuple(name.strip() for name in tune.split(","))
    along, devices = _devices(over, take_axes(given, {}), device(constants), names)
    scatter = _tolerances(tolerance)
    plane = _plane(curves, scatter, over)
    within = _bounds(bounds)
    weighed = scatter if objective in _OF_SCATTER else ()
    optimise.check(devices, names, within, objective, weighed)
    share = optimise.check_motion(motion, objective, part("reliability", reliability))
    search: dict[str, Any] = {"tune": names, "bounds": within, "objective": objective, "tolerances": weighed}
    search |= {"motion": motion, "reliability": share}
    search |= {"survey_points": survey_points, "starts": starts, "max_impacts": max_impacts}
    points = checks.whole("diagram_points", diagram_points, 2, _MOST_POINTS)
    balls = checks.whole("basin_starts", basin_starts, 1, MOST_STARTS)
    return DesignRequest(devices, along, scatter, plane, points, balls, search)


def _agree(asked: DesignRequest, yes: bool) -> None:
    from vijax.design import optimise
    from vijax.design.multistart import SurveyTask

    search = asked.search
    effort = optimise.effort(*(search[name] for name in ("survey_points", "starts", "max_impacts")))
    tune, objective = search["tune"], search["objective"]
    box = optimise.check(asked.devices, tune, search["bounds"], objective, search["tolerances"])
    process.agree(optimise.expected(SurveyTask(asked.devices, tune, box, objective, effort)), yes)


def _run(asked: DesignRequest) -> "tuple[dict[str, Any], xr.Dataset | None, TolerancePlane | None, str]":
    """Find the designs; give the report, what pictures show besides, and how long the ascents took."""
    from vijax.design import optimise, report

    alone = asked.over is None
    stages, diagram = _STAGES if alone else 2, None
    with progress(stages, "stages") as show:
        waiting("survey and ascents, compiled at first")
        began = time.perf_counter()
        found = optimise.optimise_all(asked.devices, **asked.search)
        seconds = time.perf_counter() - began
        show(1, stages)
        if alone:
            waiting("orbit diagram")
            diagram = _diagram(found[0], asked.devices[0], asked.diagram_points)
            show(2, stages)
        waiting("surroundings and tolerances")
        judged = [_judged(one, asked, alone) for one in found]
        told = [report.describe(one, diagram=diagram, **given) for one, given in zip(found, judged, strict=True)]
        show(stages, stages)
    climbed = f"{how_many(sum(one.ascents for one in found), 'ascents')} in {seconds:.1f} s"
    if asked.over is None:
        return told[0], diagram, judged[0].get("plane"), climbed
    return {"over": {"name": asked.over[0], "values": asked.over[1]}, "designs": told}, None, None, climbed


def _write(
    whole: dict[str, Any],
    diagram: "xr.Dataset | None",
    plane: "TolerancePlane | None",
    written: Path | None,
    picture: Path | None,
) -> None:
    from vijax import plots
    from vijax.runtime.files import write_json

    if written is not None:
        write_json(whole, written)
    if picture is not None and diagram is not None:
        plots.save(plots.design(diagram, whole, plane), picture)
    elif picture is not None:
        plots.save(plots.design_map(whole), picture)


def _write_optima(whole: dict[str, Any], path: Path) -> None:
    """Write the optima, a row each: along an axis the best design at every value."""
    import pandas as pd

    from vijax.model.units import UNITS
    from vijax.runtime.tables import write_table

    if "over" in whole:
        name, values = whole["over"]["name"], whole["over"]["values"]
        found = [({name: value}, one["best"]) for value, one in zip(values, whole["designs"], strict=True)]
    else:
        found = [({}, one) for one in (whole["best"], *whole["others"])]
    rows = [place | _row(one) for place, one in found if one is not None or place]
    tuned = {key: UNITS.get(key, "") for row in rows for key in row}
    write_table(pd.DataFrame(rows), tuned | {"P": "J", "P_stderr": "J", "power": "W", "penetration": "m"}, path)


def _row(one: dict[str, Any] | None) -> dict[str, Any]:
    """Return what a table says of an optimum; nothing where there is none."""
    if one is None:
        return {}
    largest = {name: max(one[name]) for name in ("penetration", "energy_ratio")}
    return one["values"] | {name: one[name] for name in ("label", "P", "P_stderr", "power")} | largest


def _lines(whole: dict[str, Any]) -> Iterable[str]:
    from vijax.design.report_lines import lines, table

    return table(whole) if "over" in whole else lines(whole)


def _wide_gap(asked: DesignRequest) -> list[str]:
    """Say that starts matter where the survey has but one and a gap is wide."""
    import numpy as np

    if asked.search["starts"] > 1:
        return []
    d, gamma = np.array([(float(pair.d), float(pair.gamma)) for pair in (one.pair() for one in asked.devices)]).T
    return wide_gap_advice(d, gamma)


def _devices(
    over: str | None, axes: dict[str, Any], device: "Harvester", names: tuple[str, ...]
) -> "tuple[tuple[str, np.ndarray] | None, list[Harvester]]":
    """Give the axis along which designs are wanted, if there is one, and the device at each of its values."""
    import numpy as np

    from vijax.model.variables import constant
    from vijax.planes.axes import parse_axis

    if over is None:
        return None, [at_one_point(axes, device)[1]]
    name, sign, text = over.partition("=")
    if not sign or name not in PARAMETERS:
        raise ValueError(f"over must be NAME=VALUES, as in d=0.05:0.3:64; got {over!r}")
    if name in axes:
        raise ValueError(f"over must name an axis that is not given besides; got {name}, also given by --{name}")
    if PARAMETERS[name].constant in map(constant, names):
        raise ValueError(f"over must name what is not tuned; got {name}, with {', '.join(names)} tuned")
    with about("over"):
        values = np.atleast_1d(parse_axis(name, text))
    return (name, values), [at_one_point({**axes, name: value}, device)[1] for value in values]


def _bounds(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Read bounds written NAME=LO:HI."""
    from vijax.model.variables import NAMES
    from vijax.planes.axes import parse_axis

    found = {}
    for text in texts:
        name, sign, pair = text.partition("=")
        if not sign or name not in NAMES or pair.count(":") != 1:
            raise ValueError(f"bounds must be NAME=LO:HI of a tuned quantity, as in omega0=20:400; got {text!r}")
        with about("bounds"):
            low, high = parse_axis(name, pair.replace(":", ","))
        found[name] = (float(low), float(high))
    return found


def _tolerances(texts: Iterable[str]) -> "tuple[Tolerance, ...]":
    """Read tolerances written NAME=5%, NAME=0.05 or NAME=5%:lognormal, apart by commas."""
    from vijax.design.tolerance import Tolerance, check_tolerances

    found = []
    for text in (item.strip() for several in texts for item in several.split(",")):
        name, _, rest = text.partition("=")
        spread, _, kind = rest.partition(":")
        if not name or not spread:
            raise ValueError(f"tolerance must be NAME=5%, with :lognormal or not; got {text!r}")
        with about("tolerance"):
            found.append(Tolerance(name, part("tolerance", spread), kind or "uniform"))
    with about("tolerance"):
        return check_tolerances(found)


def _plane(
    curves: str | None, scatter: "tuple[Tolerance, ...]", over: str | None
) -> "tuple[Tolerance, Tolerance] | tuple[()]":
    """Take the two tolerances in whose plane curves are wanted."""
    from vijax.design.tolerance_plane import check_pair

    if curves is None:
        return ()
    if over is not None:
        raise ValueError(f"curves must be left out with over, which has many designs; got {curves}")
    names = [name.strip() for name in curves.split(",")]
    known = {one.name: one for one in scatter}
    missing = [name for name in names if name not in known]
    if len(names) != 2 or missing:
        advice = f"; add --tolerance {missing[0]}=5%" if missing and missing[0] else ""
        raise ValueError(f"curves must name two of the tolerances, as in omega0,s; got {curves!r}{advice}")
    with about("curves"):
        return check_pair([known[name] for name in names])


def _diagram(found: "Design", device: "Harvester", points: int) -> "xr.Dataset":
    """Compute P up and down along the first tuned axis, closer by about the best design, all else as there."""
    import numpy as np

    from vijax.model.variables import LINEAR, limits
    from vijax.planes.orbit_diagram import orbit_diagram
    from vijax.plots.designs import close_view

    along = next((name for name in found.tune if name in PARAMETERS), "omega0")
    device = found.best.device if found.best else device
    low, high = limits((along,), {along: found.bounds[along]} if along in found.bounds else {}, device)[:, 0]
    values = (np.linspace if along in LINEAR else np.geomspace)(low, high, points)
    if found.best is not None and along in found.best.values:
        first, last = close_view(along, found.best.values[along])
        near = np.linspace(max(first, low), min(last, high), points // 2)
        values = np.unique(np.concatenate([values, near]))
    return orbit_diagram(along=along, values=values, direction="both", device=device)


def _judged(found: "Design", asked: DesignRequest, alone: bool) -> dict[str, Any]:
    """Find what becomes of the best design over the tolerances; what lies around it, where it is the only one."""
    from vijax.design.off_design import arrival, extents, ranked
    from vijax.design.optimise import under
    from vijax.design.optimum import Optimum
    from vijax.design.robustness import surroundings
    from vijax.design.tolerance_plane import tolerance_plane

    scatter = asked.tolerances
    if found.best is None:
        return {"tolerances": scatter}
    judged: dict[str, Any] = {"tolerances": scatter, "spread": under(found.best, scatter) if scatter else None}
    if scatter and asked.search["objective"] not in _OF_SCATTER:
        judged["ranking"] = ranked(found.optima, scatter)
    if alone:
        judged["surroundings"] = surroundings(found.best, starts=asked.basin_starts)
        judged |= {"extents": extents(found.best), "arrival": arrival(found.best)}
    if asked.plane and isinstance(found.best, Optimum):
        judged["plane"] = tolerance_plane(found.best, asked.plane)
    elif asked.plane:
        warnings.warn("the design's motion is no orbit, and has no curves of bifurcations", stacklevel=2)
    return judged


# --- the page --------------------------------------------------------------------------------------------------------


def _goal_options() -> list[click.Parameter]:
    shown: dict[str, Any] = {"show_default": True}
    within = "of a tuned quantity [kappa 2 to 400, r 0.05 to 0.95]"
    off, goal = "by how much a constant may be off", "what is made most; mean, worst, expected are over the tolerances"
    motion = "any takes chaos too, by its averages"
    reliability = "share of the balls that keep the limits, with expected"
    return [
        click.Option(["--tune"], default="omega0", metavar="NAME,NAME", help="what is tuned", **shown),
        click.Option(["--bounds"], multiple=True, metavar="NAME=LO:HI", help=within),
        click.Option(["--tolerance"], multiple=True, metavar="NAME=5%[:lognormal]", help=off),
        click.Option(["--objective"], type=Choice(options.OBJECTIVES), default="P", help=goal, **shown),
        click.Option(["--motion"], type=Choice(options.MOTIONS), default="any", help=motion, **shown),
        click.Option(["--reliability"], default="1", metavar="SHARE", help=reliability, **shown),
        click.Option(["--over"], metavar="NAME=VALUES", help="axis along which to find the best designs"),
    ]


def _sections() -> Sections:
    shown: dict[str, Any] = {"show_default": True}
    curves = "two of the tolerances: the bifurcations and limits in their plane, of which the nearest is told"
    return {
        "Goal": _goal_options(),
        "Survey": [
            click.Option(
                ["--survey-points"], type=Whole(2), default=256, help="values at which the survey looks", **shown
            ),
            click.Option(["--starts"], type=Whole(1), default=8, help="starts of the survey at each of them", **shown),
            click.Option(["--max-impacts"], type=Whole(1), default=16, help="most impacts of an orbit", **shown),
        ],
        "Report": [
            click.Option(["--diagram-points"], type=Whole(2), default=320, help="values at which P is shown", **shown),
            click.Option(["--basin-starts"], type=Whole(1), default=2000, help="balls that show basins", **shown),
            click.Option(["--curves"], metavar="NAME,NAME", help=curves),
        ],
        "Device": [*options.axis_options(PARAMETERS), *options.device_options()],
        "Files": options.file_options(".json", "report", row="optimum"),
        "Large runs": [options.size_option()],
    }


_EXAMPLES = (
    "",
    "--d 0.2 --r 0.5 --A 3 --omega 10pi --set V=1700 --tolerance omega0=5%",
    "--d 0.2 --r 0.5 --A 3 --omega 10pi --set V=1700 --tolerance omega0=5%,s=2% --curves omega0,s",
    "--d 0.2 --tune omega0,r --bounds r=0.3:0.8 --tolerance omega0=5%,s=1% --objective worst",
    "--d 0.088 --r 0.27 --A 2 --omega 6 --set V=1700 --objective expected --tolerance omega0=2% --reliability 99%",
    "--over d=0.05:0.3:64 --out designs.json --plot designs.png",
)

design = Page(
    "design",
    best,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, design.json and design.png are written.",
)
