"""Branches of periodic orbits from one command: stable and unstable, with their bifurcations located.

    python scripts/branch.py
    python scripts/branch.py --wall rigid --d 0.19 --impacts RLL --along d=0.1:0.3
    python scripts/branch.py --s 0.2 --omega 11 --impacts 1:1/3T --along omega=2.5:13 --generations 2

The orbits start at the parameters given, with the impacts asked for: walls in order, such as RLL, or a label n:m/pT.
"""

import sys
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import click
import command

if TYPE_CHECKING:
    from vijax.branch import Branch

_DEFAULT_FILES = ("branch.zarr", "branch.png")
_START = {"d": "0.2", "kappa": "400"}


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
    """Follow periodic orbits along d, kappa, r, gamma or omega, and say what they meet.

    With neither --out nor --plot, branch.zarr and branch.png are written.
    """
    from vijax import branch as branches
    from vijax import chart, checks, orbit
    from vijax.style import check_format

    with command.door():
        store, picture = command.targets(out, plot, _DEFAULT_FILES, overwrite)
        pair, device = command.at_one_point(command.take_axes(given, _START), command.device(constants), wall)
        name, within = _bounds(along)
        checks.whole("generations", generations, 0, branches.MOST_GENERATIONS)
        walls, _ = orbit.sequences(impacts)
        orbit.check_guesses(guesses, len(walls))
        with command.about("along"):
            branches.check_bounds(pair, name, within, device)
        chart.check_branch_quantity(quantity)
        if picture is not None:
            check_format(picture)
    command.keep_compiled()
    began = time.perf_counter()
    found = orbit.search(pair, impacts, guesses=guesses)
    with command.door():
        if not len(found):
            raise ValueError(
                f"impacts must be those of an orbit at the start; got none with {impacts}; try more guesses"
            )
    followed = branches.family(found, name, within, device=device, generations=generations)
    seconds = time.perf_counter() - began
    dataset = branches.dataset(followed, device)

    def draw(dataset: Any, path: Any) -> None:
        chart.branches(dataset, path, quantity)

    command.finish(dataset, _summary(followed, seconds), store, picture, draw, overwrite)


def _bounds(along: str) -> tuple[str, tuple[float, float]]:
    from vijax.axes import AXES, parse_axis

    name, sign, text = along.partition("=")
    if not sign or name not in AXES or text.count(":") != 1:
        raise ValueError(f"along must be NAME=LO:HI, as in d=0.1:0.3; got {along!r}")
    with command.about("along"):
        low, high = parse_axis(name, text.replace(":", ","))
    return name, (float(low), float(high))


def _summary(followed: "list[Branch]", seconds: float) -> str:
    """Each branch in a line: its label, its range, how much of it is stable, what it met, how it ends."""
    from vijax import orbit
    from vijax.label import label

    lines = [command.pace(sum(len(one.values) for one in followed), seconds, "orbits")]
    for one in followed:
        counts = orbit.counts(one.orbit)
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
