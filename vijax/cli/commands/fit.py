"""`vijax fit`: identify a device from measured impacts."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, single_cell, take_axes
from vijax.cli.closing import close
from vijax.cli.options import options
from vijax.cli.options.columns import columns
from vijax.cli.options.excitation import excitation_options, take_excitation
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Number
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress, waiting
from vijax.model.quantities import AXES, STARTS

if TYPE_CHECKING:
    from vijax.fitting.fit_result import Fit

_DEVICE = {"omega0": "400"}
_FILES = ("fit.json", "fit.png")
# Admissible numbers of columns of the file: times and sides, or times, sides and speeds.
_COLUMNS = (2, 3)


def fit_device(
    impacts: str,
    unknown: str,
    timing_error: float,
    speed_error: float | None,
    wall: str,
    constants: tuple[str, ...],
    out: str | None,
    csv: str | None,
    plot: str | None,
    overwrite: bool,
    **parameters: Any,
) -> None:
    """Find a device from its measured impacts.

    IMPACTS is a text file with one line per impact: the time in s, the wall (-1 left, 1 right) and, with --speed-error,
    the speed in m/s. The options of the device specify known constants, and the starting values of unknown constants.
    """
    with process.usage_errors():
        report, picture, rows = targets(out, plot, _FILES, overwrite, ".json", csv=csv)
        excitation = take_excitation(parameters)
        _, initial_device = single_cell(take_axes(parameters, _DEVICE), device(constants))
        time, side, *speed = columns("IMPACTS", impacts, _COLUMNS)
        if picture is not None:
            from vijax.plots.style import check_format

            check_format(picture)
        from vijax.fitting.fit import fit

        with progress(1, "fits") as show:
            waiting("least squares, compiled at first")
            result = fit(
                time,
                side,
                excitation,
                timing_error=timing_error,
                speeds=speed[0] if speed and speed_error is not None else None,
                speed_error=speed_error,
                device=initial_device,
                unknown=[name.strip() for name in unknown.split(",")],
                wall=wall,  # type: ignore[arg-type] # `fit` validates the text
            )
            show(1, 1)
    _write(result, report, rows, picture)
    close(str(result), report, rows, picture)


def _write(result: "Fit", report: Path | None, rows: Path | None, picture: Path | None) -> None:
    from vijax import plots
    from vijax.runtime.files import write_json

    if report is not None:
        write_json(result.report(), report)
    if rows is not None:
        import pandas as pd

        from vijax.runtime.text_tables import write_table

        units = result.report()["units"]
        listed = [(name, value, result.stderr[name], units[name]) for name, value in result.values.items()]
        write_table(pd.DataFrame(listed, columns=["name", "value", "stderr", "unit"]), {}, rows)
    if picture is not None:
        plots.save(plots.fit(result), picture)


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    axes = {name: axis for name, axis in AXES.items() if name not in STARTS}
    names = (
        "quantities to identify: omega0, k, kappa, r, s, d, beta, gamma, A, omega, of one wall omega0_left, or delay"
    )
    return {
        "Impacts": [
            click.Argument(["impacts"], metavar="IMPACTS"),
            click.Option(["--unknown"], default="omega0,r", show_default=True, metavar="NAME,NAME", help=names),
            click.Option(["--timing-error"], type=Number("time"), required=True, help="standard error of a time, s"),
            click.Option(
                ["--speed-error"], type=Number("speed"), help="standard error of a speed, m/s: uses the third column"
            ),
            options.wall_option(),
        ],
        "Device": [*options.axis_options(axes), *options.device_options()],
        "Excitation": excitation_options(noise=False),
        "Files": options.file_options(".json", "report", row="fitted quantity"),
    }


_EXAMPLES = (
    "impacts.txt --timing-error 1e-4 --s 8mm --omega 5pi --omega0 150",
    "impacts.txt --timing-error 1e-4 --s 8mm --omega 5pi --unknown omega0,r,delay",
    "impacts.txt --timing-error 1e-4 --speed-error 0.01 --s 8mm --omega 5pi --record bench.csv",
)

fit = Page(
    "fit",
    fit_device,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} Each is one number here. With none of --out, --csv and --plot, fit.json and fit.png are "
    "written.",
)
