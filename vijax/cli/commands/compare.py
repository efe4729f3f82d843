"""`vijax compare`: the effect of rigid walls over a plane of parameters."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, in_command_units, parse_fraction, take_axes
from vijax.cli.closing import finish, flags, statuses, wide_gap_lines
from vijax.cli.commands.sweep import PLANE, plane_options, run_options
from vijax.cli.options import options
from vijax.cli.options.output_files import drawn, targets
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted

if TYPE_CHECKING:
    import xarray as xr

    from vijax.maps.compare import Comparison

_FILES = ("comparison.zarr", "comparison.png")


def difference_map(
    constants: tuple[str, ...], tolerance: str | None, overwrite: bool, yes: bool, **parameters: Any
) -> None:
    """Compare rigid and soft walls over a plane of parameters."""
    with process.usage_errors():
        picture = parameters.pop("plot")
        out, plot, rows = targets(parameters.pop("out"), picture, _FILES, overwrite, csv=parameters.pop("csv"))
        axes, harvester = take_axes(parameters, PLANE), device(constants)
        comparison = _plan(axes, harvester, tolerance, parameters)
        plot = drawn(plot, picture, comparison.soft.cells.sizes)
        _check(comparison, plot)
        _agree(comparison, yes)
    if plot is not None:
        process.import_in_background("vijax.plots.number_maps")
    from vijax.maps.compare import run

    dataset, rate = counted(comparison.count, lambda report: run(comparison, report))
    finish(dataset, f"{rate}\n{_summary(dataset)}", out, plot, _draw, overwrite, table=rows)


def _plan(axes: dict[str, Any], device: Any, tolerance: str | None, parameters: dict[str, Any]) -> "Comparison":
    from vijax.maps.compare import plan
    from vijax.maps.sweep_settings import SweepSettings

    largest = None if tolerance is None else parse_fraction("tolerance", tolerance)
    return plan(axes, largest, device, SweepSettings(**parameters))


def _check(comparison: "Comparison", plot: Path | None) -> None:
    from vijax.maps.sweep import check_fits_memory
    from vijax.plots import style

    if plot is not None:
        style.check_format(plot)
        style.layout(comparison.soft.cells.sizes)
    check_fits_memory(comparison.soft)


def _agree(comparison: "Comparison", yes: bool) -> None:
    from vijax.maps.execution import estimate

    process.agree(estimate.estimate_runs(comparison.soft, comparison.rigid), yes)


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    plots.save(plots.difference_map(in_command_units(dataset)), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Return a text with the results of a comparison.

    The text has the counts of cells by status and by label, the median difference in P, the counts of the cheapest
    sufficient model, and the range of the least values of the axis where rigid walls suffice.
    """
    lines = [statuses(dataset[f"status_{wall}"], f"{wall} cells") for wall in ("soft", "rigid")]
    lines += wide_gap_lines(dataset, "vijax sweep ")
    lines.append(f"label: {flags(dataset['label'])}")
    lines.append(f"median difference in P: {100 * float(dataset['relative_difference'].median()):.3g} %")
    if "cheapest_model" in dataset:
        model = dataset["cheapest_model"]
        within = f"{100 * model.attrs['tolerance']:g} %"
        lines.append(f"cheapest model within {within}: {flags(model)}")
    if "rigid_from" in dataset:
        onset = dataset["rigid_from"]
        thresholds = onset.values[onset.notnull().values]
        span = (
            f"{thresholds.min():.4g} to {thresholds.max():.4g}, median {onset.median():.4g}"
            if thresholds.size
            else "none"
        )
        lines.append(f"least {onset.axis} from which on it is rigid: {span} ({thresholds.size} of {onset.size} found)")
    return "\n".join(lines)


# --- the page --------------------------------------------------------------------------------------------------------


def tolerance_option(where: str = "") -> click.Parameter:
    """Return the option for the largest acceptable relative change of P if rigid walls replace soft walls."""
    return click.Option(["--tolerance"], metavar="5%", help=f"{where}relative change of P that rigid walls may cause")


def _sections() -> Sections:
    return {
        "Plane": plane_options(),
        "Run": [*run_options(), options.dtype_option()],
        "Verdict": [tolerance_option()],
        "Files": options.file_options(),
        "Large runs": [options.size_option()],
    }


_EXAMPLES = (
    "",
    "--kappa 3:4000:128:log --tolerance 5%",
    "--d 0.05:0.3:96 --kappa 3:4000:96:log --periods 2000 --tolerance 5% --out rigid.zarr --plot rigid.png",
)

compare = Page(
    "compare",
    difference_map,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, comparison.zarr and comparison.png are written.",
)
