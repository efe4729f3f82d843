"""Which attractor each start ends on, from one command: a labelled store, a picture, a table of the attractors.

    python scripts/basins.py
    python scripts/basins.py --d 0.22 --kappa 40 --v0=-1:1:600 --plot basins.png
    python scripts/basins.py --d 0.05:0.3:48 --kappa 3:40:48:log --starts 64 --merge-mirrors --plot coexisting.png

The plane is that of the starts u0 and v0; further arrays make panels. With --starts, the plane is that of the
parameters: how many attractors coexist in every cell, found from so many starts, and the share of each.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import command
from command import keep_compiled

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.dataset import Plan

_DEFAULT_CELL = {"d": "0.2", "kappa": "3"}
_DEFAULT_FILES = ("basins.zarr", "basins.png")
_HELP = {
    "d": "gap, dimensionless [0.2 unless --s, --omega0 or --k is given]",
    "kappa": "stiffness, dimensionless [3 unless --s, --omega0 or --k is given]",
    "u0": "displacements at the start, dimensionless [the whole gap, as many as of v0]",
    "v0": "velocities at the start, dimensionless [-0.6:0.6:256]",
}
_MOST_ROWS = 24


def _options() -> list[click.Parameter]:
    return [
        *command.axis_options(**_HELP),
        *command.device_options(),
        click.Option(["--merge-mirrors"], is_flag=True, help="count mirror images as one attractor (gamma = 0)"),
        click.Option(["--starts"], type=int, help="map parameters instead, with so many starts in every cell"),
        click.Option(["--speed"], type=float, help="with --starts: their largest velocity [0.6]"),
        click.Option(["--seed"], type=int, help="with --starts: draw them at random [an even lattice]"),
        click.Option(["--periods"], default=400, show_default=True, help="forcing periods to look for an attractor"),
        click.Option(["--wall"], default="soft", show_default=True, help="soft or rigid"),
        *command.file_options(),
        command.size_option(),
    ]


@click.command(
    params=_options(),
    epilog=f"{command.VALUES} With neither --out nor --plot, basins.zarr and basins.png are written.",
    context_settings={"max_content_width": 120},
)
def basins(
    constants: tuple[str, ...],
    merge_mirrors: bool,
    starts: int | None,
    speed: float | None,
    seed: int | None,
    overwrite: bool,
    yes: bool,
    **given: Any,
) -> None:
    """Find the attractors that coexist, their basins and the energy of each."""
    with command.door():
        out, plot = command.targets(given.pop("out"), given.pop("plot"), _DEFAULT_FILES, overwrite)
        axes, device = command.take_axes(given, _DEFAULT_CELL), command.device(constants)
        planned = _plan(axes, device, starts, speed, seed, merge_mirrors=merge_mirrors, **given)
        if plot is not None:
            _check_picture(plot, planned)
        keep_compiled()
        _agree(planned, yes)
    began = time.perf_counter()
    with command.progress(planned.count, "starts") as show:
        from vijax.planes import sweep

        swept = sweep.run(planned, show)
    pace = command.pace(planned.count, time.perf_counter() - began, "starts")
    from vijax.planes.basins import matched

    dataset = matched(swept, merge_mirrors)
    command.finish(dataset, "\n".join([pace, *_summary(dataset)]), out, plot, _draw, overwrite)


def _plan(
    axes: dict[str, Any], device: Any, starts: int | None, speed: float | None, seed: int | None, **settings: Any
) -> "Plan":
    from vijax.planes.basins import SPEED, plan_basins, plan_fractions

    if starts is not None:
        speed = SPEED if speed is None else speed
        return plan_fractions(axes, device, starts=starts, speed=speed, seed=seed, **settings)
    for name, value in (("speed", speed), ("seed", seed)):
        if value is not None:
            raise ValueError(f"{name} must come with starts; got {value} alone; add --starts 64")
    return plan_basins(axes, device, **settings)


def _agree(planned: "Plan", yes: bool) -> None:
    from vijax.planes import estimate, sweep

    sweep.check_room(planned)
    command.agree(estimate.of(planned), yes)


def _check_picture(path: Path, planned: "Plan") -> None:
    from vijax.plots.style import check_format, layout_of_kinds

    check_format(path)
    layout_of_kinds({dim: size for dim, size in planned.cells.sizes.items() if dim != "start"})


def _draw(dataset: "xr.Dataset", path: Path) -> None:
    from vijax.plots import maps as pictures

    (pictures.multistability_map if "start" in dataset.sizes else pictures.basin_map)(dataset, path)


def _summary(dataset: "xr.Dataset") -> Iterator[str]:
    """The attractors of every cell, or how many cells have how many of them."""
    cells = [str(dim) for dim in dataset["attractors"].dims]
    if dataset["attractors"].size > 1:
        yield f"cells by number of attractors: {command.tally(dataset['attractors'].values, '{:.0f}:'.format)}"
        return
    first = dataset.isel(dict.fromkeys(cells, 0))
    mirrors = ", mirror images as one" if dataset.attrs["merge_mirrors"] else ""
    yield f"{'label':<20}{'starts':>12}{'share':>9}{'P [J]':>12}{'v max [m/s]':>13}{'exponent':>10}  {mirrors[2:]}"
    for n in range(min(first.sizes["attractor"], _MOST_ROWS)):
        yield _row(first.isel(attractor=n))


def _row(entry: "xr.Dataset") -> str:
    label, share = str(entry["label"].values), 100 * float(entry["fraction"])
    energy, speed, exponent = (float(entry[name].values.flat[0]) for name in ("P", "max_impact_speed", "lyapunov"))
    looked = "" if entry["periodic"] else f"  looked for {float(entry['periods_run']):g} periods"
    start = f"{label:<20}{int(entry['starts']):>12,}{share:>7.2f} %"
    return f"{start}{energy:>12.4g}{speed:>13.4g}{exponent:>10.3g}{looked}"


def main(arguments: list[str] | None = None) -> int:
    """Exit code; see `command.run`."""
    return command.run(basins, arguments)


if __name__ == "__main__":
    sys.exit(main())
