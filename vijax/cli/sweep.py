"""`vijax sweep`: a map over a plane of parameters."""

import math
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from vijax.cli import membranes, options, process
from vijax.cli.arguments import device, in_given_units, take_axes
from vijax.cli.closing import finish, harvest, limit_lines, statuses, tally, wide_gap_lines
from vijax.cli.excitation import excitation_options, take_excitation
from vijax.cli.kinds import Choice, Periods, Real, Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted
from vijax.cli.targets import drawn, targets
from vijax.model.choices import SolverName
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.dataset import SweepPlan

PLANE = {"d": "0.05:0.3:128", "kappa": "3:400:128:log"}
_LONG = 9  # From this period on cells are counted together.
_FILES = {"P": ("power_map.zarr", "power_map.png"), "label": ("label_map.zarr", "label_map.png")}


def power_map(
    constants: tuple[str, ...],
    outputs: str | None,
    show: str,
    overwrite: bool,
    workers: int | None,
    scheduler: str | None,
    yes: bool,
    curves: bool,
    **given: Any,
) -> None:
    """Map the energy harvested over a plane of parameters."""
    with process.door():
        _check_show(show, given["until"], given["starts"])
        files = _FILES.get(show, (f"{show}_map.zarr", f"{show}_map.png"))
        picture = given.pop("plot")
        out, plot, rows = targets(given.pop("out"), picture, files, overwrite, goes_on=True, csv=given.pop("csv"))
        axes, made = take_axes(given, PLANE), device(constants)
        from vijax.planes import tiled_store

        wanted = _wanted(outputs, show, given["starts"], tiled_store.begun(out, overwrite))
        planned = _plan(axes, made, wanted, given)
        plot = drawn(plot, picture, planned.cells.sizes)
        if plot is not None:
            _check_picture(plot, planned, show)
        if curves:
            _check_curves(planned, plot)
        crew = _crew(planned, workers, scheduler, out)
        _check_room(planned, out, overwrite)
        _agree(planned, yes)
    if plot is not None:
        process.import_beside("vijax.plots.number_maps")
    from vijax.planes import sweep as sweeps

    dataset, pace = counted(planned.count, lambda tell: sweeps.run(planned, tell, out, overwrite, crew))
    said, over = f"{pace}\n{_summary(dataset)}", None
    if curves:
        over, told = _curves(dataset)
        said += f"\n{told}"
    finish(dataset, said, out, plot, partial(_draw, show, over), overwrite, kept=True, table=rows)
    if over is not None and over.attrs["ended"] == "stopped":
        process.stop("the map and the curves found until then are kept")


def _check_curves(planned: "SweepPlan", plot: Path | None) -> None:
    """Raise ValueError unless curves of bifurcations can be drawn over the map."""
    from vijax.cli.curve_search import check_map
    from vijax.plots.style import LABEL_NEEDS

    if plot is None:
        raise ValueError("curves must come with a picture that they are drawn on; got none; add --plot")
    missing = [name for name in LABEL_NEEDS if name not in planned.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for curves; add them, or leave --curves out")
    check_map(planned)


def _curves(dataset: "xr.Dataset") -> "tuple[xr.Dataset | None, str]":
    """Find the curves of bifurcations over a map, and tell what they are."""
    from vijax.cli.curve_search import search, summary
    from vijax.orbits.curve_dataset import curve_dataset

    found, pace = search(dataset.load(), {})
    table = curve_dataset(found) if found.curves else None
    return table, "\n".join([pace, *summary(found, table)])


def _crew(planned: "SweepPlan", workers: int | None, scheduler: str | None, out: Path | None) -> int | str | None:
    """Say who runs the tiles, unless this process does."""
    from vijax.planes.sweep import check_workers

    if workers is not None and scheduler is not None:
        raise ValueError(f"workers must be left out with scheduler, which has its own; got {workers}")
    crew = scheduler if workers is None else workers
    if crew is not None:
        check_workers(planned, crew, out)
    return crew


def _check_room(planned: "SweepPlan", out: Path | None, overwrite: bool) -> None:
    from vijax.planes import sweep as sweeps

    if out is None:
        sweeps.check_room(planned)
    else:
        sweeps.check(planned, out, overwrite)


def _agree(planned: "SweepPlan", yes: bool) -> None:
    from vijax.planes import estimate

    process.agree(estimate.of(planned), yes)


def _check_show(show: str, until: str, starts: int) -> None:
    from vijax.planes.outputs import table

    known = table(starts)
    if show not in known and (show != "label" or starts > 1):
        listed = ", ".join(known)
        must = f"label, or among {listed}" if starts == 1 else f"among {listed} with several starts"
        raise ValueError(f"show must be {must}; got {show!r}")
    if show == "label" and until != "attractor":
        raise ValueError(f"show must not be label unless cells are run until their attractor; got until {until}")


def _wanted(outputs: str | None, show: str, starts: int, begun: Collection[str] | None) -> list[str]:
    if outputs is not None:
        return [name.strip() for name in outputs.split(",")]
    from vijax.planes.outputs import default_outputs

    return [*dict.fromkeys((*default_outputs(starts, begun), "lyapunov" if show == "label" else show))]


def _plan(axes: dict[str, Any], device: Any, outputs: list[str] | None, given: dict[str, Any]) -> "SweepPlan":
    from vijax.planes.axes import counted_periods
    from vijax.planes.sweep import plan
    from vijax.planes.sweep_settings import SweepSettings

    membrane = membranes.take_membrane(given)
    refine, starts, excitation = given.pop("refine"), given.pop("starts"), take_excitation(given)
    given["periods"] = counted_periods(given["periods"], excitation, given["transient"], axes, device)
    settings = SweepSettings(**given, membrane=membrane, excitation=excitation)
    return plan(axes, outputs, device, settings, refine, starts)


def _check_picture(path: Path, planned: "SweepPlan", show: str) -> None:
    from vijax.planes.dataset import specimen
    from vijax.plots import style

    style.check_format(path)
    power = style.NEEDS if planned.starts == 1 else style.EXPECTED_NEEDS
    needs = {"label": style.LABEL_NEEDS, "P": power}.get(show, (show,))
    missing = [name for name in needs if name not in planned.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for a picture; add them, or give --out alone")
    sizes = planned.cells.sizes
    if show == "label":
        style.layout_of_kinds({dim: sizes[dim] for dim in planned.cells.dynamic})
        return
    if show == "P":
        style.layout(sizes)
        return
    drawn = specimen(planned)[show]  # its dimensions are those that it depends on
    fits = style.layout_of_kinds if style.is_kind(drawn) else style.layout
    fits({str(dim): sizes[str(dim)] for dim in drawn.dims})


def _draw(show: str, curves: "xr.Dataset | None", dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    if curves is not None:
        plots.save(plots.curves(curves, dataset, ground=show), path)
        return
    known, dataset = {"P": plots.power_map, "label": plots.label_map}, in_given_units(dataset)
    plots.save(known[show](dataset) if show in known else plots.variable_map(dataset, show), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Say what the map holds, in a few lines: cells by status and by period, the best of them."""
    from vijax.planes.dataset import best

    lines = [statuses(dataset["status"])]
    if "computed" in dataset:
        computed, shown = dataset.attrs["refine_computed"], dataset.attrs["refine_shown"]
        lines.insert(0, f"cells computed: {computed:,} of {shown:,} shown, {computed / shown:.1%}; the others filled")
    if "period" in dataset:
        names = {-1: "undecided", 0: "aperiodic"} | {n: f"period {n}" for n in range(1, _LONG)}
        periods = tally(
            dataset["period"].values,
            lambda period: names.get(period, f"{_LONG} and more"),
            order=lambda period: period if period > 0 else math.inf,
        )
        lines.append(f"cells by period: {periods}")
    if "attractors" in dataset:
        number = tally(dataset["attractors"].values, lambda found: str(found), order=lambda found: found)
        lines.append(f"cells by attractors found: {number}")
    lines += [*wide_gap_lines(dataset), *limit_lines(dataset)]
    if "P" in dataset and dataset["P"].size == 1:
        lines.append(f"P: {_only(dataset)}")
    elif {"P", "admissible"} <= set(dataset):
        peak = best(dataset)
        lines.append(f"largest admissible P: {see('model', 'none') if peak is None else _place(peak, dataset)}")
    return "\n".join(lines)


def _place(peak: "xr.DataArray", dataset: "xr.Dataset") -> str:
    there = in_given_units(peak.to_dataset(name="P"))
    units = {dim: f" {there[dim].attrs.get('units', '1')}".removesuffix(" 1") for dim in dataset["P"].dims}
    where = ", ".join(f"{dim} = {float(there[dim]):.6g}{unit}" for dim, unit in units.items())
    return f"{harvest(float(peak), float(peak * peak['omega'] / math.pi))} at {where}"


def _only(dataset: "xr.Dataset") -> str:
    """Say what the only cell of a map gives, and whether to believe it."""
    P = dataset["P"].squeeze()
    said = harvest(float(P), float(P * P["omega"] / math.pi))
    if "admissible" not in dataset:
        return said
    return f"{said}, admissible" if bool(dataset["admissible"].squeeze()) else see("model", f"{said}, inadmissible")


# --- the page --------------------------------------------------------------------------------------------------------


def plane_options() -> list[click.Parameter]:
    """Make options of the axes, with the plane that is mapped by default, and of the device."""
    planes = {name: options.unless_physical(text) for name, text in PLANE.items()}
    return [*options.axis_options(defaults=planes), *options.device_options()]


def run_options() -> list[click.Parameter]:
    """Make options of how long cells are run."""
    return [
        options.setting("periods", "forcing periods to run, at most; all of a record", Periods(1)),
        options.setting("until", "what cells are run to"),
        options.setting("transient", "periods to drop before a window", Whole(0)),
    ]


def _starts_option() -> click.Parameter:
    many = "starts in every cell; with several P is their mean, and the attractors that share them are told"
    return click.Option(["--starts"], type=Whole(1), default=1, show_default=True, help=many)


def _method_options() -> list[click.Parameter]:
    solvers = get_args(SolverName)
    listed = f"of ode: {', '.join(solvers)} [Tsit5]"
    above = Real("a finite number above 0", min=0, min_open=True)
    least = Real("a finite number of at least 0", min=0)
    return [
        options.setting("method", "engine"),
        click.Option(["--solver"], type=Choice(solvers), metavar="NAME", help=listed),
        options.setting("rtol", "of ode: relative tolerance of a step [1e-8]", float),
        options.setting("atol", "of ode: absolute tolerance of a step [1e-10]", above),
        options.setting("friction", "of ode: dry friction along the capsule, over the forcing's amplitude [0]", least),
        options.setting("steps", "of rk4: steps per forcing period [1000]", Whole(8)),
        *membranes.membrane_options("of ode and rk4"),
    ]


def _dask_options() -> list[click.Parameter]:
    return [
        click.Option(["--workers"], type=Whole(1), help="processes that share the cores and write the store, by Dask"),
        click.Option(["--scheduler"], metavar="ADDRESS", help="of Dask: its workers, which see the store, write it"),
    ]


def _output_options() -> list[click.Parameter]:
    wanted = "variables wanted [all but those on request; for labels lyapunov too]"
    some = "compute every 2^LEVELS-th cell along each axis, then those at borders; fill the others"
    shown = "what the picture shows: any variable, or label"
    drawn = "draw curves of bifurcations over the picture, and list what they meet"
    return [
        click.Option(["--outputs"], metavar="NAME,NAME", shell_complete=complete_outputs, help=wanted),
        click.Option(["--refine"], type=Whole(1), metavar="LEVELS", help=some),
        click.Option(
            ["--show"], metavar="NAME", default="P", show_default=True, shell_complete=complete_outputs, help=shown
        ),
        click.Option(["--curves"], is_flag=True, help=drawn),
    ]


def complete_outputs(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Complete a name of variables, or the last of several. The rooms that know them take a moment to load."""
    from vijax.planes.outputs import EXPECTED, OUTPUTS

    before, comma, begun = incomplete.rpartition(",")
    known = dict.fromkeys([*OUTPUTS, *EXPECTED])
    names = known if param.name == "outputs" else [*known, "label"]
    return [f"{before}{comma}{name}" for name in names if name.startswith(begun)]


def sections() -> Sections:
    """Make the options of the page."""
    return {
        "Plane": plane_options(),
        "Run": [*run_options(), _starts_option(), options.wall_option()],
        "Excitation": excitation_options(),
        "Method": [*_method_options(), options.dtype_option()],
        "Variables": _output_options(),
        "Files": options.file_options(),
        "Large runs": [*_dask_options(), options.size_option()],
    }


NEITHER = (
    f"{options.VALUES} With none of --out, --csv and --plot, power_map.zarr and power_map.png are written, or the same "
    "of label_map or NAME_map, by what is shown."
)
GOES_ON = (
    "A map is written as it is made: stopped in whatever way, the same command goes on with it, and --overwrite begins "
    "anew."
)
EXAMPLES = (
    "",
    "--gamma 0.1 --out inclined.zarr --plot inclined.png",
    "--omega pi:6pi:96 --omega0 20:400:96 --plot device.png",
    "--show label --plot labels.png",
    "--show max_penetration --plot depth.png",
    "--show label --curves --plot curves.png",
    "--starts 64 --plot expected.png",
    "--noise 0.05,32 --until window --periods 200 --plot noisy.png",
    "--d 0.05:0.3:1024 --kappa 3:400:1024:log --refine 3 --out fine.zarr --plot fine.png",
    "--d 0.2,0.3 --kappa 40:400:8:log --method ode --membrane hunt-crossley --chi 0.8 --out hertz.zarr",
)

sweep = Page("sweep", power_map, sections(), EXAMPLES, f"{NEITHER} {GOES_ON}")
