"""`vijax branch`: stable and unstable periodic orbits along a parameter, with their bifurcations."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.cli import process
from vijax.cli.arguments import device, name_option_in_errors, single_cell, take_axes
from vijax.cli.closing import finish, rate_text
from vijax.cli.options import membranes, options
from vijax.cli.options.excitation import harmonic_options, take_excitation
from vijax.cli.options.output_files import targets
from vijax.cli.options.value_types import Integer
from vijax.cli.page import Page, Sections
from vijax.cli.progress import progress, waiting
from vijax.model.quantities import AXES, BRANCH_QUANTITIES, PARAMETERS, without_wall
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    from vijax.continuation.branch_continuation import Branch
    from vijax.continuation.branch_events import Point
    from vijax.model.choices import Walls
    from vijax.model.device import Harvester
    from vijax.model.forcing.excitation import Excitation
    from vijax.model.pair import ImpactPair
    from vijax.model.walls.membrane import MembraneLaw
    from vijax.orbits.periodic import Orbit

_FILES = ("branch.zarr", "branch.png")
_START = {"d": "0.2", "kappa": "400"}
# Fractions of the interval between the bounds where the search for a first orbit is tried, in this order.
_SEARCH_FRACTIONS = (1 / 2, 1 / 4, 3 / 4, 1 / 8, 3 / 8, 5 / 8, 7 / 8)


@dataclass(frozen=True)
class BranchRequest:
    """Validated arguments of `vijax branch`.

    Attributes:
        pair, device: Pair and device of the orbits.
        impacts, guesses, membrane, excitation: Arguments of `orbit_search.find_orbits`.
        max_switches: Argument of `branch_switching.follow_families`.
        along, within: The continuation parameter, and its bounds.
        places: Values of `along` where a first orbit is searched for, in this order.
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
    **parameters: Any,
) -> None:
    """Follow periodic orbits, and locate their bifurcations.

    The parameter of --along is d, kappa, r, gamma, omega, omega0, k, s, A or beta. The first orbits have the impacts of
    --impacts: walls in order, such as RLL, or a label n:m/pT. They are searched for at the parameters of the options.
    If no option sets the parameter of --along, the search tries the device's value, then values within the bounds.
    """
    with process.usage_errors():
        store, picture, rows = targets(out, plot, _FILES, overwrite, csv=csv)
        request = _make_request(constants, **parameters)
        _check_picture(picture, quantity)
    from vijax.continuation import branch_dataset, branch_switching

    began = time.perf_counter()
    with progress(2, "stages") as show:
        waiting("search for orbits, compiled at first")
        with process.usage_errors():
            orbits = _first_orbits(request)
        show(1, 2)
        waiting("branches, compiled at first")
        branch_list = branch_switching.follow_families(
            orbits, request.along, request.within, device=request.device, max_switches=request.max_switches
        )
        show(2, 2)
    seconds = time.perf_counter() - began

    def draw(dataset: Any, path: Path) -> None:
        from vijax import plots

        plots.save(plots.branches(dataset, quantity), path)

    dataset = branch_dataset.branch_dataset(branch_list, request.device)
    summary = _summary(branch_list, seconds)
    finish(dataset, summary, store, picture, draw, overwrite, table=rows, rows_of=request.along)


def _make_request(
    constants: tuple[str, ...],
    along: str,
    impacts: str,
    guesses: int,
    max_switches: int,
    wall: "Walls",
    **parameters: Any,
) -> BranchRequest:
    from vijax.continuation import branch_switching, continuation_parameter
    from vijax.impact.forcing import with_harmonics
    from vijax.model.walls.membrane import nondimensional, with_law
    from vijax.orbits import orbit_search
    from vijax.runtime import validation

    name, within = _bounds(along)
    specified = parameters.get(name) is not None
    # If --along is a quantity with a unit, unspecified parameters are taken from the device of Tables I and II,
    # otherwise from the default pair `_START`.
    start = {} if name in options.DEVICE else _START
    membrane = membranes.take_membrane(parameters)
    restitutions = {
        name: parameters[name] for name in PARAMETERS if without_wall(name) == "r" and parameters[name] is not None
    }
    pair, harvester = single_cell(take_axes(parameters, start), device(constants), wall)
    pair = _without_r(pair, membrane, restitutions)
    excitation = take_excitation(parameters)
    law = None if membrane is None else nondimensional(membrane, harvester)
    with_harmonics(with_law(pair, law), excitation)  # raises if the pair is invalid with them
    validation.validate_integer("max_switches", max_switches, 0, branch_switching.MOST_SWITCHES)
    walls, _ = orbit_search.sequences(impacts)
    orbit_search.check_guesses(guesses, len(walls))
    with name_option_in_errors("along"):
        continuation_parameter.check_along(pair, name, within)
    places = list(_places(float(continuation_parameter.value_at(pair, name, harvester)), name, within, specified))
    return BranchRequest(pair, harvester, impacts, guesses, membrane, excitation, max_switches, name, within, places)


def _without_r(pair: "ImpactPair", membrane: "MembraneLaw | None", restitutions: dict[str, str]) -> "ImpactPair":
    """Return the pair without r if the membrane law has no restitution; raise ValueError if r is specified."""
    if membrane is None or membrane.restitution:
        return pair
    for name, value in restitutions.items():
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
    from vijax.maps.axes import parse_axis

    name, sign, text = along.partition("=")
    if not sign or name not in AXES or text.count(":") != 1:
        raise ValueError(f"along must be NAME=LO:HI, as in d=0.1:0.3; got {along!r}")
    with name_option_in_errors("along"):
        low, high = parse_axis(name, text.replace(":", ","))
    return name, (float(low), float(high))


def _places(value: float, name: str, within: tuple[float, float], specified: bool) -> Iterator[float]:
    """Yield the parameter values where a first orbit is searched for.

    Args:
        value: Value of the parameter in the device.
        name: Name of the parameter.
        within: Bounds of the parameter.
        specified: Whether the user specified `value`; if so, it is the only place.

    Raises:
        ValueError: If the user specified a value outside the bounds.
    """
    low, high = within
    if low <= value <= high:
        yield value
    elif specified:
        raise ValueError(f"{name} must lie within the bounds of along to begin there; got {value:.6g}; leave it out")
    if not specified:
        yield from (low + part * (high - low) for part in _SEARCH_FRACTIONS)


def _first_orbits(request: BranchRequest) -> "Orbit":
    """Search for orbits at each of `request.places` in turn, and return all orbits of the first place with an orbit."""
    from vijax.continuation import continuation_parameter

    for place in request.places:
        pair = continuation_parameter.pair_at(request.pair, request.along, place, request.device)
        if len(orbits := _search(request, pair, place)):
            return orbits
    searched = ", ".join(f"{place:.6g}" for place in request.places)
    raise ValueError(
        see(
            "attractors",
            f"impacts must be those of an orbit where the branch begins; got none with {request.impacts} at "
            f"{request.along} = {searched}; try more guesses",
        )
    )


def _search(request: BranchRequest, pair: "ImpactPair", place: float) -> "Orbit":
    from vijax.continuation.limits import device_with_value
    from vijax.model.walls.membrane import nondimensional
    from vijax.orbits import orbit_search

    device_here = device_with_value(request.device, request.along, place)
    law = None if request.membrane is None else nondimensional(request.membrane, device_here)
    return orbit_search.find_orbits(
        pair, request.impacts, guesses=request.guesses, membrane=law, excitation=request.excitation
    )


def _summary(branch_list: "list[Branch]", seconds: float) -> str:
    """Return a text: a line with the rate, then two lines per branch.

    The first line of a branch has its labels, its range, the share of stable orbits and the special points. The second
    line has the reasons why the branch ends at its two ends.
    """
    from vijax.orbits import orbit_properties

    lines = [rate_text(sum(len(item.values) for item in branch_list), seconds, "orbits")]
    for item in branch_list:
        # A label of a single orbit is left out: that orbit is the bifurcation where the branch begins.
        often = [
            name
            for name, count in Counter(orbit_properties.orbit_labels(item.orbit).tolist()).most_common()
            if count > 1
        ]
        name = ", ".join(often) or orbit_properties.orbit_labels(item.orbit)[0]
        points = ", ".join(map(_describe_point, item.points)) or "none"
        span = f"{item.along} {item.values.min():.6g} to {item.values.max():.6g}"
        lines.append(f"{name}: {span}, {100 * item.stable.mean():.0f} % of its orbits stable; special points: {points}")
        lines.append(f"    ends: {item.ends[0]}; {item.ends[1]}")
    return "\n".join(lines)


def _describe_point(point: "Point") -> str:
    return f"{point.kind} {point.value:.8g}" + (
        f" (on with {point.impact_change_text})" if point.impact_change_text else ""
    )


# --- the page --------------------------------------------------------------------------------------------------------


def _sections() -> Sections:
    with_default: dict[str, Any] = {"show_default": True}
    switches = "how often to switch at flip and pitchfork"
    return {
        "Branch": [
            click.Option(
                ["--along"], default="d=0.1:0.3", metavar="NAME=LO:HI", help="parameter and its bounds", **with_default
            ),
            click.Option(["--impacts"], default="1:1", help="walls in order (RLL), or a label n:m/pT", **with_default),
            click.Option(
                ["--guesses"],
                type=Integer(1),
                default=1024,
                help="random guesses of each sequence of walls",
                **with_default,
            ),
            click.Option(["--max-switches"], type=Integer(0), default=1, help=switches, **with_default),
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
