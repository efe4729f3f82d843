"""The page of `scripts/grid.py`: `vijax sweep`, and with --compare `vijax compare`."""

from typing import Any

import click

from vijax.cli import process
from vijax.cli import sweep as page
from vijax.cli.compare import difference_map, tolerance_option
from vijax.cli.excitation import take_excitation
from vijax.cli.kinds import Choice
from vijax.cli.membranes import MEMBRANE_NUMBERS
from vijax.cli.page import Page, Sections
from vijax.planes.sweep_settings import SweepSettings

_METHOD_OPTIONS = ("method", "solver", "rtol", "atol", "friction", "steps", "membrane", *MEMBRANE_NUMBERS)


def map_or_difference(compare: str | None, tolerance: str | None, **given: Any) -> None:
    """Map the energy harvested over a plane of parameters."""
    if compare is None:
        with process.door():
            if tolerance is not None:
                raise ValueError(f"tolerance must come with compare; got {tolerance} alone; add --compare rigid")
        page.power_map(**given)
    else:
        with process.door():
            _leave_out(given)
        difference_map(tolerance=tolerance, **given)


def _leave_out(given: dict[str, Any]) -> None:
    """Take out what a comparison does not know, or raise where it was chosen."""
    if (show := given.pop("show")) != "P":
        raise ValueError(f"show must be left out with compare, which shows the difference in P; got {show}")
    if (wall := given.pop("wall")) != SweepSettings.wall:
        raise ValueError(f"wall must not be chosen with compare, which runs soft and rigid ones; got {wall!r}")
    if (outputs := given.pop("outputs")) is not None:
        raise ValueError(f"outputs must not be chosen with compare; got {outputs!r}; leave them out")
    if (levels := given.pop("refine")) is not None:
        raise ValueError(f"refine must not be chosen with compare, which computes every cell; got {levels}")
    if (starts := given.pop("starts")) != 1:
        raise ValueError(f"starts must not be chosen with compare, whose cells have one; got {starts}")
    for name in _METHOD_OPTIONS:
        if (value := given.pop(name)) != getattr(SweepSettings, name, None):
            raise ValueError(f"{name} must not be chosen with compare, which is exact; got {value!r}")
    if given.pop("curves"):
        raise ValueError("curves must be left out with compare, whose maps have no labels; got them")
    if take_excitation(given) is not None:
        raise ValueError(
            "harmonics, record and noise must be left out with compare, whose forcing is the sine; got one"
        )
    crew = [given.pop(name) for name in ("workers", "scheduler")]
    if crew != [None, None]:
        raise ValueError(f"workers must be left out with compare, which runs in one process; got {crew[0] or crew[1]}")


def _sections() -> Sections:
    rigid = click.Option(
        ["--compare"], type=Choice(["rigid"]), metavar="rigid", help="map what rigid walls change instead"
    )
    found = dict(page.sections())
    files, large = found.pop("Files"), found.pop("Large runs")
    return found | {"Comparison": [rigid, tolerance_option("with --compare: ")], "Files": files, "Large runs": large}


_EXAMPLES = (*page.EXAMPLES, "--kappa 3:4000:128:log --compare rigid --tolerance 5%")

grid = Page(
    "grid",
    map_or_difference,
    _sections(),
    _EXAMPLES,
    f"{page.NEITHER} Of a comparison they are comparison.zarr and comparison.png. {page.GOES_ON}",
)
