"""`vijax compare`: what rigid walls change over a plane of parameters."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import options, process
from vijax.cli.arguments import device, in_given_units, part, take_axes
from vijax.cli.closing import finish, flags, statuses, wide_gap_lines
from vijax.cli.page import Page, Sections
from vijax.cli.progress import counted
from vijax.cli.sweep import PLANE, plane_options, run_options
from vijax.cli.targets import drawn, targets

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.compare import Comparison

_FILES = ("comparison.zarr", "comparison.png")


def difference_map(constants: tuple[str, ...], tolerance: str | None, overwrite: bool, yes: bool, **given: Any) -> None:
    """Map what rigid walls change: the energy and the attractor."""
    with process.door():
        picture = given.pop("plot")
        out, plot, rows = targets(given.pop("out"), picture, _FILES, overwrite, csv=given.pop("csv"))
        axes, made = take_axes(given, PLANE), device(constants)
        planned = _plan(axes, made, tolerance, given)
        plot = drawn(plot, picture, planned.soft.cells.sizes)
        _check(planned, plot)
        _agree(planned, yes)
    if plot is not None:
        process.import_beside("vijax.plots.number_maps")
    from vijax.planes.compare import run

    dataset, pace = counted(planned.count, lambda tell: run(planned, tell))
    finish(dataset, f"{pace}\n{_summary(dataset)}", out, plot, _draw, overwrite, table=rows)


def _plan(axes: dict[str, Any], device: Any, tolerance: str | None, given: dict[str, Any]) -> "Comparison":
    from vijax.planes.compare import plan
    from vijax.planes.sweep_settings import SweepSettings

    largest = None if tolerance is None else part("tolerance", tolerance)
    return plan(axes, largest, device, SweepSettings(**given))


def _check(planned: "Comparison", plot: Path | None) -> None:
    from vijax.planes.sweep import check_room
    from vijax.plots import style

    if plot is not None:
        style.check_format(plot)
        style.layout(planned.soft.cells.sizes)
    check_room(planned.soft)


def _agree(planned: "Comparison", yes: bool) -> None:
    from vijax.planes import estimate

    process.agree(estimate.of(planned.soft, planned.rigid), yes)


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    plots.save(plots.difference_map(in_given_units(dataset)), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Say what the comparison holds: how cells ended, labels, verdicts, from where rigid is enough."""
    lines = [statuses(dataset[f"status_{wall}"], f"{wall} cells") for wall in ("soft", "rigid")]
    lines += wide_gap_lines(dataset, "vijax sweep ")
    lines.append(f"label: {flags(dataset['label'])}")
    lines.append(f"median difference in P: {100 * float(dataset['relative_difference'].median()):.3g} %")
    if "cheapest_model" in dataset:
        verdict = dataset["cheapest_model"]
        within = f"{100 * verdict.attrs['tolerance']:g} %"
        lines.append(f"cheapest model within {within}: {flags(verdict)}")
    if "rigid_from" in dataset:
        onset = dataset["rigid_from"]
        found = onset.values[onset.notnull().values]
        span = f"{found.min():.4g} to {found.max():.4g}, median {onset.median():.4g}" if found.size else "none"
        lines.append(f"least {onset.axis} from which on it is rigid: {span} ({found.size} of {onset.size} found)")
    return "\n".join(lines)


# --- the page --------------------------------------------------------------------------------------------------------


def tolerance_option(where: str = "") -> click.Parameter:
    """Make the option for how much of P rigid walls may change."""
    return click.Option(["--tolerance"], metavar="5%", help=f"{where}part of P that rigid walls may change")


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
