"""`vijax design`: the design with the largest objective, its surroundings, and its performance under tolerances."""

import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, name_option_in_errors, parse_fraction, single_cell, take_axes
from vijax.cli.closing import close, format_count, wide_gap_advice
from vijax.cli.options import options
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Choice, Integer
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress, waiting
from vijax.model.quantities import PARAMETERS

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from vijax.design.optimise import Design
    from vijax.design.robustness.tolerance import Tolerance
    from vijax.design.robustness.tolerance_plane import TolerancePlane
    from vijax.model.device import Harvester

_FILES = ("design.json", "design.png")
_SCATTER_OBJECTIVES = ("mean", "worst", "expected")  # statistics of P over devices within the tolerances
_MOST_POINTS = 100_000  # most points of the orbit diagram in the picture; every point is simulated
_STAGES = 3  # stages of the progress bar: ascents, diagram, surroundings; with --over there is no diagram


@dataclass(frozen=True)
class DesignRequest:
    """Validated arguments of `vijax design`.

    Attributes:
        devices: One device, or one for each value of the axis `over`.
        over: The axis along which designs are optimised, and its values; None without such an axis.
        tolerances, plane: All tolerances, and the two that span the plane of the bifurcation curves; empty for none.
        diagram_points: Number of values of the orbit diagram; half as many are added near the best design.
        basin_starts: Number of starts for the basins of the best design.
        search: All other arguments of `optimise_all`.
    """

    devices: "list[Harvester]"
    over: "tuple[str, np.ndarray] | None"
    tolerances: "tuple[Tolerance, ...]"
    plane: "tuple[Tolerance, ...]"
    diagram_points: int
    basin_starts: int
    search: dict[str, Any]


def best(out: str | None, csv: str | None, plot: str | None, overwrite: bool, yes: bool, **parameters: Any) -> None:
    """Find the membrane that harvests most and can be built.

    Quantities that can be tuned: omega0 (or k, or kappa), s or d, r, A, omega, beta or gamma, and the constants of the
    membrane. With --over, one best design is found for every value of an axis.
    """
    with process.usage_errors():
        target, picture, rows = targets(out, plot, _FILES, overwrite, ".json", csv=csv)
        if picture is not None:
            _check_format(picture)
        request = _make_request(**parameters)
        _agree(request, yes)
    report, diagram, plane, rate = _run(request)
    _write(report, diagram, plane, target, picture)
    if rows is not None:
        _write_optima(report, rows)
    close("\n".join([rate, *_wide_gap(request), *_lines(report)]), target, rows, picture)


def _check_format(picture: Path) -> None:
    from vijax.plots.style import check_format

    check_format(picture)


def _make_request(
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
    **parameters: Any,
) -> DesignRequest:
    from vijax.design import optimise
    from vijax.maps.sweep_settings import MOST_STARTS
    from vijax.runtime import validation

    names = tuple(name.strip() for name in tune.split(","))
    along, devices = _devices(over, take_axes(parameters, {}), device(constants), names)
    scatter = _tolerances(tolerance)
    plane = _plane(curves, scatter, over)
    within = _bounds(bounds)
    objective_scatter = scatter if objective in _SCATTER_OBJECTIVES else ()
    optimise.validate_bounds(devices, names, within, objective, objective_scatter)
    share = optimise.validate_motion(motion, objective, parse_fraction("reliability", reliability))
    search: dict[str, Any] = {"tune": names, "bounds": within, "objective": objective, "tolerances": objective_scatter}
    search |= {"motion": motion, "reliability": share}
    search |= {"survey_points": survey_points, "starts": starts, "max_impacts": max_impacts}
    points = validation.validate_integer("diagram_points", diagram_points, 2, _MOST_POINTS)
    start_count = validation.validate_integer("basin_starts", basin_starts, 1, MOST_STARTS)
    return DesignRequest(devices, along, scatter, plane, points, start_count, search)


def _agree(request: DesignRequest, yes: bool) -> None:
    from vijax.design import optimise
    from vijax.design.survey.device_survey import SurveyTask

    search = request.search
    effort = optimise.make_effort(*(search[name] for name in ("survey_points", "starts", "max_impacts")))
    tune, objective = search["tune"], search["objective"]
    box = optimise.validate_bounds(request.devices, tune, search["bounds"], objective, search["tolerances"])
    process.agree(optimise.estimate_survey(SurveyTask(request.devices, tune, box, objective, effort)), yes)


def _run(request: DesignRequest) -> "tuple[dict[str, Any], xr.Dataset | None, TolerancePlane | None, str]":
    """Compute the designs; return the report, orbit diagram and tolerance plane (or None), and a line with the time."""
    from vijax.design import optimise, report

    single = request.over is None
    stages, diagram = _STAGES if single else 2, None
    with progress(stages, "stages") as show:
        waiting("survey and ascents, compiled at first")
        began = time.perf_counter()
        designs = optimise.optimise_all(request.devices, **request.search)
        seconds = time.perf_counter() - began
        show(1, stages)
        if single:
            waiting("orbit diagram")
            diagram = _diagram(designs[0], request.devices[0], request.diagram_points)
            show(2, stages)
        waiting("surroundings and tolerances")
        evaluations = [_evaluate(item, request, single) for item in designs]
        entries = [
            report.describe(item, diagram=diagram, **extra) for item, extra in zip(designs, evaluations, strict=True)
        ]
        show(stages, stages)
    rate = f"{format_count(sum(item.ascents for item in designs), 'ascents')} in {seconds:.1f} s"
    if request.over is None:
        return entries[0], diagram, evaluations[0].get("plane"), rate
    return {"over": {"name": request.over[0], "values": request.over[1]}, "designs": entries}, None, None, rate


def _write(
    report: dict[str, Any],
    diagram: "xr.Dataset | None",
    plane: "TolerancePlane | None",
    target: Path | None,
    picture: Path | None,
) -> None:
    from vijax import plots
    from vijax.runtime.files import write_json

    if target is not None:
        write_json(report, target)
    if picture is not None and diagram is not None:
        plots.save(plots.design(diagram, report, plane), picture)
    elif picture is not None:
        plots.save(plots.design_map(report), picture)


def _write_optima(report: dict[str, Any], path: Path) -> None:
    """Write a table with one row per optimum; with --over, one row per value of the axis, with its best design."""
    import pandas as pd

    from vijax.model.units import UNITS
    from vijax.runtime.text_tables import write_table

    if "over" in report:
        name, values = report["over"]["name"], report["over"]["values"]
        optima = [({name: value}, entry["best"]) for value, entry in zip(values, report["designs"], strict=True)]
    else:
        optima = [({}, entry) for entry in (report["best"], *report["others"])]
    rows = [place | _row(entry) for place, entry in optima if entry is not None or place]
    tuned = {key: UNITS.get(key, "") for row in rows for key in row}
    write_table(pd.DataFrame(rows), tuned | {"P": "J", "P_stderr": "J", "power": "W", "penetration": "m"}, path)


def _row(optimum: dict[str, Any] | None) -> dict[str, Any]:
    """Return the table row of an optimum, by column name; an empty row if there is no optimum (None)."""
    if optimum is None:
        return {}
    largest = {name: max(optimum[name]) for name in ("penetration", "energy_ratio")}
    return optimum["values"] | {name: optimum[name] for name in ("label", "P", "P_stderr", "power")} | largest


def _lines(report: dict[str, Any]) -> Iterable[str]:
    from vijax.design.report_lines import format_report, format_table

    return format_table(report) if "over" in report else format_report(report)


def _wide_gap(request: DesignRequest) -> list[str]:
    """Return a line that advises several starts, if the survey uses one and a gap is wider than 2/pi^2 at gamma = 0."""
    import numpy as np

    if request.search["starts"] > 1:
        return []
    d, gamma = np.array([(float(pair.d), float(pair.gamma)) for pair in (item.pair() for item in request.devices)]).T
    return wide_gap_advice(d, gamma)


def _devices(
    over: str | None, axes: dict[str, Any], device: "Harvester", names: tuple[str, ...]
) -> "tuple[tuple[str, np.ndarray] | None, list[Harvester]]":
    """Return the name and values of --over, with one device per value; without --over, None and a single device."""
    import numpy as np

    from vijax.maps.axes import parse_axis
    from vijax.model.tuned_quantities import constant

    if over is None:
        return None, [single_cell(axes, device)[1]]
    name, sign, text = over.partition("=")
    if not sign or name not in PARAMETERS:
        raise ValueError(f"over must be NAME=VALUES, as in d=0.05:0.3:64; got {over!r}")
    if name in axes:
        raise ValueError(f"over must name an axis that is not given besides; got {name}, also given by --{name}")
    if PARAMETERS[name].constant in map(constant, names):
        raise ValueError(f"over must name a quantity that is not tuned; got {name}, with {', '.join(names)} tuned")
    with name_option_in_errors("over"):
        values = np.atleast_1d(parse_axis(name, text))
    return (name, values), [single_cell({**axes, name: value}, device)[1] for value in values]


def _bounds(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Parse bounds written NAME=LO:HI."""
    from vijax.maps.axes import parse_axis
    from vijax.model.tuned_quantities import NAMES

    bounds = {}
    for text in texts:
        name, sign, pair = text.partition("=")
        if not sign or name not in NAMES or pair.count(":") != 1:
            raise ValueError(f"bounds must be NAME=LO:HI of a tuned quantity, as in omega0=20:400; got {text!r}")
        with name_option_in_errors("bounds"):
            low, high = parse_axis(name, pair.replace(":", ","))
        bounds[name] = (float(low), float(high))
    return bounds


def _tolerances(texts: Iterable[str]) -> "tuple[Tolerance, ...]":
    """Parse tolerances written NAME=5%, NAME=0.05 or NAME=5%:lognormal, separated by commas."""
    from vijax.design.robustness.tolerance import Tolerance, validate_tolerances

    tolerances = []
    for text in (item.strip() for several in texts for item in several.split(",")):
        name, _, rest = text.partition("=")
        spread, _, kind = rest.partition(":")
        if not name or not spread:
            raise ValueError(f"tolerance must be NAME=5%, with :lognormal or not; got {text!r}")
        with name_option_in_errors("tolerance"):
            tolerances.append(Tolerance(name, parse_fraction("tolerance", spread), kind or "uniform"))
    with name_option_in_errors("tolerance"):
        return validate_tolerances(tolerances)


def _plane(
    curves: str | None, scatter: "tuple[Tolerance, ...]", over: str | None
) -> "tuple[Tolerance, Tolerance] | tuple[()]":
    """Return the two tolerances that --curves names, the axes of the curves' plane; an empty tuple without --curves."""
    from vijax.design.robustness.tolerance_plane import validate_tolerance_pair

    if curves is None:
        return ()
    if over is not None:
        raise ValueError(f"curves must be left out with over, which has many designs; got {curves}")
    names = [name.strip() for name in curves.split(",")]
    by_name = {tolerance.name: tolerance for tolerance in scatter}
    missing = [name for name in names if name not in by_name]
    if len(names) != 2 or missing:
        advice = f"; add --tolerance {missing[0]}=5%" if missing and missing[0] else ""
        raise ValueError(f"curves must name two of the tolerances, as in omega0,s; got {curves!r}{advice}")
    with name_option_in_errors("curves"):
        return validate_tolerance_pair([by_name[name] for name in names])


def _diagram(result: "Design", device: "Harvester", points: int) -> "xr.Dataset":
    """Compute the orbit diagram in both directions along the first tuned axis, with more values near the optimum."""
    import numpy as np

    from vijax.maps.orbit_diagram import orbit_diagram
    from vijax.model.tuned_quantities import LINEAR, bounds_of
    from vijax.plots.designs import close_view

    along = next((name for name in result.tune if name in PARAMETERS), "omega0")
    device = result.best.device if result.best else device
    low, high = bounds_of((along,), {along: result.bounds[along]} if along in result.bounds else {}, device)[:, 0]
    values = (np.linspace if along in LINEAR else np.geomspace)(low, high, points)
    if result.best is not None and along in result.best.values:
        first, last = close_view(along, result.best.values[along])
        near = np.linspace(max(first, low), min(last, high), points // 2)
        values = np.unique(np.concatenate([values, near]))
    return orbit_diagram(along=along, values=values, direction="both", device=device)


def _evaluate(result: "Design", request: DesignRequest, single: bool) -> dict[str, Any]:
    """Evaluate the best design under the tolerances and, if `single` (no --over), its surroundings and basins."""
    from vijax.design.optimise import tolerance_statistics
    from vijax.design.optimum import Optimum
    from vijax.design.robustness.off_design import arrival_statistics, parameter_ranges, rank_under_tolerances
    from vijax.design.robustness.surroundings import surroundings
    from vijax.design.robustness.tolerance_plane import tolerance_plane

    scatter = request.tolerances
    if result.best is None:
        return {"tolerances": scatter}
    spread = tolerance_statistics(result.best, scatter) if scatter else None
    evaluation: dict[str, Any] = {"tolerances": scatter, "spread": spread}
    if scatter and request.search["objective"] not in _SCATTER_OBJECTIVES:
        evaluation["ranking"] = rank_under_tolerances(result.optima, scatter)
    if single:
        evaluation["surroundings"] = surroundings(result.best, starts=request.basin_starts)
        evaluation |= {"parameter_ranges": parameter_ranges(result.best), "arrival": arrival_statistics(result.best)}
    if request.plane and isinstance(result.best, Optimum):
        evaluation["plane"] = tolerance_plane(result.best, request.plane)
    elif request.plane:
        warnings.warn("the design's motion is no orbit, and has no curves of bifurcations", stacklevel=2)
    return evaluation


# --- the page --------------------------------------------------------------------------------------------------------


def _goal_options() -> list[click.Parameter]:
    show: dict[str, Any] = {"show_default": True}
    within = "of a tuned quantity [kappa 2 to 400, r 0.05 to 0.95]"
    spread, goal = "tolerance of a constant", "quantity to maximise; mean, worst, expected are over the tolerances"
    motion = "any admits also chaos, by its averages"
    reliability = "with expected: share of the samples that keep the limits"
    return [
        click.Option(["--tune"], default="omega0", metavar="NAME,NAME", help="quantities to tune", **show),
        click.Option(["--bounds"], multiple=True, metavar="NAME=LO:HI", help=within),
        click.Option(["--tolerance"], multiple=True, metavar="NAME=5%[:lognormal]", help=spread),
        click.Option(["--objective"], type=Choice(options.OBJECTIVES), default="P", help=goal, **show),
        click.Option(["--motion"], type=Choice(options.MOTIONS), default="any", help=motion, **show),
        click.Option(["--reliability"], default="1", metavar="SHARE", help=reliability, **show),
        click.Option(["--over"], metavar="NAME=VALUES", help="axis along which to find the best designs"),
    ]


def _sections() -> Sections:
    show: dict[str, Any] = {"show_default": True}
    curves = "two of the tolerances: show bifurcations and limits in their plane, and the nearest one"
    return {
        "Goal": _goal_options(),
        "Survey": [
            click.Option(
                ["--survey-points"], type=Integer(2), default=256, help="parameter values in the survey", **show
            ),
            click.Option(["--starts"], type=Integer(1), default=8, help="starts of the survey at each value", **show),
            click.Option(["--max-impacts"], type=Integer(1), default=16, help="most impacts of an orbit", **show),
        ],
        "Report": [
            click.Option(
                ["--diagram-points"], type=Integer(2), default=320, help="number of values in the diagram of P", **show
            ),
            click.Option(
                ["--basin-starts"], type=Integer(1), default=2000, help="number of starts for the basins", **show
            ),
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
