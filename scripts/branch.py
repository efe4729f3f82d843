"""Branches of periodic orbits from one command: stable and unstable, with their bifurcations located.

    python scripts/branch.py
    python scripts/branch.py --wall rigid --d 0.19 --impacts RLL --along d=0.1:0.3
    python scripts/branch.py --s 0.2 --omega 11 --impacts 1:1/3T --along omega=2.5:13 --generations 2
    python scripts/branch.py --s 0.3 --along omega0=20:400 --quantity P

The orbits start at the parameters given, with the impacts asked for: walls in order, such as RLL, or a label n:m/pT.
Where the parameter that is followed is not given, they start at the device's own value, or where there are orbits
within its bounds.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click
import command

if TYPE_CHECKING:
    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair
    from vijax.orbits.continuation import Branch
    from vijax.orbits.periodic import Orbit

_DEFAULT_FILES = ("branch.zarr", "branch.png")
_START = {"d": "0.2", "kappa": "400"}
_PARTS = (1 / 2, 1 / 4, 3 / 4, 1 / 8, 3 / 8, 5 / 8, 7 / 8)  # of the bounds: where orbits to begin with are looked for


def _options() -> list[click.Parameter]:
    return [
        click.Option(
            ["--along"], default="d=0.1:0.3", show_default=True, metavar="NAME=LO:HI", help="parameter and its bounds"
        ),
        click.Option(["--impacts"], default="1:1", show_default=True, help="walls in order (RLL), or a label n:m/pT"),
        click.Option(["--guesses"], default=1024, show_default=True, help="random guesses of each sequence of walls"),
        click.Option(["--generations"], default=1, show_default=True, help="how often to switch at flip and pitchfork"),
        *command.axis_options(u0=None, v0=None),
        *command.device_options(),
        click.Option(["--wall"], default="soft", show_default=True, help="soft or rigid"),
        click.Option(
            ["--quantity"], default="v_in", show_default=True, help="what the picture shows: v_in, P, phase ..."
        ),
        *command.file_options(),
    ]


@click.command(params=_options(), context_settings={"max_content_width": 120})
def branch(
    along: str,
    impacts: str,
    guesses: int,
    generations: int,
    constants: tuple[str, ...],
    wall: str,
    quantity: str,
    out: str | None,
    plot: str | None,
    overwrite: bool,
    **given: Any,
) -> None:
    """Follow periodic orbits along d, kappa, r, gamma, omega, omega0, k, s, A or beta, and say what they meet.

    With neither --out nor --plot, branch.zarr and branch.png are written.
    """
    from vijax.orbits import continuation as branches
    from vijax.orbits import periodic
    from vijax.plots import branches as pictures
    from vijax.plots.style import check_format
    from vijax.runtime import checks

    with command.door():
        store, picture = command.targets(out, plot, _DEFAULT_FILES, overwrite)
        name, within = _bounds(along)
        chosen = given.get(name) is not None
        # Along a quantity of the device it is a device that is given, of Tables I and II unless otherwise.
        start = {} if name in command.DEVICE else _START
        pair, device = command.at_one_point(command.take_axes(given, start), command.device(constants), wall)
        checks.whole("generations", generations, 0, branches.MOST_GENERATIONS)
        walls, _ = periodic.sequences(impacts)
        periodic.check_guesses(guesses, len(walls))
        with command.about("along"):
            branches.check_along(pair, name, within)
        places = list(_places(float(branches.value_at(pair, name, device)), name, within, chosen))
        pictures.check_branch_quantity(quantity)
        if picture is not None:
            check_format(picture)
    command.keep_compiled()
    began = time.perf_counter()
    with command.progress(2, "stages") as show:
        command.waiting("search for orbits, compiled at first")
        with command.door():
            found = _found(pair, name, places, device, impacts, guesses)
        show(1, 2)
        command.waiting("branches, compiled at first")
        followed = branches.family(found, name, within, device=device, generations=generations)
        show(2, 2)
    seconds = time.perf_counter() - began
    dataset = branches.dataset(followed, device)

    def draw(dataset: Any, path: Any) -> None:
        pictures.branches(dataset, path, quantity)

    command.finish(dataset, _summary(followed, seconds), store, picture, draw, overwrite)


def _bounds(along: str) -> tuple[str, tuple[float, float]]:
    from vijax.model.quantities import AXES
    from vijax.planes.axes import parse_axis

    name, sign, text = along.partition("=")
    if not sign or name not in AXES or text.count(":") != 1:
        raise ValueError(f"along must be NAME=LO:HI, as in d=0.1:0.3; got {along!r}")
    with command.about("along"):
        low, high = parse_axis(name, text.replace(":", ","))
    return name, (float(low), float(high))


def _places(own: float, name: str, within: tuple[float, float], chosen: bool) -> Iterator[float]:
    """Where branches may begin: at the device's own value and, unless that was chosen, elsewhere in the bounds."""
    low, high = within
    if low <= own <= high:
        yield own
    elif chosen:
        raise ValueError(f"{name} must lie within the bounds of along to begin there; got {own:.6g}; leave it out")
    if not chosen:
        yield from (low + part * (high - low) for part in _PARTS)


def _found(
    pair: "ImpactPair", name: str, places: list[float], device: "Harvester", impacts: str, guesses: int
) -> "Orbit":
    """The orbits at the first place that has any."""
    from vijax.orbits import continuation as branches
    from vijax.orbits import periodic

    for place in places:
        if len(found := periodic.search(branches.pair_at(pair, name, place, device), impacts, guesses=guesses)):
            return found
    tried = ", ".join(f"{place:.6g}" for place in places)
    raise ValueError(
        f"impacts must be those of an orbit where the branch begins; got none with {impacts} at {name} = "
        f"{tried}; try more guesses"
    )


def _summary(followed: "list[Branch]", seconds: float) -> str:
    """Each branch in a line: its label, its range, how much of it is stable, what it met, how it ends."""
    from vijax.model.label import label
    from vijax.orbits import periodic

    lines = [command.pace(sum(len(one.values) for one in followed), seconds, "orbits")]
    for one in followed:
        counts = periodic.counts(one.orbit)
        name = Counter(label(counts.period, counts.left, counts.right).tolist()).most_common(1)[0][0]
        met = ", ".join(f"{point.kind} {point.value:.8g}" for point in one.points) or "nothing"
        span = f"{one.along} {one.values.min():.6g} to {one.values.max():.6g}"
        lines.append(f"{name}: {span}, {100 * one.stable.mean():.0f} % of its orbits stable; met {met}")
        lines.append(f"    ends: {one.ends[0]}; {one.ends[1]}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Exit code, as `command.run` says."""
    return command.run(branch, arguments)


if __name__ == "__main__":
    sys.exit(main())
