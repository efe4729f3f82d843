"""`vijax orbit-diagram`: impacts of attractors along an axis."""

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, in_command_units, name_option_in_errors, take_axes
from vijax.cli.closing import finish, rate_text, statuses, wide_gap_lines
from vijax.cli.options import options
from vijax.cli.options.excitation import harmonic_options, take_excitation
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Integer
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress
from vijax.maps.sweep_settings import DiagramSettings
from vijax.model.quantities import AXES, POINT_QUANTITIES

if TYPE_CHECKING:
    import xarray as xr

    from vijax.maps.orbit_diagram import DiagramPlan

_ALONG = "d=0.3:0.05:126"
_FILES = ("orbit_diagram.zarr", "orbit_diagram.png")
_COMMON = 8  # the 8 most frequent labels are counted one by one, all other labels together


def diagram(
    along: str,
    constants: tuple[str, ...],
    quantity: str,
    out: str | None,
    csv: str | None,
    plot: str | None,
    overwrite: bool,
    yes: bool,
    **parameters: Any,
) -> None:
    """Draw the impacts of attractors along an axis.

    Along the axis, each point starts from the final state of the previous point. One further parameter may have several
    values, drawn in one colour each.
    """
    with process.usage_errors():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        diagram_plan = _plan(along, take_axes(parameters, {}), device(constants), parameters)
        if picture is not None:
            _check_picture(picture, diagram_plan, quantity)
        process.agree(diagram_plan.expected, yes)
    began = time.perf_counter()
    dataset = _run(diagram_plan)
    seconds = time.perf_counter() - began

    def draw(dataset: "xr.Dataset", path: Path) -> None:
        from vijax import plots

        plots.save(plots.orbit_diagram(in_command_units(dataset), quantity), path)

    summary = _summary(dataset, diagram_plan.count, seconds)
    finish(dataset, summary, store, picture, draw, overwrite, table=rows, rows_of="phase")


def _check_picture(path: Path, diagram_plan: "DiagramPlan", quantity: str) -> None:
    from vijax.plots import orbit_diagrams
    from vijax.plots.style import check_format

    orbit_diagrams.check_quantity(quantity)
    orbit_diagrams.check_layout(diagram_plan.along, diagram_plan.dims)
    check_format(path)


def _plan(along: str, axes: dict[str, Any], device: Any, parameters: dict[str, Any]) -> "DiagramPlan":
    from vijax.maps.axes import parse_axis
    from vijax.maps.orbit_diagram import plan

    name, sign, text = along.partition("=")
    if not sign or name not in AXES:
        raise ValueError(f"along must be AXIS=VALUES, as in {_ALONG}; got {along!r}")
    with name_option_in_errors("along"):
        values = parse_axis(name, text)
    if not values.ndim:
        raise ValueError(f"along must have several values, as in {_ALONG}; got {along!r}")
    excitation = take_excitation(parameters)
    return plan(name, values, axes, device, DiagramSettings(**parameters, excitation=excitation))


def _run(diagram: "DiagramPlan") -> "xr.Dataset":
    from vijax.maps.orbit_diagram import run

    with progress(diagram.count, "points") as show:
        return run(diagram, show)


def _summary(dataset: "xr.Dataset", count: int, seconds: float) -> str:
    """Return a text with the time, and the numbers of points by status and by label."""
    from vijax.model.label import label

    labels = Counter(
        label(*(dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status"))).ravel()
    )
    common = labels.most_common(_COMMON)
    rest = count - sum(number for _, number in common)
    return "\n".join(
        [
            rate_text(count, seconds, "points"),
            statuses(dataset["status"], "points"),
            *wide_gap_lines(dataset, "vijax sweep "),
            f"points by label: {', '.join(f'{name} {n:,}' for name, n in [*common, ('others', rest)] if n)}",
        ]
    )


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    recorded = "number of these periods, at the end, that are recorded"
    return {
        "Sweep": [
            click.Option(["--along"], default=_ALONG, show_default=True, metavar="AXIS=VALUES", help="axis to sweep"),
            options.setting("direction", "direction along the axis", of=DiagramSettings),
        ],
        "Device": [*options.axis_options(), *options.device_options()],
        "Run": [
            options.setting("periods", "forcing periods of every point", Integer(1), DiagramSettings),
            options.setting("recorded_periods", recorded, Integer(1), DiagramSettings),
            options.wall_option(),
            options.dtype_option(),
        ],
        "Excitation": harmonic_options(),
        "Files": [options.quantity_option(POINT_QUANTITIES), *options.file_options(row="impact")],
        "Large runs": [options.size_option()],
    }


_EXAMPLES = (
    "",
    "--along d=0.3:0.05:126 --kappa 400,126.5,40,12.65,4 --direction both",
    "--along omega=0.5:15:484 --s 0.2 --direction up --quantity P --plot power.png",
    "--wall rigid --gamma 0.1 --out inclined.zarr",
)

orbit_diagram = Page(
    "orbit-diagram",
    diagram,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, orbit_diagram.zarr and orbit_diagram.png are written.",
)
