"""`vijax basins`: the attractor that each start reaches, and the shares of the basins."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, in_command_units, take_axes
from vijax.cli.closing import finish, rate_text, tally
from vijax.cli.options import options
from vijax.cli.options.excitation import harmonic_options, take_excitation
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Integer, Real
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress
from vijax.maps.sweep_settings import SPEED, START_POINTS, SweepSettings

if TYPE_CHECKING:
    import xarray as xr

    from vijax.maps.map_dataset import SweepPlan

_CELL = {"d": "0.2", "kappa": "3"}
_FILES = ("basins.zarr", "basins.png")
_MOST_ROWS = 24  # attractors listed in the terminal, largest basins first; the store has all


def coexisting(
    constants: tuple[str, ...],
    merge_mirrors: bool,
    starts: int | None,
    speed: float | None,
    seed: int | None,
    overwrite: bool,
    yes: bool,
    **parameters: Any,
) -> None:
    """Find the attractors that coexist, and their basins.

    By default the axes of the plane are the displacement u0 and velocity v0 of the start; several values of a parameter
    make panels. With --starts, the axes are parameters: every cell is run from that many starts, and the result is the
    number of its attractors and the share of starts that each attracts.
    """
    with process.usage_errors():
        out, plot, rows = targets(
            parameters.pop("out"), parameters.pop("plot"), _FILES, overwrite, csv=parameters.pop("csv")
        )
        axes, harvester = take_axes(parameters, _CELL), device(constants)
        sweep_plan = _plan(axes, harvester, starts, speed, seed, merge_mirrors, parameters)
        if plot is not None:
            _check_picture(plot, sweep_plan)
        _agree(sweep_plan, yes)
    from vijax.maps import sweep

    began = time.perf_counter()
    with progress(sweep_plan.count, "starts") as show:
        sweep_result = sweep.run(sweep_plan, show)
    summary = rate_text(sweep_plan.count, time.perf_counter() - began, "starts")
    from vijax.maps.basins import match_attractors

    dataset = match_attractors(sweep_result, merge_mirrors)
    summary = "\n".join([summary, *_summary(dataset)])
    finish(dataset, summary, out, plot, _draw, overwrite, table=rows, rows_of="fraction")


def _plan(
    axes: dict[str, Any],
    device: Any,
    starts: int | None,
    speed: float | None,
    seed: int | None,
    merge_mirrors: bool,
    parameters: dict[str, Any],
) -> "SweepPlan":
    from vijax.maps.basins import plan_basins, plan_fractions

    excitation = take_excitation(parameters)
    settings = SweepSettings(**parameters, excitation=excitation)
    if starts is not None:
        speed = SPEED if speed is None else speed
        sampling: dict[str, Any] = {"starts": starts, "speed": speed, "seed": seed}
        return plan_fractions(axes, device, settings, merge_mirrors=merge_mirrors, **sampling)
    for name, value in (("speed", speed), ("seed", seed)):
        if value is not None:
            raise ValueError(f"{name} must come with starts; got {value} alone; add --starts 64")
    return plan_basins(axes, device, settings, merge_mirrors=merge_mirrors)


def _agree(sweep_plan: "SweepPlan", yes: bool) -> None:
    from vijax.maps import sweep
    from vijax.maps.execution import estimate

    sweep.check_fits_memory(sweep_plan)
    process.agree(estimate.estimate_runs(sweep_plan), yes)


def _check_picture(path: Path, sweep_plan: "SweepPlan") -> None:
    from vijax.plots.style import check_format, layout_of_kinds

    check_format(path)
    layout_of_kinds({dim: size for dim, size in sweep_plan.cells.sizes.items() if dim != "start"})


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    plots.save(plots.basins(in_command_units(dataset)), path)


def _summary(dataset: "xr.Dataset") -> Iterator[str]:
    """Yield the lines of a table of attractors if the dataset has one cell, otherwise one line of counts.

    The line counts the cells with one attractor, with two, and so on.
    """
    cells = [str(dim) for dim in dataset["attractors"].dims]
    if dataset["attractors"].size > 1:
        yield f"cells by number of attractors: {tally(dataset['attractors'].values, '{:.0f}:'.format)}"
        return
    first = dataset.isel(dict.fromkeys(cells, 0))
    mirrors = ", mirror images as one" if dataset.attrs["merge_mirrors"] else ""
    measures = f"{'P [J]':>12}{'power [W]':>12}{'v max [m/s]':>13}{'exponent':>10}"
    yield f"{'label':<20}{'starts':>12}{'share':>9}{measures}  {mirrors[2:]}"
    for n in range(min(first.sizes["attractor"], _MOST_ROWS)):
        yield _row(first.isel(attractor=n), float(first["omega"].values.flat[0]) / math.pi)


def _row(entry: "xr.Dataset", rate: float) -> str:
    label, share = str(entry["label"].values), 100 * float(entry["fraction"])
    energy, speed, exponent = (float(entry[name].values.flat[0]) for name in ("P", "max_impact_speed", "lyapunov"))
    # Averages of an aperiodic attractor depend on the number of simulated periods, so that number is printed.
    note = "" if entry["periodic"] else f"  simulated {float(entry['periods_run']):g} periods"
    start = f"{label:<20}{int(entry['starts']):>12,}{share:>7.2f} %"
    return f"{start}{energy:>12.4g}{energy * rate:>12.4g}{speed:>13.4g}{exponent:>10.3g}{note}"


# --- the page --------------------------------------------------------------------------------------------------------

_DEFAULTS = {name: options.unless_physical(text) for name, text in _CELL.items()} | {
    "u0": "the whole gap, as many as of v0",
    "v0": f"-{SPEED:g}:{SPEED:g}:{START_POINTS}",
}


def _sections() -> Sections:
    speed = Real("a positive finite number", min=0, min_open=True)
    long = "forcing periods to look for an attractor"
    return {
        "Cell and starts": [*options.axis_options(defaults=_DEFAULTS), *options.device_options()],
        "Starts in every cell": [
            click.Option(
                ["--starts"], type=Integer(1), help="map parameters instead, with so many starts in every cell"
            ),
            click.Option(["--speed"], type=speed, help=f"with --starts: their largest velocity [{SPEED:g}]"),
            click.Option(["--seed"], type=Integer(0), help="with --starts: draw them at random [an even lattice]"),
        ],
        "Run": [
            click.Option(["--merge-mirrors"], is_flag=True, help="count mirror images as one attractor (gamma = 0)"),
            options.setting("periods", long, Integer(1)),
            options.wall_option(),
        ],
        "Excitation": harmonic_options(),
        "Files": options.file_options(row="attractor of a cell"),
        "Large runs": [options.size_option()],
    }


_EXAMPLES = (
    "",
    "--d 0.22 --kappa 40 --v0=-1:1:600 --plot basins.png",
    "--wall rigid --d 0.19 --kappa 400 --v0=-0.6:0.6:1000 --plot basins.png",
    "--d 0.05:0.3:48 --kappa 3:40:48:log --starts 64 --merge-mirrors --plot coexisting.png",
)

basins = Page(
    "basins",
    coexisting,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, basins.zarr and basins.png are written.",
)
