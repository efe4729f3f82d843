"""The outputs of a map: description, unit, required fields of a `Summary`, and formula of each variable."""

import enum
from collections.abc import Callable, Container, Iterable
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vijax.maps.cells import Cells
from vijax.model.device import Harvester
from vijax.model.quantities import RESULT_QUANTITIES
from vijax.model.records import Status
from vijax.model.walls.sides import Sides, values_by_name

if TYPE_CHECKING:
    import xarray as xr

FieldVariables = dict[str, Any]  # field of Summary -> xr.Variable


class Output(NamedTuple):
    """A variable of the map.

    Attributes:
        units: Unit, as an attribute of the variable.
        description: Meaning, as the attribute `long_name`.
        needs: Names of the fields of `Summary` that the variable is computed from.
        formula: Function of fields, cells and device that computes the variable; None if the variable is the field
            itself.
        flags: Values of a variable that is a code, with the names listed in CF's `flag_meanings`.
    """

    units: str
    description: str
    needs: tuple[str, ...]
    formula: "Callable[[FieldVariables, Cells, Harvester], xr.Variable] | None" = None
    flags: type[enum.IntEnum] | None = None


class LimitViolation(enum.IntEnum):
    """The limits of admissible impacts that the impacts of a cell violate."""

    UNKNOWN = -1  # the cell failed or was not run
    NONE = 0
    ENERGY_RATIO_LIMIT = 1
    PENETRATION_LIMIT = 2
    BOTH_LIMITS = 3


def _power(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return the power P omega/pi [W]; P is the energy per half forcing period, pi/omega seconds."""
    return fields["P"] * cells.quantities["omega"] / np.pi


def _penetration(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return the greatest penetration [m]."""
    return fields["deepest"] * cells.length


def _speed(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return the greatest impact speed [m/s]."""
    return fields["fastest"] * cells.speed


def violation(ratio: Any, depths: Iterable[tuple[Any, Any]], device: Harvester) -> Any:
    """Return the code `LimitViolation` of every cell, as an array or an xarray variable like the arguments.

    Args:
        ratio: Largest ratio of harvested energy to energy given to the membrane.
        depths: Pairs (largest penetration, its limit) [m]: one pair for both walls, or one pair per wall.
        device: Device with the limit of the energy ratio.
    """
    pairs = list(depths)
    exceeds_energy = ratio > float(device.energy_ratio_limit)
    exceeds_depth = reduce(or_, [depth > float(limit) for depth, limit in pairs])
    # NaN is unequal to itself: a cell with a NaN has failed or was not run.
    failed = reduce(or_, [depth != depth for depth, _ in pairs], ratio != ratio)
    # The codes are bits, 1 for energy and 2 for penetration. Arithmetic in place of `where` works for NumPy, JAX and
    # xarray alike.
    code = exceeds_energy * LimitViolation.ENERGY_RATIO_LIMIT + exceeds_depth * LimitViolation.PENETRATION_LIMIT
    return code * ~failed + failed * LimitViolation.UNKNOWN


def _violation(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return the code `LimitViolation`, with the penetration limits per wall where they differ."""
    limits = values_by_name("deepest", device.depth_limit)
    depths = [(fields[name] * cells.length, limit) for name, limit in limits.items()]
    return violation(fields["energy_ratio"], depths, device)


def _admissible(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return True where no impact violates a limit."""
    return _violation(fields, cells, device) == LimitViolation.NONE


def _expected_over_best(fields: FieldVariables, cells: Cells, device: Harvester) -> "xr.Variable":
    """Return the mean P over the starts, divided by P of the attractor that harvests most."""
    return fields["P"] / fields["P_greatest"]


OUTPUTS = {
    "P": Output(RESULT_QUANTITIES["P"].units, RESULT_QUANTITIES["P"].text, ("P",)),
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
MULTI_START_OUTPUTS = {
    "P": Output("J", "harvested energy per half period, mean over the starts", ("P",)),
    "power": Output("W", "harvested power, P omega / pi", ("P",), _power),
    "P_stderr": Output("J", "standard error of P over the starts, as if they were drawn at random", ("P_stderr",)),
    "P_least": Output("J", "P of the attractor that harvests least", ("P_least",)),
    "P_greatest": Output("J", "P of the attractor that harvests most, the best one", ("P_greatest",)),
    "expected_over_best": Output(
        "1", "P over P_greatest, NaN where nothing is harvested", ("P", "P_greatest"), _expected_over_best
    ),
    "best_share": Output("1", "part of the starts that end on the best attractor", ("best_share",)),
    "best_share_stderr": Output("1", "standard error of best_share", ("best_share_stderr",)),
    "attractors": Output(
        "1",
        "number of attractors; aperiodic motions count as one, level mirror images as one, undecided starts as none",
        ("attractors",),
    ),
    "undecided": Output("1", "fraction of undecided starts", ("undecided",)),
    **{name: OUTPUTS[name] for name in ("max_penetration", "admissible", "violated_limits", "energy_ratio")},
    "status": Output("1", "how most starts ended, or that one failed", ("status",), flags=Status),
}
"""The outputs of a map over many starts per cell, computed from the fields of `start_statistics.StartStatistics`."""
SIDES_DEEPEST = "deepest_left", "deepest_right"
# Fields with one column per variant: their units change along variant dimensions, for example of A or omega.
VARIED = {
    *("P", "P_stderr", "energy_ratio", "deepest", *SIDES_DEEPEST, "fastest"),
    *("P_least", "P_greatest", "best_share", "best_share_stderr"),
}
# Variables computed on request only, because `lyapunov` needs the tangent map along the motion, and `asymmetry` a
# further sum over impacts.
ON_REQUEST = ("asymmetry", "lyapunov")
# Variables that stores of earlier versions lack: a run that continues such a store omits them.
_ADDED_LATER = ("violated_limits",)


def default_outputs(starts: int, existing: Container[str] | None = None) -> tuple[str, ...]:
    """Return the outputs of a map if the user specifies none.

    Args:
        starts: Number of starts of every cell.
        existing: Names of the variables of the store that the run continues; None for a new map.
    """
    missing = () if existing is None else [name for name in _ADDED_LATER if name not in existing]
    return tuple(name for name in available_outputs(starts) if name not in ON_REQUEST and name not in missing)


def flagged(values: Any, kinds: type[enum.IntEnum]) -> Any:
    """Return a variable or an array of codes as CF flags: its attributes name the codes."""
    # CF requires flag values of the same dtype as the variable; every code fits in one byte.
    flags = values.astype(np.int8)
    flags.attrs = values.attrs | {
        "flag_values": [int(kind) for kind in kinds],
        "flag_meanings": " ".join(kind.name.lower() for kind in kinds),
    }
    return flags


def needs(output: Output, device: Harvester) -> tuple[str, ...]:
    """Return the fields that an output requires, with penetrations per wall if the device has a limit per wall."""
    # These two outputs compare penetrations with limits, which may differ between the walls.
    by_wall = output.formula in (_admissible, _violation) and isinstance(device.depth_limit, Sides)
    return (*output.needs, *(SIDES_DEEPEST if by_wall else ()))


def available_outputs(starts: int) -> dict[str, Output]:
    """Return the outputs of a map with this number of starts per cell."""
    return OUTPUTS if starts == 1 else MULTI_START_OUTPUTS
