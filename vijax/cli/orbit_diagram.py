"""`vijax orbit-diagram`: the impacts of attractors along an axis."""

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import options, process
from vijax.cli.arguments import about, device, in_given_units, take_axes
from vijax.cli.closing import finish, pace, statuses, wide_gap_lines
from vijax.cli.excitation import harmonic_options, take_excitation
from vijax.cli.kinds import Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress
from vijax.cli.targets import targets
from vijax.model.quantities import AXES, POINT_QUANTITIES
from vijax.planes.sweep_settings import DiagramSettings

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.orbit_diagram import Diagram

_ALONG = "d=0.3:0.05:126"
_FILES = ("orbit_diagram.zarr", "orbit_diagram.png")
_COMMON = 8  # Labels that are counted each, the most frequent ones; the others are counted together.


def diagram(
    along: str,
    constants: tuple[str, ...],
    quantity: str,
    out: str | None,
    csv: str | None,
    plot: str | None,
    overwrite: bool,
    yes: bool,
    **given: Any,
) -> None:
    """Draw the impacts of attractors along an axis.

    Each point starts where the last one ended. Besides the axis swept one may have several values, a colour each.
    """
    with process.door():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        planned = _plan(along, take_axes(given, {}), device(constants), given)
        if picture is not None:
            _check_picture(picture, planned, quantity)
        process.agree(planned.expected, yes)
    began = time.perf_counter()
    dataset = _run(planned)
    seconds = time.perf_counter() - began

    def draw(dataset: "xr.Dataset", path: Path) -> None:
        from vijax import plots

        plots.save(plots.orbit_diagram(in_given_units(dataset), quantity), path)

    said = _summary(dataset, planned.count, seconds)
    finish(dataset, said, store, picture, draw, overwrite, table=rows, rows_of="phase")


def _check_picture(path: Path, planned: "Diagram", quantity: str) -> None:
    from vijax.plots import orbit_diagrams
    from vijax.plots.style import check_format

    orbit_diagrams.check_quantity(quantity)
    orbit_diagrams.check_layout(planned.along, planned.dims)
    check_format(path)


def _plan(along: str, axes: dict[str, Any], device: Any, given: dict[str, Any]) -> "Diagram":
    from vijax.planes.axes import parse_axis
    from vijax.planes.orbit_diagram import plan

    name, sign, text = along.partition("=")
    if not sign or name not in AXES:
        raise ValueError(f"along must be AXIS=VALUES, as in {_ALONG}; got {along!r}")
    with about("along"):
        values = parse_axis(name, text)
    if not values.ndim:
        raise ValueError(f"along must have several values, as in {_ALONG}; got {along!r}")
    excitation = take_excitation(given)
    return plan(name, values, axes, device, DiagramSettings(**given, excitation=excitation))


def _run(diagram: "Diagram") -> "xr.Dataset":
    from vijax.planes.orbit_diagram import run

    with progress(diagram.count, "points") as show:
        return run(diagram, show)


def _summary(dataset: "xr.Dataset", count: int, seconds: float) -> str:
    """Say what the diagram holds, in a few lines: points by how they ended and by label, the time."""
    from vijax.model.label import label

    labels = Counter(
        label(*(dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status"))).ravel()
    )
    common = labels.most_common(_COMMON)
    rest = count - sum(number for _, number in common)
    return "\n".join(
        [
            pace(count, seconds, "points"),
            statuses(dataset["status"], "points"),
            *wide_gap_lines(dataset, "vijax sweep "),
            f"points by label: {', '.join(f'{name} {n:,}' for name, n in [*common, ('others', rest)] if n)}",
        ]
    )


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    kept = "of these, at the end, how many are recorded"
    return {
        "Sweep": [
            click.Option(["--along"], default=_ALONG, show_default=True, metavar="AXIS=VALUES", help="axis to sweep"),
            options.setting("direction", "ways along the axis", of=DiagramSettings),
        ],
        "Device": [*options.axis_options(), *options.device_options()],
        "Run": [
            options.setting("periods", "forcing periods of every point", Whole(1), DiagramSettings),
            options.setting("recorded_periods", kept, Whole(1), DiagramSettings),
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
