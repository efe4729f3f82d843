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
from vijax.model.quantities import AXES
from vijax.planes.sweep_settings import SweepSettings

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.dataset import SweepPlan

_FILES, _ROWS = ("curves.zarr", "curves.png"), "curves.csv"


@dataclass(frozen=True)
class CurvesRequest:
    """Curves that are asked for.

    Attributes:
        map: Of labels, or the plan of one that is to be run.
        files: Store, table and picture to write, where they are wanted.
        budget: Arguments of `bifurcation_curves`.
        shown: Arguments of `plots.curves`.
    """

    map: "xr.Dataset | SweepPlan"
    files: tuple[Path | None, Path | None, Path | None]
    budget: dict[str, Any]
    shown: dict[str, Any]


def bifurcations(overwrite: bool, yes: bool, **given: Any) -> None:
    """Find the curves of bifurcations over a map.

    The map is that of a store, or is run first: over two parameters that the motion depends on. What the curves meet of
    codimension 2 is listed. Ctrl-C ends the search for them, and keeps those found until then.
    """
    with process.door():
        asked = _asked(overwrite, given)
        _agree(asked.map, yes)
    if asked.files[2] is not None:
        process.import_beside("vijax.plots.curve_maps")
    labelled, lines = _run(asked.map)
    found, said = search(labelled, asked.budget)
    lines.append(said)
    if found.curves:
        from vijax.orbits.curve_dataset import curve_dataset

        dataset = curve_dataset(found)
        _write(dataset, labelled, asked, overwrite)
        close("\n".join([*lines, *summary(found, dataset)]), *asked.files)
    else:
        click.echo("\n".join([*lines, *summary(found), "nothing was written"]))
    if found.ended == "stopped":
        process.stop(f"the {how_many(len(found.curves), 'curves')} found until then are kept")


def _asked(overwrite: bool, given: dict[str, Any]) -> CurvesRequest:
    from vijax.orbits.map_curves import check_budget
    from vijax.plots.style import check_format
    from vijax.runtime import checks

    out, plot, rows, source = (given.pop(name) for name in ("out", "plot", "csv", "map"))
    if out is None and plot is None and rows is None:
        (out, plot), rows = _FILES, _ROWS
    store, picture, table = targets(out, plot, _FILES, overwrite, csv=rows)
    if picture is not None:
        check_format(picture)
    shown = {name: given.pop(name) for name in ("ground", "unstable")}
    budget = {name: given.pop(name) for name in ("max_rounds", "max_seconds", "limits")}
    budget = {name: value for name, value in budget.items() if value is not None}
    labelled, variables = _planned(given) if source is None else _loaded(source, given)
    checks.choice("ground", shown["ground"], ["label", *variables])
    check_budget(**{name: budget[name] for name in ("max_rounds", "max_seconds") if name in budget})
    return CurvesRequest(labelled, (store, table, picture), budget, shown)


def _planned(given: dict[str, Any]) -> "tuple[SweepPlan, list[str]]":
    """Plan the map that is to be run, and name what it will hold."""
    from vijax.planes.outputs import default_outputs
    from vijax.planes.sweep import check_room, plan

    # Where two others have several values d and kappa are the device's.
    several = [name for name in AXES if set(given[name] or "") & set(":,@")]
    axes, made = take_axes(given, PLANE if len(several) < 2 else {}), device(given.pop("constants"))
    planned = plan(axes, [*default_outputs(1), "lyapunov"], made, SweepSettings(**given))
    check_room(planned)
    check_map(planned)
    return planned, [*planned.outputs]


def _loaded(source: str, given: dict[str, Any]) -> "tuple[xr.Dataset, list[str]]":
    """Load the map of a store, and name what it holds; raise where an option says how one is to be run."""
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
    return labelled, [*map(str, labelled)]


def _agree(asked: "xr.Dataset | SweepPlan", yes: bool) -> None:
    from vijax.planes import estimate
    from vijax.planes.dataset import SweepPlan

    if isinstance(asked, SweepPlan):
        process.agree(estimate.of(asked), yes)


def _run(asked: "xr.Dataset | SweepPlan") -> "tuple[xr.Dataset, list[str]]":
    """Run the map, unless it is there; say how fast."""
    from vijax.planes import sweep
    from vijax.planes.dataset import SweepPlan

    if not isinstance(asked, SweepPlan):
        return asked, []
    dataset, said = counted(asked.count, lambda tell: sweep.run(asked, tell))
    return dataset, [said]


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
    store = "store of the map, in place of a plane"
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
