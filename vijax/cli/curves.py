"""`vijax curves`: curves of bifurcations over a map, with what of codimension 2 they meet."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import options, process
from vijax.cli.arguments import about, device, take_axes
from vijax.cli.closing import close, how_many
from vijax.cli.curve_search import check_map, search, summary
from vijax.cli.kinds import NewFile, Real, Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted
from vijax.cli.sweep import PLANE, complete_outputs, plane_options
from vijax.cli.targets import targets
from vijax.planes.sweep_settings import SweepSettings

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.dataset import SweepPlan

_FILES, _ROWS = ("curves.zarr", "curves.png"), "curves.csv"


@dataclass(frozen=True)
class CurvesRequest:
    """Curves that are asked for.

    Attributes:
        map: Of labels; None where `plan` is to be run for it.
        plan: Of the map.
        files: Store, table and picture to write, where they are wanted.
        budget: Arguments of `bifurcation_curves`.
        shown: Arguments of `plots.curves`.
    """

    map: "xr.Dataset | None"
    plan: "SweepPlan | None"
    files: tuple[Path | None, Path | None, Path | None]
    budget: dict[str, Any]
    shown: dict[str, Any]


def bifurcations(overwrite: bool, yes: bool, **given: Any) -> None:
    """Find the curves of bifurcations over a map, and what of codimension 2 they meet.

    The map is that of a store, or is run first: over two parameters that the motion depends on. Ctrl-C ends the search
    for curves, and keeps those found until then.
    """
    with process.door():
        asked = _asked(overwrite, given)
        if asked.plan is not None:
            _agree(asked.plan, yes)
    if asked.files[2] is not None:
        process.import_beside("vijax.plots.curve_maps")
    labelled, ran = (asked.map, "") if asked.plan is None else _run(asked.plan)
    found, said = search(labelled, asked.budget)
    lines = [ran, said] if ran else [said]
    if not found.curves:
        click.echo("\n".join([*lines, *summary(found), "nothing was written"]))
        return
    from vijax.orbits.curve_dataset import curve_dataset

    dataset = curve_dataset(found)
    _write(dataset, labelled, asked, overwrite)
    close("\n".join([*lines, *summary(found, dataset)]), *asked.files)
    if found.ended == "stopped":
        process.stop(f"the {how_many(len(found.curves), 'curves')} found until then are kept")


def _asked(overwrite: bool, given: dict[str, Any]) -> CurvesRequest:
    from vijax.plots.style import check_format

    out, plot, rows, source = (given.pop(name) for name in ("out", "plot", "csv", "map"))
    alone = out is None and plot is None
    if alone and rows is not None:
        store = picture = None
    else:
        store, picture = targets(out, plot, _FILES, overwrite)
    table = _table(_ROWS if alone and rows is None else rows, overwrite)
    if picture is not None:
        check_format(picture)
    shown = {name: given.pop(name) for name in ("ground", "unstable")}
    budget = {name: given.pop(name) for name in ("max_rounds", "max_seconds", "limits")}
    budget = {name: value for name, value in budget.items() if value is not None}
    labelled, planned = (None, _planned(given)) if source is None else (_loaded(source, given), None)
    grounds = ["label", *([*planned.outputs] if planned else map(str, labelled or ()))]
    if shown["ground"] not in grounds:
        raise ValueError(f"ground must be among {', '.join(grounds)}; got {shown['ground']!r}")
    return CurvesRequest(labelled, planned, (store, table, picture), budget, shown)


def _table(rows: str | None, overwrite: bool) -> Path | None:
    from vijax.runtime.files import check_ending, check_output

    if rows is None:
        return None
    check_ending("csv", rows, ".csv")
    return check_output("csv", rows, overwrite)


def _planned(given: dict[str, Any]) -> "SweepPlan":
    """Plan the map that is to be run."""
    from vijax.planes.outputs import ON_REQUEST, OUTPUTS
    from vijax.planes.sweep import check_room, plan

    axes, made = take_axes(given, PLANE), device(given.pop("constants"))
    outputs = [name for name in OUTPUTS if name not in ON_REQUEST or name == "lyapunov"]
    planned = plan(axes, outputs, made, SweepSettings(**given))
    check_room(planned)
    check_map(planned)
    return planned


def _loaded(source: str, given: dict[str, Any]) -> "xr.Dataset":
    """Load the map of a store; raise where an option says how one is to be run."""
    from vijax.orbits.map_borders import labelled_plane
    from vijax.planes.store import load

    settings = {name: getattr(SweepSettings, name) for name in ("periods", "wall")}
    for name, value in given.items():
        if value is not None and value != () and value != settings.get(name):
            option = "set" if name == "constants" else name
            raise ValueError(f"{option} must be left out with map, which has its own; got {value}")
    with about("map"):
        labelled = load(source)
        labelled_plane(labelled)
    return labelled


def _agree(planned: "SweepPlan", yes: bool) -> None:
    from vijax.planes import estimate

    process.agree(estimate.of(planned), yes)


def _run(planned: "SweepPlan") -> "tuple[xr.Dataset, str]":
    from vijax.planes import sweep

    return counted(planned.count, lambda tell: sweep.run(planned, tell))


def _write(dataset: "xr.Dataset", labelled: "xr.Dataset", asked: CurvesRequest, overwrite: bool) -> None:
    from vijax.orbits.curve_rows import write_rows
    from vijax.planes.store import save

    store, table, picture = asked.files
    if store is not None:
        save(dataset, store, overwrite=overwrite)
    if table is not None:
        write_rows(dataset, table)
    if picture is not None:
        from vijax import plots

        plots.save(plots.curves(dataset, labelled, **asked.shown), picture)


# --- the page --------------------------------------------------------------------------------------------------------


def _budget_options() -> list[click.Parameter]:
    rounds = "looks at borders that no curve explains yet, after the first look"
    seconds = "begin nothing more after so many seconds of it [no limit]"
    return [
        click.Option(["--max-rounds"], type=Whole(0), default=8, show_default=True, help=rounds),
        click.Option(["--max-seconds"], type=Real("a positive number", min=0, min_open=True), help=seconds),
    ]


def _sections() -> Sections:
    store, out, plot, overwrite = "store of the map, in place of a plane", *options.file_options()
    ground = "what the map below the curves shows: label, P or another variable"
    limits = "follow also where orbits meet the penetration limit and the energy limit"
    faint = "draw grazings and limits of unstable orbits too, faintly"
    return {
        "Map": [
            click.Option(["--map"], type=NewFile(), metavar="FILE.zarr", help=store),
            *plane_options(),
            options.setting("periods", "forcing periods to run, at most", Whole(1)),
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
        "Files": [
            out,
            click.Option(["--csv"], type=NewFile(), metavar="FILE.csv", help="table to write, a row a point"),
            plot,
            overwrite,
        ],
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
