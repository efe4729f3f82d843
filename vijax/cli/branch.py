"""`vijax branch`: periodic orbits along a parameter, stable and unstable, with their bifurcations located."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import membranes, options, process
from vijax.cli.arguments import about, at_one_point, device, take_axes
from vijax.cli.closing import finish, pace
from vijax.cli.excitation import harmonic_options, take_excitation
from vijax.cli.kinds import Whole
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress, waiting
from vijax.cli.targets import targets
from vijax.model.quantities import AXES, BRANCH_QUANTITIES, PARAMETERS, whole
from vijax.runtime.pages import see

if TYPE_CHECKING:
    from vijax.model.choices import Walls
    from vijax.model.device import Harvester
    from vijax.model.excitation import Excitation
    from vijax.model.membrane import MembraneLaw
    from vijax.model.pair import ImpactPair
    from vijax.orbits.continuation import Branch
    from vijax.orbits.events import Point
    from vijax.orbits.periodic import Orbit

_FILES = ("branch.zarr", "branch.png")
_START = {"d": "0.2", "kappa": "400"}
# Orbits to begin with are looked for at these parts of the way between the bounds, in this order.
_PARTS = (1 / 2, 1 / 4, 3 / 4, 1 / 8, 3 / 8, 5 / 8, 7 / 8)


@dataclass(frozen=True)
class BranchRequest:
    """Branches that are asked for.

    Attributes:
        pair, device: What the orbits belong to.
        impacts, guesses, membrane, excitation, max_switches: As `orbit_search.search` and `switching.family` take
            them.
        along, within: The parameter that is followed, and its bounds.
        places: Values of it at which orbits to begin with are looked for, in turn.
    """

    pair: "ImpactPair"
    device: "Harvester"
    impacts: str
    guesses: int
    membrane: "MembraneLaw | None"
    excitation: "Excitation | None"
    max_switches: int
    along: str
    within: tuple[float, float]
    places: list[float]


def branches(
    quantity: str,
    out: str | None,
    csv: str | None,
    plot: str | None,
    overwrite: bool,
    constants: tuple[str, ...],
    **given: Any,
) -> None:
    """Follow periodic orbits, and locate what they meet.

    Followed is d, kappa, r, gamma, omega, omega0, k, s, A or beta. The orbits start at the parameters given, with the
    impacts asked for: walls in order, such as RLL, or a label n:m/pT. Where that parameter is not given, they start at
    the device's own value, or where there are orbits within its bounds.
    """
    with process.door():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        asked = _asked(constants, **given)
        _check_picture(picture, quantity)
    from vijax.orbits import branch_dataset, switching

    began = time.perf_counter()
    with progress(2, "stages") as show:
        waiting("search for orbits, compiled at first")
        with process.door():
            found = _found(asked)
        show(1, 2)
        waiting("branches, compiled at first")
        followed = switching.family(
            found, asked.along, asked.within, device=asked.device, max_switches=asked.max_switches
        )
        show(2, 2)
    seconds = time.perf_counter() - began

    def draw(dataset: Any, path: Path) -> None:
        from vijax import plots

        plots.save(plots.branches(dataset, quantity), path)

    dataset = branch_dataset.dataset(followed, asked.device)
    said = _summary(followed, seconds)
    finish(dataset, said, store, picture, draw, overwrite, table=rows, rows_of=asked.along)


def _asked(
    constants: tuple[str, ...], along: str, impacts: str, guesses: int, max_switches: int, wall: "Walls", **given: Any
) -> BranchRequest:
    from vijax.engine.forcing import with_harmonics
    from vijax.model.membrane import nondimensional, with_law
    from vijax.orbits import orbit_search, parameter, switching
    from vijax.runtime import checks

    name, within = _bounds(along)
    chosen = given.get(name) is not None
    # Along a quantity of the device a branch begins at that of Tables I and II, all that is not given.
    start = {} if name in options.DEVICE else _START
    membrane = membranes.take_membrane(given)
    own_r = {name: given[name] for name in PARAMETERS if whole(name) == "r" and given[name] is not None}
    pair, made = at_one_point(take_axes(given, start), device(constants), wall)
    pair = _without_r(pair, membrane, own_r)
    excitation = take_excitation(given)
    own = None if membrane is None else nondimensional(membrane, made)
    with_harmonics(with_law(pair, own), excitation)  # which say what such a pair cannot have
    checks.whole("max_switches", max_switches, 0, switching.MOST_SWITCHES)
    walls, _ = orbit_search.sequences(impacts)
    orbit_search.check_guesses(guesses, len(walls))
    with about("along"):
        parameter.check_along(pair, name, within)
    places = list(_places(float(parameter.value_at(pair, name, made)), name, within, chosen))
    return BranchRequest(pair, made, impacts, guesses, membrane, excitation, max_switches, name, within, places)


def _without_r(pair: "ImpactPair", membrane: "MembraneLaw | None", given: dict[str, str]) -> "ImpactPair":
    """Leave r out of the pair of a membrane that takes none."""
    if membrane is None or membrane.restitution:
        return pair
    for name, value in given.items():
        raise ValueError(f"{name} must be left out with a membrane that has no restitution; got {value}")
    nothing: Any = None
    return replace(pair, r=nothing)


def _check_picture(path: Path | None, quantity: str) -> None:
    from vijax.plots.branch_diagrams import check_branch_quantity
    from vijax.plots.style import check_format

    check_branch_quantity(quantity)
    if path is not None:
        check_format(path)


def _bounds(along: str) -> tuple[str, tuple[float, float]]:
    from vijax.planes.axes import parse_axis

    name, sign, text = along.partition("=")
    if not sign or name not in AXES or text.count(":") != 1:
        raise ValueError(f"along must be NAME=LO:HI, as in d=0.1:0.3; got {along!r}")
    with about("along"):
        low, high = parse_axis(name, text.replace(":", ","))
    return name, (float(low), float(high))


def _places(own: float, name: str, within: tuple[float, float], chosen: bool) -> Iterator[float]:
    """Give the places where branches may begin: the device's own value and, unless that was chosen, others."""
    low, high = within
    if low <= own <= high:
        yield own
    elif chosen:
        raise ValueError(f"{name} must lie within the bounds of along to begin there; got {own:.6g}; leave it out")
    if not chosen:
        yield from (low + part * (high - low) for part in _PARTS)


def _found(asked: BranchRequest) -> "Orbit":
    """Search for orbits, and take those at the first place that has any."""
    from vijax.orbits import parameter

    for place in asked.places:
        pair = parameter.pair_at(asked.pair, asked.along, place, asked.device)
        if len(found := _searched(asked, pair, place)):
            return found
    tried = ", ".join(f"{place:.6g}" for place in asked.places)
    raise ValueError(
        see(
            "attractors",
            f"impacts must be those of an orbit where the branch begins; got none with {asked.impacts} at "
            f"{asked.along} = {tried}; try more guesses",
        )
    )


def _searched(asked: BranchRequest, pair: "ImpactPair", place: float) -> "Orbit":
    from vijax.model.membrane import nondimensional
    from vijax.orbits import orbit_search
    from vijax.orbits.limits import device_at

    here = device_at(asked.device, asked.along, place)
    law = None if asked.membrane is None else nondimensional(asked.membrane, here)
    return orbit_search.search(pair, asked.impacts, guesses=asked.guesses, membrane=law, excitation=asked.excitation)


def _summary(followed: "list[Branch]", seconds: float) -> str:
    """Say of each branch in a line: its labels, its range, how much of it is stable, what it met, how it ends."""
    from vijax.orbits import orbit_properties

    lines = [pace(sum(len(one.values) for one in followed), seconds, "orbits")]
    for one in followed:
        # A single orbit of another label is one at a bifurcation, where the branch begins.
        often = [
            name for name, count in Counter(orbit_properties.labels(one.orbit).tolist()).most_common() if count > 1
        ]
        name = ", ".join(often) or orbit_properties.labels(one.orbit)[0]
        met = ", ".join(map(_told, one.points)) or "nothing"
        span = f"{one.along} {one.values.min():.6g} to {one.values.max():.6g}"
        lines.append(f"{name}: {span}, {100 * one.stable.mean():.0f} % of its orbits stable; met {met}")
        lines.append(f"    ends: {one.ends[0]}; {one.ends[1]}")
    return "\n".join(lines)


def _told(point: "Point") -> str:
    return f"{point.kind} {point.value:.8g}" + (f" (on with {point.onward})" if point.onward else "")


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    shown: dict[str, Any] = {"show_default": True}
    switches = "how often to switch at flip and pitchfork"
    return {
        "Branch": [
            click.Option(
                ["--along"], default="d=0.1:0.3", metavar="NAME=LO:HI", help="parameter and its bounds", **shown
            ),
            click.Option(["--impacts"], default="1:1", help="walls in order (RLL), or a label n:m/pT", **shown),
            click.Option(
                ["--guesses"], type=Whole(1), default=1024, help="random guesses of each sequence of walls", **shown
            ),
            click.Option(["--max-switches"], type=Whole(0), default=1, help=switches, **shown),
        ],
        "Device": [
            *options.axis_options(PARAMETERS),
            *options.device_options(),
            options.wall_option(),
            *membranes.membrane_options("law of the soft walls"),
        ],
        "Excitation": harmonic_options(),
        "Files": [options.quantity_option(BRANCH_QUANTITIES), *options.file_options(row="orbit")],
    }


_EXAMPLES = (
    "",
    "--wall rigid --d 0.19 --impacts RLL --along d=0.1:0.3",
    "--s 0.2 --omega 11 --impacts 1:1/3T --along omega=2.5:13 --max-switches 2",
    "--s 0.3 --along omega0=20:400 --quantity P",
    "--kappa 40 --along d=0.1:0.3 --membrane hunt-crossley --chi 0.3",
    "--kappa 40 --along d=0.1:0.3 --harmonics 1,0.3",
)

branch = Page(
    "branch",
    branches,
    _sections(),
    _EXAMPLES,
    f"{options.VALUES} With none of --out, --csv and --plot, branch.zarr and branch.png are written.",
)
