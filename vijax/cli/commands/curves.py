"""`vijax curves`: bifurcation curves over a map, with their points of codimension 2."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, name_option_in_errors, take_axes
from vijax.cli.closing import close, format_count
from vijax.cli.commands.sweep import PLANE, complete_outputs, plane_options
from vijax.cli.options import options
from vijax.cli.options.curve_search import check_map, search, summary
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Integer, NewFile, Real
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.quantities import AXES

if TYPE_CHECKING:
    import xarray as xr

    from vijax.maps.map_dataset import SweepPlan

_FILES, _ROWS = ("curves.zarr", "curves.png"), "curves.csv"


@dataclass(frozen=True)
class CurvesRequest:
    """Validated arguments of `vijax curves`.

    Attributes:
        map: A computed map with labels, or the plan of a map that is computed first.
        files: Paths of store, table and picture, in this order; None for a file that is not written.
        budget: Arguments of `bifurcation_curves`.
        plot_arguments: Arguments of `plots.curves`.
    """

    map: "xr.Dataset | SweepPlan"
    files: tuple[Path | None, Path | None, Path | None]
    budget: dict[str, Any]
    plot_arguments: dict[str, Any]


def bifurcations(overwrite: bool, yes: bool, **parameters: Any) -> None:
    """Find the curves of bifurcations over a map.

    The map is read from the store of --map, or is computed first over a plane of two parameters that the motion depends
    on. Points of codimension 2 on the curves are listed. Ctrl-C ends the search; the curves found until then are kept.
    """
    with process.usage_errors():
        request = _make_request(overwrite, parameters)
        _agree(request.map, yes)
    if request.files[2] is not None:
        process.import_in_background("vijax.plots.curve_maps")
    labelled, lines = _run(request.map)
    result, rate = search(labelled, request.budget)
    lines.append(rate)
    if result.curves:
        from vijax.continuation.curves.curve_dataset import curve_dataset

        dataset = curve_dataset(result)
        _write(dataset, labelled, request, overwrite)
        close("\n".join([*lines, *summary(result, dataset)]), *request.files)
    else:
        click.echo("\n".join([*lines, *summary(result), "nothing was written"]))
    if result.ended == "stopped":
        process.stop(f"the {format_count(len(result.curves), 'curves')} found until then are kept")


def _make_request(overwrite: bool, parameters: dict[str, Any]) -> CurvesRequest:
    from vijax.continuation.from_map.map_curves import check_budget
    from vijax.plots.style import check_format
    from vijax.runtime import validation

    out, plot, rows, source = (parameters.pop(name) for name in ("out", "plot", "csv", "map"))
    if out is None and plot is None and rows is None:
        (out, plot), rows = _FILES, _ROWS
    store, picture, table = targets(out, plot, _FILES, overwrite, csv=rows)
    if picture is not None:
        check_format(picture)
    plot_arguments = {name: parameters.pop(name) for name in ("ground", "unstable")}
    budget = {name: parameters.pop(name) for name in ("max_rounds", "max_seconds", "limits")}
    budget = {name: value for name, value in budget.items() if value is not None}
    labelled, variables = _plan_map(parameters) if source is None else _load_map(source, parameters)
    validation.validate_choice("ground", plot_arguments["ground"], ["label", *variables])
    check_budget(**{name: budget[name] for name in ("max_rounds", "max_seconds") if name in budget})
    return CurvesRequest(labelled, (store, table, picture), budget, plot_arguments)


def _plan_map(parameters: dict[str, Any]) -> "tuple[SweepPlan, list[str]]":
    """Plan the map to run; return the plan and the names of its variables."""
    from vijax.maps.outputs import default_outputs
    from vijax.maps.sweep import check_fits_memory, plan

    # The default plane of d and kappa applies unless the user specifies two axes with several values. An axis has
    # several values if its text contains ":", "," or "@".
    several = [name for name in AXES if set(parameters[name] or "") & set(":,@")]
    axes, harvester = take_axes(parameters, PLANE if len(several) < 2 else {}), device(parameters.pop("constants"))
    sweep_plan = plan(axes, [*default_outputs(1), "lyapunov"], harvester, SweepSettings(**parameters))
    check_fits_memory(sweep_plan)
    check_map(sweep_plan)
    return sweep_plan, [*sweep_plan.outputs]


def _load_map(source: str, parameters: dict[str, Any]) -> "tuple[xr.Dataset, list[str]]":
    """Load the map of a store, and return the map and the names of its variables.

    Raises:
        ValueError: If the user specified an option that only applies to a new map.
    """
    from vijax.continuation.from_map.map_borders import labelled_plane
    from vijax.maps.storage.store import load

    settings = {name: getattr(SweepSettings, name) for name in ("periods", "wall")}
    for name, value in parameters.items():
        if value is not None and value != () and value != settings.get(name):
            option = "set" if name == "constants" else name
            raise ValueError(f"{option} must be left out with map, which has its own; got {value}")
    with name_option_in_errors("map"):
        labelled = load(source)
        labelled_plane(labelled)
    return labelled, [*map(str, labelled)]


def _agree(plane: "xr.Dataset | SweepPlan", yes: bool) -> None:
    from vijax.maps.execution import estimate
    from vijax.maps.map_dataset import SweepPlan

    if isinstance(plane, SweepPlan):
        process.agree(estimate.estimate_runs(plane), yes)


def _run(plane: "xr.Dataset | SweepPlan") -> "tuple[xr.Dataset, list[str]]":
    """Compute the map if `plane` is a plan; return the map, and a line with the rate, or no line for a given map."""
    from vijax.maps import sweep
    from vijax.maps.map_dataset import SweepPlan

    if not isinstance(plane, SweepPlan):
        return plane, []
    dataset, rate = counted(plane.count, lambda report: sweep.run(plane, report))
    return dataset, [rate]


def _write(dataset: "xr.Dataset", labelled: "xr.Dataset", request: CurvesRequest, overwrite: bool) -> None:
    from vijax.continuation.curves.curve_table import write_rows
    from vijax.maps.storage.store import save

    store, table, picture = request.files
    if store is not None:
        save(dataset, store, overwrite=overwrite)
    if table is not None:
        write_rows(dataset, table)
    if picture is not None:
        from vijax import plots

        plots.save(plots.curves(dataset, labelled, **request.plot_arguments), picture)


# --- the page --------------------------------------------------------------------------------------------------------


def _budget_options() -> list[click.Parameter]:
    rounds = "further search rounds at borders that no curve explains"
    seconds = "start no further search after this number of seconds [no limit]"
    return [
        click.Option(["--max-rounds"], type=Integer(0), default=8, show_default=True, help=rounds),
        click.Option(["--max-seconds"], type=Real("a positive number", min=0, min_open=True), help=seconds),
    ]


def _sections() -> Sections:
    store = "store of the map, in place of a plane"
    ground = "variable of the map below the curves: label, P or another"
    limits = "follow also the penetration limit and the energy limit of orbits"
    faint = "draw grazings and limits of unstable orbits too, faintly"
    return {
        "Map": [
            click.Option(["--map"], type=NewFile(), metavar="FILE.zarr", help=store),
            *plane_options(),
            options.setting("periods", "forcing periods to run, at most", Integer(1)),
            options.wall_option(),
        ],
        "Search": [*_budget_options(), click.Option(["--limits"], is_flag=True, help=limits)],
        "Picture": [
            click.Option(
                ["--ground"],
                metavar="NAME",
                default="label",
                show_default=True,
                shell_complete=complete_outputs,
                help=ground,
            ),
            click.Option(["--unstable"], is_flag=True, help=faint),
        ],
        "Files": options.file_options(row="point"),
        "Large runs": [options.size_option()],
    }


_EXAMPLES = (
    "",
    "--ground P --unstable --plot curves.png",
    "--wall rigid --d 0.1:0.32:64 --r 0.2:0.9:64 --max-seconds 60",
    "--omega 3:12:96 --omega0 20:400:96:log --s 0.2 --out curves.zarr --csv curves.csv",
)

curves = Page(
    "curves",
    bifurcations,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, curves.zarr, curves.csv and curves.png are written. A map "
    "that is there already, of `vijax sweep --out map.zarr`, is taken by --map map.zarr.",
)
