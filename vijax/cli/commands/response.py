"""`vijax response`: statistics of one device under noise or a measured record."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, single_cell, take_axes
from vijax.cli.closing import finish, format_count, harvest
from vijax.cli.options import options
from vijax.cli.options.excitation import excitation_options, take_excitation
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Integer, Periods
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress
from vijax.model.quantities import AXES, STARTS

if TYPE_CHECKING:
    import xarray as xr

_DEVICE = {"d": "0.2", "kappa": "30"}
_PERIODS = "forcing periods measured; all of a record"
_FILES = ("response.zarr", "response.png")


def realisations(
    constants: tuple[str, ...], out: str | None, csv: str | None, plot: str | None, overwrite: bool, **parameters: Any
) -> None:
    """Measure a device under noise or a measured record.

    The device is simulated from many starts, each with its own realisation of the noise. Results are the harvested
    energy, the speed and depth of impacts, and the share of time on each attractor that exists without noise.
    """
    with process.usage_errors():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        excitation = take_excitation(parameters)
        _, harvester = single_cell(take_axes(parameters, _DEVICE), device(constants), parameters["wall"])
        if picture is not None:
            from vijax.plots.style import check_format

            check_format(picture)
        from vijax.maps.response import response

        with progress(2, "stages") as show:
            dataset = response(harvester, excitation, **parameters, progress=show)
    of = "time_share" if "time_share" in dataset else "P"
    finish(dataset, _summary(dataset), store, picture, _draw, overwrite, table=rows, rows_of=of)


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    plots.save(plots.response(dataset), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Return a text with P, impacts, penetration, and the time share of each attractor."""
    number = {name: float(dataset[name]) for name in dataset if not dataset[name].dims}
    last = dataset.isel(quantile=-1)
    deep, deep_error = (1e3 * float(last[name]) for name in ("penetration_quantile", "penetration_quantile_stderr"))
    spread = "(too few for an error)" if math.isnan(deep_error) else f"+- {deep_error:.1g}"
    lines = [
        f"excitation: {dataset.attrs['excitation']}",
        f"P: {harvest(number['P'], number['power'], number['P_stderr'])} over "
        f"{format_count(dataset.sizes['realisation'], 'realisations')}",
        f"impacts: {number['impacts_per_period']:.4g} a period, up to {number['max_impact_speed']:.4g} m/s; one in a "
        f"thousand deeper than {deep:.4g} {spread} mm; past the limit {number['beyond_limit']:.2%}",
    ]
    if "time_share" not in dataset:
        return "\n".join(lines)
    for entry in (dataset.isel(attractor=i) for i in range(dataset.sizes["attractor"])):
        time_until_lost, error = float(entry["time_until_lost"]), float(entry["time_until_lost_stderr"])
        duration = (
            f"lost after {time_until_lost:.3g} +- {error:.1g} periods"
            if time_until_lost < float("inf")
            else "never lost"
        )
        lines.append(
            f"{entry['label'].item() or 'undecided':<20}{float(entry['time_share']):>8.2%} of the time, {duration}"
        )
    return "\n".join(lines)


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    axes = {name: axis for name, axis in AXES.items() if name not in STARTS}
    defaults = {name: options.unless_physical(text) for name, text in _DEVICE.items()}
    return {
        "Device": [*options.axis_options(axes, defaults), *options.device_options(), options.wall_option()],
        "Excitation": excitation_options(),
        "Run": [
            click.Option(
                ["--realisations"], type=Integer(2), default=64, show_default=True, help="starts, each with noise"
            ),
            click.Option(["--periods"], type=Periods(1), default=400, show_default=True, help=_PERIODS),
            click.Option(
                ["--transient"], type=Integer(0), default=100, show_default=True, help="periods to drop before"
            ),
            click.Option(["--bins"], type=Integer(1), default=50, show_default=True, help="of the distributions"),
        ],
        "Files": options.file_options(row="attractor"),
    }


_EXAMPLES = (
    "--noise 0.05,32",
    "--noise 0.01,32 --kappa 3 --plot response.png",
    "--noise 0.05,32 --wall rigid --r 0.6",
    "--s 8mm --omega0 150 --omega 5pi --noise 0.1,16 --periods 2000 --out long.zarr --plot long.png",
)

response = Page(
    "response",
    realisations,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} Each is one number here. With none of --out, --csv and --plot, response.zarr and response.png "
    "are written.",
)
