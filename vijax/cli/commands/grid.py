"""The command of `scripts/grid.py`: `vijax sweep`, and `vijax compare` with --compare."""

from typing import Any

import click

from vijax.cli import process
from vijax.cli.commands import sweep as page
from vijax.cli.commands.compare import difference_map, tolerance_option
from vijax.cli.options.excitation import take_excitation
from vijax.cli.options.membranes import MEMBRANE_NUMBERS
from vijax.cli.options.value_types import Choice
from vijax.cli.page import Page, Sections
from vijax.maps.sweep_settings import SweepSettings

_METHOD_OPTIONS = ("method", "solver", "rtol", "atol", "friction", "steps", "membrane", *MEMBRANE_NUMBERS)


def map_or_difference(compare: str | None, tolerance: str | None, **parameters: Any) -> None:
    """Map the energy harvested over a plane of parameters."""
    if compare is None:
        with process.usage_errors():
            if tolerance is not None:
                raise ValueError(f"tolerance must come with compare; got {tolerance} alone; add --compare rigid")
        page.power_map(**parameters)
    else:
        with process.usage_errors():
            _drop_sweep_options(parameters)
        difference_map(tolerance=tolerance, **parameters)


def _drop_sweep_options(parameters: dict[str, Any]) -> None:
    """Remove the options of `vijax sweep` that `vijax compare` lacks; raise ValueError if the user has set one."""
    if (show := parameters.pop("show")) != "P":
        raise ValueError(f"show must be left out with compare, which shows the difference in P; got {show}")
    if (wall := parameters.pop("wall")) != SweepSettings.wall:
        raise ValueError(f"wall must not be chosen with compare, which runs soft and rigid ones; got {wall!r}")
    if (outputs := parameters.pop("outputs")) is not None:
        raise ValueError(f"outputs must not be chosen with compare; got {outputs!r}; leave them out")
    if (levels := parameters.pop("refine")) is not None:
        raise ValueError(f"refine must not be chosen with compare, which computes every cell; got {levels}")
    if (starts := parameters.pop("starts")) != 1:
        raise ValueError(f"starts must not be chosen with compare, whose cells have one; got {starts}")
    for name in _METHOD_OPTIONS:
        if (value := parameters.pop(name)) != getattr(SweepSettings, name, None):
            raise ValueError(f"{name} must not be chosen with compare, which is exact; got {value!r}")
    if parameters.pop("curves"):
        raise ValueError("curves must be left out with compare: its maps have no labels")
    if take_excitation(parameters) is not None:
        raise ValueError(
            "harmonics, record and noise must be left out with compare, whose forcing is the sine; got one"
        )
    crew = [parameters.pop(name) for name in ("workers", "scheduler")]
    if crew != [None, None]:
        raise ValueError(f"workers must be left out with compare, which runs in one process; got {crew[0] or crew[1]}")


def _sections() -> Sections:
    rigid = click.Option(
        ["--compare"], type=Choice(["rigid"]), metavar="rigid", help="map the effect of rigid walls instead"
    )
    all_sections = dict(page.sections())
    files, large = all_sections.pop("Files"), all_sections.pop("Large runs")
    return all_sections | {
        "Comparison": [rigid, tolerance_option("with --compare: ")],
        "Files": files,
        "Large runs": large,
    }


_EXAMPLES = (*page.EXAMPLES, "--kappa 3:4000:128:log --compare rigid --tolerance 5%")

grid = Page(
    "grid",
    map_or_difference,
    _sections(),
    _EXAMPLES,
    f"{page.NEITHER} Of a comparison they are comparison.zarr and comparison.png. {page.RESUMABLE}",
)
