"""`vijax sweep`: a map over a plane of parameters."""

import math
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from vijax.cli import process
from vijax.cli.arguments import device, in_command_units, take_axes
from vijax.cli.closing import finish, harvest, limit_lines, statuses, tally, wide_gap_lines
from vijax.cli.options import membranes, options
from vijax.cli.options.excitation import excitation_options, take_excitation
from vijax.cli.options.output_files import drawn, targets
from vijax.cli.options.value_types import Choice, Integer, Periods, Real
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted
from vijax.model.choices import SolverName
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    import xarray as xr

    from vijax.maps.map_dataset import SweepPlan

PLANE = {"d": "0.05:0.3:128", "kappa": "3:400:128:log"}
_LONG = 9  # all cells with a period of at least 9 forcing periods are counted together
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
    **parameters: Any,
) -> None:
    """Map the energy harvested over a plane of parameters."""
    with process.usage_errors():
        _check_show(show, parameters["until"], parameters["starts"])
        files = _FILES.get(show, (f"{show}_map.zarr", f"{show}_map.png"))
        picture = parameters.pop("plot")
        out, plot, rows = targets(
            parameters.pop("out"), picture, files, overwrite, resumable=True, csv=parameters.pop("csv")
        )
        axes, harvester = take_axes(parameters, PLANE), device(constants)
        from vijax.maps.storage import tiled_store

        output_names = _output_names(
            outputs, show, parameters["starts"], tiled_store.existing_variables(out, overwrite)
        )
        sweep_plan = _plan(axes, harvester, output_names, parameters)
        plot = drawn(plot, picture, sweep_plan.cells.sizes)
        if plot is not None:
            _check_picture(plot, sweep_plan, show)
        if curves:
            _check_curves(sweep_plan, plot)
        crew = _crew(sweep_plan, workers, scheduler, out)
        _check_resources(sweep_plan, out, overwrite)
        _agree(sweep_plan, yes)
    if plot is not None:
        process.import_in_background("vijax.plots.number_maps")
    from vijax.maps import sweep as sweeps

    dataset, rate = counted(sweep_plan.count, lambda report: sweeps.run(sweep_plan, report, out, overwrite, crew))
    summary, curve_table = f"{rate}\n{_summary(dataset)}", None
    if curves:
        curve_table, curve_lines = _curves(dataset)
        summary += f"\n{curve_lines}"
    finish(dataset, summary, out, plot, partial(_draw, show, curve_table), overwrite, store_written=True, table=rows)
    if curve_table is not None and curve_table.attrs["ended"] == "stopped":
        process.stop("the map and the curves found until then are kept")


def _check_curves(sweep_plan: "SweepPlan", plot: Path | None) -> None:
    """Raise ValueError unless curves of bifurcations can be drawn over the map."""
    from vijax.cli.options.curve_search import check_map
    from vijax.plots.style import LABEL_NEEDS

    if plot is None:
        raise ValueError("curves must come with a picture that they are drawn on; got none; add --plot")
    missing = [name for name in LABEL_NEEDS if name not in sweep_plan.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for curves; add them, or leave --curves out")
    check_map(sweep_plan)


def _curves(dataset: "xr.Dataset") -> "tuple[xr.Dataset | None, str]":
    """Search for the bifurcation curves of a map; return their dataset (None if no curve is found) and a summary."""
    from vijax.cli.options.curve_search import search, summary
    from vijax.continuation.curves.curve_dataset import curve_dataset

    result, rate = search(dataset.load(), {})
    table = curve_dataset(result) if result.curves else None
    return table, "\n".join([rate, *summary(result, table)])


def _crew(sweep_plan: "SweepPlan", workers: int | None, scheduler: str | None, out: Path | None) -> int | str | None:
    """Return the number of worker processes, or the address of the Dask scheduler, that compute the tiles.

    None means that this process computes the tiles.
    """
    from vijax.maps.sweep import check_workers

    if workers is not None and scheduler is not None:
        raise ValueError(f"workers must be left out with scheduler, which has its own; got {workers}")
    crew = scheduler if workers is None else workers
    if crew is not None:
        check_workers(sweep_plan, crew, out)
    return crew


def _check_resources(sweep_plan: "SweepPlan", out: Path | None, overwrite: bool) -> None:
    from vijax.maps import sweep as sweeps

    if out is None:
        sweeps.check_fits_memory(sweep_plan)
    else:
        sweeps.check_out(sweep_plan, out, overwrite)


def _agree(sweep_plan: "SweepPlan", yes: bool) -> None:
    from vijax.maps.execution import estimate

    process.agree(estimate.estimate_runs(sweep_plan), yes)


def _check_show(show: str, until: str, starts: int) -> None:
    from vijax.maps.outputs import available_outputs

    outputs = available_outputs(starts)
    if show not in outputs and (show != "label" or starts > 1):
        listed = ", ".join(outputs)
        must = f"label, or among {listed}" if starts == 1 else f"among {listed} with several starts"
        raise ValueError(f"show must be {must}; got {show!r}")
    if show == "label" and until != "attractor":
        raise ValueError(f"show must not be label unless cells are run until their attractor; got until {until}")


def _output_names(outputs: str | None, show: str, starts: int, existing: Collection[str] | None) -> list[str]:
    if outputs is not None:
        return [name.strip() for name in outputs.split(",")]
    from vijax.maps.outputs import default_outputs

    return [*dict.fromkeys((*default_outputs(starts, existing), "lyapunov" if show == "label" else show))]


def _plan(axes: dict[str, Any], device: Any, outputs: list[str] | None, parameters: dict[str, Any]) -> "SweepPlan":
    from vijax.maps.axes import counted_periods
    from vijax.maps.sweep import plan
    from vijax.maps.sweep_settings import SweepSettings

    membrane = membranes.take_membrane(parameters)
    refine, starts, excitation = parameters.pop("refine"), parameters.pop("starts"), take_excitation(parameters)
    parameters["periods"] = counted_periods(parameters["periods"], excitation, parameters["transient"], axes, device)
    settings = SweepSettings(**parameters, membrane=membrane, excitation=excitation)
    return plan(axes, outputs, device, settings, refine, starts)


def _check_picture(path: Path, sweep_plan: "SweepPlan", show: str) -> None:
    from vijax.maps.map_dataset import blank_map
    from vijax.plots import style

    style.check_format(path)
    power = style.NEEDS if sweep_plan.starts == 1 else style.EXPECTED_NEEDS
    needs = {"label": style.LABEL_NEEDS, "P": power}.get(show, (show,))
    missing = [name for name in needs if name not in sweep_plan.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for a picture; add them, or give --out alone")
    sizes = sweep_plan.cells.sizes
    if show == "label":
        style.layout_of_kinds({dim: sizes[dim] for dim in sweep_plan.cells.dynamic})
        return
    if show == "P":
        style.layout(sizes)
        return
    drawn = blank_map(sweep_plan)[show]  # has only the dimensions that the variable depends on
    fits = style.layout_of_kinds if style.is_kind(drawn) else style.layout
    fits({str(dim): sizes[str(dim)] for dim in drawn.dims})


def _draw(show: str, curves: "xr.Dataset | None", dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    if curves is not None:
        plots.save(plots.curves(curves, dataset, ground=show), path)
        return
    maps, dataset = {"P": plots.power_map, "label": plots.label_map}, in_command_units(dataset)
    plots.save(maps[show](dataset) if show in maps else plots.variable_map(dataset, show), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Return a text with the numbers of cells by status and period, and the best admissible cell."""
    from vijax.maps.map_dataset import best

    lines = [statuses(dataset["status"])]
    if "computed" in dataset:
        computed, total = dataset.attrs["refine_computed"], dataset.attrs["refine_shown"]
        lines.insert(0, f"cells computed: {computed:,} of {total:,} shown, {computed / total:.1%}; the others filled")
    if "period" in dataset:
        names = {-1: "undecided", 0: "aperiodic"} | {n: f"period {n}" for n in range(1, _LONG)}
        periods = tally(
            dataset["period"].values,
            lambda period: names.get(period, f"{_LONG} and more"),
            order=lambda period: period if period > 0 else math.inf,
        )
        lines.append(f"cells by period: {periods}")
    if "attractors" in dataset:
        number = tally(dataset["attractors"].values, lambda count: str(count), order=lambda count: count)
        lines.append(f"cells by attractors found: {number}")
    lines += [*wide_gap_lines(dataset), *limit_lines(dataset)]
    if "P" in dataset and dataset["P"].size == 1:
        lines.append(f"P: {_only(dataset)}")
    elif {"P", "admissible"} <= set(dataset):
        peak = best(dataset)
        lines.append(f"largest admissible P: {see('model', 'none') if peak is None else _place(peak, dataset)}")
    return "\n".join(lines)


def _place(peak: "xr.DataArray", dataset: "xr.Dataset") -> str:
    there = in_command_units(peak.to_dataset(name="P"))
    units = {dim: f" {there[dim].attrs.get('units', '1')}".removesuffix(" 1") for dim in dataset["P"].dims}
    where = ", ".join(f"{dim} = {float(there[dim]):.6g}{unit}" for dim, unit in units.items())
    return f"{harvest(float(peak), float(peak * peak['omega'] / math.pi))} at {where}"


def _only(dataset: "xr.Dataset") -> str:
    """Return a text with the P of the only cell of a map, and whether it is admissible."""
    P = dataset["P"].squeeze()
    energy = harvest(float(P), float(P * P["omega"] / math.pi))
    if "admissible" not in dataset:
        return energy
    return f"{energy}, admissible" if bool(dataset["admissible"].squeeze()) else see("model", f"{energy}, inadmissible")


# --- the page --------------------------------------------------------------------------------------------------------


def plane_options() -> list[click.Parameter]:
    """Return the options of the axes, with the default plane of d and kappa in their help, and of the device."""
    planes = {name: options.unless_physical(text) for name, text in PLANE.items()}
    return [*options.axis_options(defaults=planes), *options.device_options()]


def run_options() -> list[click.Parameter]:
    """Return the options that determine for how many forcing periods a cell is simulated."""
    return [
        options.setting("periods", "forcing periods to run, at most; all of a record", Periods(1)),
        options.setting("until", "end of the simulation of a cell"),
        options.setting("transient", "periods to drop before a window", Integer(0)),
    ]


def _starts_option() -> click.Parameter:
    many = "starts in every cell; several give the mean P and the shares of the attractors"
    return click.Option(["--starts"], type=Integer(1), default=1, show_default=True, help=many)


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
        options.setting("steps", "of rk4: steps per forcing period [1000]", Integer(8)),
        *membranes.membrane_options("of ode and rk4"),
    ]


def _dask_options() -> list[click.Parameter]:
    return [
        click.Option(
            ["--workers"], type=Integer(1), help="processes that share the cores and write the store, by Dask"
        ),
        click.Option(
            ["--scheduler"],
            metavar="ADDRESS",
            help="of a Dask scheduler: its workers write the store, to which they need access",
        ),
    ]


def _output_options() -> list[click.Parameter]:
    outputs_help = "variables to compute [all except those on request; for labels also lyapunov]"
    refine_help = "compute every 2^LEVELS-th cell along each axis, then those at borders; fill the others"
    show_help = "variable in the picture, or label"
    curves_help = "draw curves of bifurcations over the picture, and list their points of codimension 2"
    return [
        click.Option(["--outputs"], metavar="NAME,NAME", shell_complete=complete_outputs, help=outputs_help),
        click.Option(["--refine"], type=Integer(1), metavar="LEVELS", help=refine_help),
        click.Option(
            ["--show"], metavar="NAME", default="P", show_default=True, shell_complete=complete_outputs, help=show_help
        ),
        click.Option(["--curves"], is_flag=True, help=curves_help),
    ]


def complete_outputs(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the completions of the name of a variable, or of the last name in a comma-separated list."""
    from vijax.maps.outputs import MULTI_START_OUTPUTS, OUTPUTS

    before, comma, start = incomplete.rpartition(",")
    variables = dict.fromkeys([*OUTPUTS, *MULTI_START_OUTPUTS])
    names = variables if param.name == "outputs" else [*variables, "label"]
    return [f"{before}{comma}{name}" for name in names if name.startswith(start)]


def sections() -> Sections:
    """Return the sections of options."""
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
RESUMABLE = (
    "A map is written during the run: after an interruption the same command resumes it, and --overwrite starts again."
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

sweep = Page("sweep", power_map, sections(), EXAMPLES, f"{NEITHER} {RESUMABLE}")
