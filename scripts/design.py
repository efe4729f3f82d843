"""The best membrane from one command: an admissible optimum, what surrounds it, and what tolerances make of it.

    python scripts/design.py
    python scripts/design.py --d 0.2 --r 0.5 --A 3 --omega 10pi --set V=1700 --tolerance omega0=5%
    python scripts/design.py --d 0.2 --tune omega0,r --bounds r=0.3:0.8 --tolerance omega0=5%,s=1% --objective worst
    python scripts/design.py --over d=0.05:0.3:64 --out designs.json --plot designs.png

Tuned are omega0 (or k, or kappa), s or d, r, A, omega, beta or gamma, and the constants of the membrane. With --over
the best design is found for every value of an axis.
"""

import sys
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click
import command
import numpy as np

if TYPE_CHECKING:
    import xarray as xr

    from vijax.design.optimise import Design
    from vijax.design.tolerance import Tolerance
    from vijax.model.device import Harvester

_DEFAULT_FILES = ("design.json", "design.png")
_POINTS, _NEAR = 320, 160  # of the picture, and of its close view
_OVER_TOLERANCES = ("mean", "worst")
_BASINS = 2000  # starts that show what attracts at the optimum
_STAGES = 3  # ascent, diagram, surroundings; along an axis the first and the last


def _options() -> list[click.Parameter]:
    changed = {"u0": None, "v0": None}
    return [
        click.Option(["--tune"], default="omega0", show_default=True, metavar="NAME,NAME", help="what is tuned"),
        click.Option(
            ["--bounds"],
            multiple=True,
            metavar="NAME=LO:HI",
            help="of a tuned quantity [kappa 2 to 400, r 0.05 to 0.95]",
        ),
        click.Option(
            ["--tolerance"], multiple=True, metavar="NAME=5%[:lognormal]", help="by how much a constant may be off"
        ),
        click.Option(
            ["--objective"], default="P", show_default=True, help="P, power, speed; over the tolerances: mean, worst"
        ),
        click.Option(["--steps"], type=int, default=256, show_default=True, help="values at which the survey looks"),
        click.Option(["--balls"], type=int, default=8, show_default=True, help="starts of the survey at each of them"),
        click.Option(["--impacts"], type=int, default=16, show_default=True, help="most impacts of an orbit"),
        click.Option(["--over"], metavar="NAME=VALUES", help="axis along which to find the best designs"),
        *command.axis_options(**changed),
        *command.device_options(),
        *command.file_options(".json", "report"),
        command.size_option(),
    ]


@click.command(
    params=_options(),
    epilog=f"{command.VALUES} With neither --out nor --plot, design.json and design.png are written.",
    context_settings={"max_content_width": 120},
)
def design(
    tune: str,
    bounds: tuple[str, ...],
    tolerance: tuple[str, ...],
    objective: str,
    steps: int,
    balls: int,
    impacts: int,
    over: str | None,
    constants: tuple[str, ...],
    out: str | None,
    plot: str | None,
    overwrite: bool,
    yes: bool,
    **given: Any,
) -> None:
    """Find the membrane, and what else is tuned, that harvests most and can be built."""
    from vijax.design import optimise as designs
    from vijax.design import report
    from vijax.plots import designs as pictures
    from vijax.plots.style import check_format
    from vijax.runtime.files import write_json

    with command.door():
        written, picture = command.targets(out, plot, _DEFAULT_FILES, overwrite, ".json")
        if picture is not None:
            check_format(picture)
        names = tuple(name.strip() for name in tune.split(","))
        along, devices = _devices(over, command.take_axes(given, {}), command.device(constants), names)
        scatter = _tolerances(tolerance)
        within = _bounds(bounds)
        weighed = scatter if objective in _OVER_TOLERANCES else ()
        designs.check(devices, names, within, objective, weighed)
        command.keep_compiled()
        command.agree(designs.expected(len(devices), designs.effort(steps, balls, impacts)), yes)
    stages = _STAGES if along is None else 2
    with command.progress(stages, "stages") as show:
        command.waiting("survey and ascents, compiled at first")
        began = time.perf_counter()
        found = designs.optimise_all(
            devices,
            tune=names,
            bounds=within,
            objective=objective,
            tolerances=weighed,
            steps=steps,
            balls=balls,
            impacts=impacts,
        )
        seconds = time.perf_counter() - began
        show(1, stages)
        diagram = None
        if along is None:
            command.waiting("orbit diagram")
            diagram = _diagram(found[0], devices[0])
            show(2, stages)
        command.waiting("surroundings and tolerances")
        told = [report.describe(one, diagram=diagram, **_judged(one, scatter, along is None)) for one in found]
        show(stages, stages)
    whole = told[0] if along is None else {"over": {"name": along[0], "values": along[1]}, "designs": told}
    if written is not None:
        write_json(whole, written)
    if picture is not None and diagram is not None:
        pictures.design(diagram, whole, picture)
    elif picture is not None:
        pictures.design_map(whole, picture)
    climbed = f"{sum(one.starts for one in found):,} ascents in {seconds:.1f} s"
    lines = report.lines(whole) if along is None else report.table(whole)
    command.close("\n".join([climbed, *lines]), written, picture)


def _devices(
    over: str | None, axes: dict[str, Any], device: "Harvester", names: tuple[str, ...]
) -> "tuple[tuple[str, np.ndarray] | None, list[Harvester]]":
    """The axis along which designs are wanted, if there is one, and the device at each of its values."""
    from vijax.design.variables import constant
    from vijax.model.quantities import AXES
    from vijax.planes.axes import parse_axis

    if over is None:
        return None, [command.at_one_point(axes, device)[1]]
    name, sign, text = over.partition("=")
    if not sign or name not in AXES or name in ("u0", "v0"):
        raise ValueError(f"over must be NAME=VALUES, as in d=0.05:0.3:64; got {over!r}")
    if name in axes:
        raise ValueError(f"over must name an axis that is not given besides; got {name}, also given by --{name}")
    if constant(name) in map(constant, names):
        raise ValueError(f"over must name what is not tuned; got {name}, with {', '.join(names)} tuned")
    with command.about("over"):
        values = np.atleast_1d(parse_axis(name, text))
    return (name, values), [command.at_one_point({**axes, name: value}, device)[1] for value in values]


def _bounds(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Bounds written NAME=LO:HI."""
    from vijax.design.variables import NAMES
    from vijax.planes.axes import parse_axis

    found = {}
    for text in texts:
        name, sign, pair = text.partition("=")
        if not sign or name not in NAMES or pair.count(":") != 1:
            raise ValueError(f"bounds must be NAME=LO:HI of a tuned quantity, as in omega0=20:400; got {text!r}")
        with command.about("bounds"):
            low, high = parse_axis(name, pair.replace(":", ","))
        found[name] = (float(low), float(high))
    return found


def _tolerances(texts: Iterable[str]) -> "tuple[Tolerance, ...]":
    """Tolerances written NAME=5%, NAME=0.05 or NAME=5%:lognormal, apart by commas."""
    from vijax.design.tolerance import Tolerance, check_tolerances

    found = []
    for text in (item.strip() for several in texts for item in several.split(",")):
        name, _, rest = text.partition("=")
        spread, _, kind = rest.partition(":")
        if not name or not spread:
            raise ValueError(f"tolerance must be NAME=5%, with :lognormal or not; got {text!r}")
        found.append(Tolerance(name, command.part("tolerance", spread), kind or "uniform"))
    with command.about("tolerance"):
        return check_tolerances(found)


def _diagram(found: "Design", device: "Harvester") -> "xr.Dataset":
    """P up and down along the first tuned axis, closer by about the best design, all else as there."""
    from vijax.design.variables import LINEAR, limits
    from vijax.model.quantities import AXES
    from vijax.planes.orbit_diagram import orbit_diagram
    from vijax.plots.designs import close_view

    along = next((name for name in found.tune if name in AXES), "omega0")
    device = found.best.device if found.best else device
    low, high = limits((along,), {along: found.bounds[along]} if along in found.bounds else {}, device)[:, 0]
    values = (np.linspace if along in LINEAR else np.geomspace)(low, high, _POINTS)
    if found.best is not None and along in found.best.values:
        first, last = close_view(along, found.best.values[along])
        near = np.linspace(max(first, low), min(last, high), _NEAR)
        values = np.unique(np.concatenate([values, near]))
    return orbit_diagram(along=along, values=values, direction="both", device=device)


def _judged(found: "Design", scatter: "tuple[Tolerance, ...]", alone: bool) -> dict[str, Any]:
    """What becomes of the best design over the tolerances; what lies around it, where it is the only one."""
    from vijax.design.optimise import under
    from vijax.design.robustness import surroundings

    if found.best is None:
        return {"tolerances": scatter}
    around = surroundings(found.best, starts=_BASINS) if alone else None
    return {"tolerances": scatter, "spread": under(found.best, scatter) if scatter else None, "surroundings": around}


def main(arguments: list[str] | None = None) -> int:
    """Exit code, as `command.run` says."""
    return command.run(design, arguments)


if __name__ == "__main__":
    sys.exit(main())
