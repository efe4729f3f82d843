"""The outputs of a map: what each variable is, its unit, what it needs of a `Summary`, and how it follows from that."""

import enum
from collections.abc import Callable, Container, Iterable
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vijax.model.device import Harvester
from vijax.model.quantities import MEASURED
from vijax.model.records import Status
from vijax.model.sides import Sides, named
from vijax.planes.cells import Cells

if TYPE_CHECKING:
    import xarray as xr

Found = dict[str, Any]  # field of Summary -> xr.Variable


class Output(NamedTuple):
    """A variable of the map: what it is, the fields of `Summary` it needs, and how it follows from them.

    `flags` are the values of a variable that is a code, under the names that CF's `flag_meanings` list.
    """

    units: str
    description: str
    needs: tuple[str, ...]
    formula: "Callable[[Found, Cells, Harvester], xr.Variable] | None" = None
    flags: type[enum.IntEnum] | None = None


class LimitViolation(enum.IntEnum):
    """The limits of admissible impacts that the impacts of a cell break."""

    UNKNOWN = -1  # the cell failed or was not run
    NONE = 0
    ENERGY_RATIO_LIMIT = 1
    PENETRATION_LIMIT = 2
    BOTH_LIMITS = 3


def _power(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    return found["P"] * cells.quantities["omega"] / np.pi


def _penetration(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    return found["deepest"] * cells.length


def _speed(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    return found["fastest"] * cells.speed


def violation(ratio: Any, depths: Iterable[tuple[Any, Any]], device: Harvester) -> Any:
    """Compute the code `LimitViolation` of cells; arrays or xarray's variables.

    Args:
        ratio: Largest ratio of harvested energy to energy given to the membrane.
        depths: Penetrations and their limits [m], of both walls or of each.
        device: Has the limit of the energy ratio.
    """
    some = list(depths)
    rich = ratio > float(device.energy_ratio_limit)
    deep = reduce(or_, [depth > float(limit) for depth, limit in some])
    failed = reduce(or_, [depth != depth for depth, _ in some], ratio != ratio)
    code = rich * LimitViolation.ENERGY_RATIO_LIMIT + deep * LimitViolation.PENETRATION_LIMIT
    return code * ~failed + failed * LimitViolation.UNKNOWN


def _violation(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    limits = named("deepest", device.depth_limit)
    depths = [(found[name] * cells.length, limit) for name, limit in limits.items()]
    return violation(found["energy_ratio"], depths, device)


def _admissible(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    return _violation(found, cells, device) == LimitViolation.NONE


def _risk(found: Found, cells: Cells, device: Harvester) -> "xr.Variable":
    return found["P"] / found["P_greatest"]


OUTPUTS = {
    "P": Output(MEASURED["P"].units, MEASURED["P"].text, ("P",)),
    "power": Output("W", "harvested power, P omega / pi", ("P",), _power),
    "P_stderr": Output("J", "standard error of P by batch means, 0 when periodic", ("P_stderr",)),
    "period": Output("1", "forcing periods in which the motion repeats; 0 aperiodic, -1 undecided", ("period",)),
    "impacts_left": Output("1", "left impacts in `period` periods, -1 unless period > 0", ("impacts_left",)),
    "impacts_right": Output("1", "right impacts in `period` periods, -1 unless period > 0", ("impacts_right",)),
    "impacts_per_period": Output("1", "impacts on both walls per forcing period", ("impacts_per_period",)),
    "max_penetration": Output("m", "greatest penetration of the membrane", ("deepest",), _penetration),
    "max_impact_speed": Output("m s-1", "greatest speed at the onset of an impact", ("fastest",), _speed),
    "asymmetry": Output(
        "1",
        "mean velocity at the onset of an impact over the greatest; mirror images differ in its sign",
        ("asymmetry",),
    ),
    "restitution": Output("1", "mean of -v_out / v_in over all impacts, NaN without impacts", ("restitution",)),
    "restitution_left": Output("1", "mean of -v_out / v_in over left impacts", ("restitution_left",)),
    "restitution_right": Output("1", "mean of -v_out / v_in over right impacts", ("restitution_right",)),
    "contact_time": Output("1", "mean duration of a contact, in half forcing periods", ("contact_time",)),
    "contact_fraction": Output("1", "part of the time spent in contact", ("contact_fraction",)),
    "admissible": Output(
        "1",
        "no impact yields more than the admissible part of the energy that it gives to the membrane, or passes the "
        "penetration limit",
        ("energy_ratio", "deepest"),
        _admissible,
    ),
    "violated_limits": Output(
        "1",
        "limits of admissible impacts that some impact breaks",
        ("energy_ratio", "deepest"),
        _violation,
        LimitViolation,
    ),
    "energy_ratio": Output("1", "largest ratio of harvested energy to energy given to the membrane", ("energy_ratio",)),
    "lyapunov": Output("1", "largest Lyapunov exponent per forcing period", ("lyapunov",)),
    "periods_run": Output("1", "forcing periods simulated", ("periods_run",)),
    "status": Output("1", "how the cell ended", ("status",), flags=Status),
}
EXPECTED = {
    "P": Output("J", "harvested energy per half period, mean over the starts", ("P",)),
    "power": Output("W", "harvested power, P omega / pi", ("P",), _power),
    "P_stderr": Output("J", "standard error of P over the starts, as if they were drawn at random", ("P_stderr",)),
    "P_least": Output("J", "P of the attractor that harvests least", ("P_least",)),
    "P_greatest": Output("J", "P of the attractor that harvests most, the best one", ("P_greatest",)),
    "expected_over_best": Output("1", "P over P_greatest, NaN where nothing is harvested", ("P", "P_greatest"), _risk),
    "best_share": Output("1", "part of the starts that end on the best attractor", ("best_share",)),
    "best_share_stderr": Output("1", "standard error of best_share", ("best_share_stderr",)),
    "attractors": Output(
        "1",
        "attractors found; aperiodic motions are one, level mirror images too, undecided starts none",
        ("attractors",),
    ),
    "undecided": Output("1", "part of the starts without a verdict", ("undecided",)),
    **{name: OUTPUTS[name] for name in ("max_penetration", "admissible", "violated_limits", "energy_ratio")},
    "status": Output("1", "how most starts ended, or that one failed", ("status",), flags=Status),
}
"""The outputs of a map over many starts in every cell, made of the fields of `expected.ManyStarts`."""
SIDES_DEEPEST = "deepest_left", "deepest_right"
# Fields in units that vary where the motion does not: a column for every variant.
VARIED = {
    *("P", "P_stderr", "energy_ratio", "deepest", *SIDES_DEEPEST, "fastest"),
    *("P_least", "P_greatest", "best_share", "best_share_stderr"),
}
# Variables that few ask for, and that cost something: a tangent map along the motion, or another sum.
ON_REQUEST = ("asymmetry", "lyapunov")
# Variables that stores of earlier versions lack: a run that goes on with such a store does without them.
_ADDED = ("violated_limits",)


def default_outputs(starts: int, begun: Container[str] | None = None) -> tuple[str, ...]:
    """Return the outputs of a map for which none are given.

    Args:
        starts: How many every cell has.
        begun: The variables of the store with which the run goes on; None for a new map.
    """
    lacking = () if begun is None else [name for name in _ADDED if name not in begun]
    return tuple(name for name in table(starts) if name not in ON_REQUEST and name not in lacking)


def flagged(values: Any, kinds: type[enum.IntEnum]) -> Any:
    """Return a variable or an array of codes as CF flags: its attributes name the codes."""
    found = values.astype(np.int8)
    found.attrs = values.attrs | {
        "flag_values": [int(kind) for kind in kinds],
        "flag_meanings": " ".join(kind.name.lower() for kind in kinds),
    }
    return found


def needs(output: Output, device: Harvester) -> tuple[str, ...]:
    """Name the fields that an output needs of cells of a device: by wall where these have limits of their own."""
    by_wall = output.formula in (_admissible, _violation) and isinstance(device.depth_limit, Sides)
    return (*output.needs, *(SIDES_DEEPEST if by_wall else ()))


def table(starts: int) -> dict[str, Output]:
    """Give the outputs of a map with so many starts in every cell."""
    return OUTPUTS if starts == 1 else EXPECTED
