"""An orbit diagram from one command: the impacts of attractors along an axis, each point starting from the last one's.

    python scripts/orbit_diagram.py
    python scripts/orbit_diagram.py --along d=0.3:0.05:126 --kappa 400,126.5,40,12.65,4 --direction both
    python scripts/orbit_diagram.py --along omega=0.5:15:484 --s 0.2 --direction up --quantity P --plot power.png
    python scripts/orbit_diagram.py --wall rigid --gamma 0.1 --out inclined.zarr

An axis is a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE. Besides the axis swept one may have several values, a
colour each. Write a range that begins with a minus as --gamma=-0.1:0.1:5.
"""

import sys
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import click
import command

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.orbit_diagram import Diagram

_DEFAULT_ALONG = "d=0.3:0.05:126"
_DEFAULT_FILES = ("orbit_diagram.zarr", "orbit_diagram.png")
_COMMON = 8  # the most frequent labels; the others are counted together


def _options() -> list[click.Parameter]:
    return [
        click.Option(
            ["--along"], default=_DEFAULT_ALONG, show_default=True, metavar="AXIS=VALUES", help="axis to sweep"
        ),
        click.Option(["--direction"], default="down", show_default=True, help="down, up or both"),
        *command.axis_options(),
        *command.device_options(),
        click.Option(["--periods"], default=400, show_default=True, help="forcing periods of every point"),
        click.Option(["--keep"], default=25, show_default=True, help="of these, at the end, how many are recorded"),
        click.Option(["--wall"], default="soft", show_default=True, help="soft or rigid"),
        click.Option(["--dtype"], default="float64", show_default=True, help="float64 or float32"),
        click.Option(
            ["--quantity"], default="v_in", show_default=True, help="what the picture shows: v_in, E, phase ..."
        ),
        *command.file_options(),
        command.size_option(),
    ]


@click.command(params=_options(), context_settings={"max_content_width": 120})
def orbit_diagram(
    along: str,
    constants: tuple[str, ...],
    quantity: str,
    out: str | None,
    plot: str | None,
    overwrite: bool,
    yes: bool,
    **given: Any,
) -> None:
    """Draw the impacts of attractors along an axis, each point starting where the last one ended.

    VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --gamma=-0.1:0.1:5); a number
    may be a multiple of pi, as in 6pi. With neither --out nor --plot, orbit_diagram.zarr and orbit_diagram.png are
    written.
    """
    with command.door():
        store, picture = command.targets(out, plot, _DEFAULT_FILES, overwrite)
        diagram = _plan(along, command.take_axes(given, {}), command.device(constants), given)
        if picture is not None:
            from vijax.plots import orbit_diagrams
            from vijax.plots.style import check_format

            orbit_diagrams.check_quantity(quantity)
            orbit_diagrams.check_layout(diagram.along, diagram.dims)
            check_format(picture)
        command.keep_compiled()
        command.agree(diagram.expected, yes)
    began = time.perf_counter()
    dataset = _run(diagram)
    seconds = time.perf_counter() - began

    def draw(dataset: "xr.Dataset", path: Any) -> None:
        orbit_diagrams.orbit_diagram(dataset, path, quantity)

    command.finish(dataset, _summary(dataset, diagram.count, seconds), store, picture, draw, overwrite)


def _plan(along: str, axes: dict[str, Any], device: Any, settings: dict[str, Any]) -> "Diagram":
    from vijax.model.quantities import AXES
    from vijax.planes.axes import parse_axis
    from vijax.planes.orbit_diagram import plan

    name, sign, text = along.partition("=")
    if not sign or name not in AXES:
        raise ValueError(f"along must be AXIS=VALUES, as in {_DEFAULT_ALONG}; got {along!r}")
    with command.about("along"):
        values = parse_axis(name, text)
    if not values.ndim:
        raise ValueError(f"along must have several values, as in {_DEFAULT_ALONG}; got {along!r}")
    return plan(name, values, axes, device, **settings)


def _run(diagram: "Diagram") -> "xr.Dataset":
    from vijax.planes.orbit_diagram import run

    with command.progress(diagram.count, "points") as show:
        return run(diagram, show)


def _summary(dataset: "xr.Dataset", count: int, seconds: float) -> str:
    """What the diagram holds, in a few lines: points by how they ended and by label, the time."""
    from vijax.model.label import label

    labels = Counter(
        label(*(dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status"))).ravel()
    )
    common = labels.most_common(_COMMON)
    rest = count - sum(number for _, number in common)
    return "\n".join(
        [
            command.pace(count, seconds, "points"),
            command.statuses(dataset["status"], "points"),
            f"points by label: {', '.join(f'{name} {n:,}' for name, n in [*common, ('others', rest)] if n)}",
        ]
    )


def main(arguments: list[str] | None = None) -> int:
    """Exit code, as `command.run` says."""
    return command.run(orbit_diagram, arguments)


if __name__ == "__main__":
    sys.exit(main())
