"""`vijax response`: what one device does under noise or a measured record."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import options, process
from vijax.cli.arguments import at_one_point, device, take_axes
from vijax.cli.closing import finish, harvest, how_many
from vijax.cli.excitation import excitation_options, take_excitation
from vijax.cli.kinds import Periods, Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress
from vijax.cli.targets import targets
from vijax.model.quantities import AXES, STARTS

if TYPE_CHECKING:
    import xarray as xr

_DEVICE = {"d": "0.2", "kappa": "30"}
_PERIODS = "forcing periods measured; all of a record"
_FILES = ("response.zarr", "response.png")


def realisations(
    constants: tuple[str, ...], out: str | None, csv: str | None, plot: str | None, overwrite: bool, **given: Any
) -> None:
    """Measure a device under noise or a measured record.

    It runs from many starts, each with noise of its own: how much it harvests, how fast and how deep its impacts are,
    and which of the attractors that it has without the noise it visits, for how long.
    """
    with process.door():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        excitation = take_excitation(given)
        _, made = at_one_point(take_axes(given, _DEVICE), device(constants), given["wall"])
        if picture is not None:
            from vijax.plots.style import check_format

            check_format(picture)
        from vijax.planes.response import response

        with progress(2, "stages") as show:
            dataset = response(made, excitation, **given, progress=show)
    of = "time_share" if "time_share" in dataset else "P"
    finish(dataset, _summary(dataset), store, picture, _draw, overwrite, table=rows, rows_of=of)


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax import plots

    plots.save(plots.response(dataset), path)


def _summary(dataset: "xr.Dataset") -> str:
    """Say what was found, in a few lines."""
    number = {name: float(dataset[name]) for name in dataset if not dataset[name].dims}
    last = dataset.isel(quantile=-1)
    deep, off = (1e3 * float(last[name]) for name in ("penetration_quantile", "penetration_quantile_stderr"))
    spread = "(too few for an error)" if math.isnan(off) else f"+- {off:.1g}"
    lines = [
        f"excitation: {dataset.attrs['excitation']}",
        f"P: {harvest(number['P'], number['power'], number['P_stderr'])} over "
        f"{how_many(dataset.sizes['realisation'], 'realisations')}",
        f"impacts: {number['impacts_per_period']:.4g} a period, up to {number['max_impact_speed']:.4g} m/s; one in a "
        f"thousand deeper than {deep:.4g} {spread} mm; past the limit {number['beyond_limit']:.2%}",
    ]
    if "time_share" not in dataset:
        return "\n".join(lines)
    for one in (dataset.isel(attractor=i) for i in range(dataset.sizes["attractor"])):
        stay, error = float(one["time_until_lost"]), float(one["time_until_lost_stderr"])
        kept = f"left after {stay:.3g} +- {error:.1g} periods" if stay < float("inf") else "never left"
        lines.append(f"{one['label'].item() or 'undecided':<20}{float(one['time_share']):>8.2%} of the time, {kept}")
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
                ["--realisations"], type=Whole(2), default=64, show_default=True, help="starts, each with noise"
            ),
            click.Option(["--periods"], type=Periods(1), default=400, show_default=True, help=_PERIODS),
            click.Option(["--transient"], type=Whole(0), default=100, show_default=True, help="periods to drop before"),
            click.Option(["--bins"], type=Whole(1), default=50, show_default=True, help="of the distributions"),
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
