"""The table of all physical quantities: name, unit, range of values, default, and texts for errors and help.

All other modules read this table; its main entry is `AXES`, the quantities that a sweep can vary. JAX and NumPy are
imported only when a value is checked, so that help of the command is fast.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """Condition on the values of a quantity: an elementwise function, false for NaN, and the text for errors."""

    holds: Callable[[Any], Any]
    must: str


_POSITIVE = Rule(lambda x: (x > 0) & (x < math.inf), "must be positive and finite")
_FINITE = Rule(lambda x: abs(x) < math.inf, "must be finite")
_NOT_NEGATIVE = Rule(lambda x: (x >= 0) & (x < math.inf), "must be finite and not negative")
_LIMIT = Rule(lambda x: x > 0, "must be positive")
# True for every number, NaN included.
_REAL = Rule(lambda x: (x == x) | (x != x), "must be a real number")
_PART = Rule(lambda x: (x > 0) & (x <= 1), "must lie in (0, 1]")


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be specified: of the pair, of the device, or of the start.

    Attributes:
        name: Name of arguments, fields and options.
        text: Description.
        rule: Condition on its values.
        unit: SI unit of plain numbers; "" for a pure number.
        formula: Formula of a pure number in terms of the device, or its unit.
        symbol: Symbol in TeX; default is the name.
        alias_of: Constant of the device that this quantity determines under another name.
        default: Default, as the command accepts it or in words.
        advice: Remedy for values out of range; default is the description with the unit.
        input_only: True if the quantity can be specified, but neither tuned by an optimiser nor varied by a
            continuation; its constant can.
    """

    name: str
    text: str
    rule: Rule
    unit: str = ""
    formula: str = ""
    symbol: str = ""
    alias_of: str = ""
    default: str = ""
    advice: str = ""
    input_only: bool = False

    @property
    def constant(self) -> str:
        """Return the constant of the device that the quantity determines."""
        return self.alias_of or self.name

    @property
    def long_name(self) -> str:
        """Return the description with the formula."""
        return f"{self.text}, {self.formula}" if self.formula else self.text

    @property
    def cf_unit(self) -> str:
        """Return the unit in the notation of CF datasets, such as m s-2."""
        # rad/s becomes rad s-1, m/s^2 becomes m s-2; no unit of the table has more than one slash.
        above, _, below = (self.unit or "1").partition("/")
        unit, _, power = below.partition("^")
        return f"{above} {unit}-{power or 1}" if below else above

    @property
    def attributes(self) -> dict[str, str]:
        """Return the attributes of a coordinate of a dataset."""
        return {"units": self.cf_unit, "long_name": self.long_name, "symbol": self.symbol or self.name}

    @property
    def remedy(self) -> str:
        """Return the part of an error that states the remedy for a value out of range."""
        return self.advice or f"it is the {self.text} in {self.unit}"


def _named(*quantities: Quantity) -> dict[str, Quantity]:
    return {quantity.name: quantity for quantity in quantities}


START, START_REACH = (0.05853, -0.47898), 0.49
"""Default start (u0, v0), off the centre of every gap; u0 is at most the fraction START_REACH of d."""

FREE_GAP = 2 / math.pi**2
"""Gap d above which motions without impacts exist at gamma = 0; their amplitude is 1/pi^2."""

# Advice of errors, for values out of range.
_RIGID = 'a rigid wall is wall="rigid" (kappa=None in an ImpactPair)'
_GAP = "it is the free travel of the ball in units of A pi^2/omega^2"
_TRAVEL = "it is the free travel of the ball in m; membranes a distance D apart have s = D - 2 r_b"
_AMPLITUDE = "it is the forcing amplitude in m/s^2; without forcing there is no unit of length"
_GRAVITY = "it is the acceleration of gravity in m/s^2; level ground is beta = 0"
_MIDDLE, _AT_REST = "0 is the middle of the gap", "0 is at rest"
_TILT = "it is the inclination in rad; level ground is beta = 0"

_COMMON = _named(
    Quantity(
        "d",
        "free travel of the ball between the walls",
        _POSITIVE,
        formula="s omega^2 / (A pi^2)",
        alias_of="s",
        advice=_GAP,
    ),
    Quantity(
        "kappa",
        "stiffness of the walls",
        _POSITIVE,
        formula="omega0 pi / omega",
        symbol=r"\kappa",
        alias_of="omega0",
        advice=_RIGID,
    ),
    Quantity(
        "r", "coefficient of restitution of a free contact", _PART, default="0.5", advice="an elastic wall is r = 1"
    ),
    Quantity(
        "gamma",
        "gravity along the axis",
        _FINITE,
        formula="g sin(beta) / A",
        symbol=r"\gamma",
        alias_of="beta",
        default="0",
        advice="level ground is gamma = 0",
    ),
    Quantity(
        "omega",
        "angular frequency of the forcing",
        _POSITIVE,
        "rad/s",
        symbol=r"\omega",
        default="pi",
        advice="it is the forcing frequency in rad/s",
    ),
    Quantity("s", "free travel of the ball between the membranes", _POSITIVE, "m", default="0.3", advice=_TRAVEL),
    Quantity(
        "distance",
        "distance of the membranes",
        _POSITIVE,
        "m",
        formula="s + 2 r_b",
        symbol="D",
        alias_of="s",
        input_only=True,
    ),
    Quantity(
        "omega0",
        "natural frequency of ball and membrane",
        _POSITIVE,
        "rad/s",
        symbol=r"\omega_0",
        default="400",
        advice=_RIGID,
    ),
    Quantity("k", "stiffness of the membrane", _POSITIVE, "N/m", alias_of="omega0", default="560", advice=_RIGID),
    Quantity("A", "amplitude of the forcing", _POSITIVE, "m/s^2", default="1", advice=_AMPLITUDE),
    Quantity("beta", "inclination", _FINITE, "rad", symbol=r"\beta", default="0", advice=_TILT),
)

SIDES = "left", "right"
"""The two walls, at u = -d/2 and u = d/2."""

# Texts of quantities that each wall has separately; {} becomes left or right.
_PER_WALL_TEXTS = {
    "kappa": "stiffness of the {} wall",
    "r": "coefficient of restitution of a free contact with the {} wall",
    "omega0": "natural frequency of ball and {} membrane",
    "k": "stiffness of the {} membrane",
}


def _per_wall(name: str, side: str) -> Quantity:
    # An alias refers to the constant of the same wall: kappa_left determines omega0_left.
    both = _COMMON[name]
    symbol = rf"{both.symbol or name}^\mathrm{{{side}}}"
    alias_of = f"{both.alias_of}_{side}" if both.alias_of else ""
    text = _PER_WALL_TEXTS[name].format(side)
    return replace(both, name=f"{name}_{side}", text=text, symbol=symbol, alias_of=alias_of, default="")


PARAMETERS = _COMMON | _named(*(_per_wall(name, side) for name in _PER_WALL_TEXTS for side in SIDES))
"""Quantities of pair and device that can be axes; per-wall quantities come last."""

STARTS = _named(
    Quantity(
        "u0",
        "displacement at the start",
        _FINITE,
        formula="in units of A pi^2 / omega^2",
        symbol="u_0",
        default=f"min({START[0]}, {START_REACH} d)",
        advice=_MIDDLE,
    ),
    Quantity(
        "v0",
        "velocity at the start",
        _FINITE,
        formula="in units of A pi / omega",
        symbol="v_0",
        default=f"{START[1]}",
        advice=_AT_REST,
    ),
)
"""Initial displacement and velocity of a cell."""

AXES = PARAMETERS | STARTS
"""The axes of a sweep."""

QUANTITIES = AXES | _named(
    Quantity("m_b", "mass of the ball", _POSITIVE, "kg"),
    Quantity("g", "acceleration of gravity", _POSITIVE, "m/s^2", advice=_GRAVITY),
    Quantity("w0", "thickness of the membrane", _POSITIVE, "m"),
    Quantity("R0", "radius of the membrane", _POSITIVE, "m"),
    Quantity("eps_M", "permittivity of the membrane", _POSITIVE, "F/m"),
    Quantity("C_T", "transfer capacitance", _NOT_NEGATIVE, "F"),
    Quantity("V", "voltage", _FINITE, "V"),
    Quantity("r_b", "radius of the ball", _POSITIVE, "m"),
    Quantity(
        "penetration_limit",
        "largest admissible penetration",
        _LIMIT,
        "m",
        advice="leave it out for R0, or give inf for no limit",
    ),
    Quantity(
        "energy_ratio_limit",
        "largest admissible ratio of the energy that an impact yields to the energy that it gives to the membrane",
        _PART,
        advice="1 admits all energy that the impact gives",
    ),
)
"""All quantities that can be specified: the axes, and the other constants and limits of the device."""

ARGUMENT_QUANTITIES = QUANTITIES | _named(
    Quantity("acceleration", "acceleration of the capsule", _FINITE, "m/s^2"),
    Quantity("damping", "damping over stiffness of a contact", _NOT_NEGATIVE, "s/m"),
    Quantity("angle", "phase of a harmonic", _FINITE, "rad"),
    Quantity("depth", "penetration of the membrane", _REAL, "m"),
    Quantity("length", "length", _POSITIVE, "m"),
    Quantity("displacement", "displacement", _FINITE, formula="in units of A pi^2 / omega^2", advice=_MIDDLE),
    Quantity("friction_coefficient", "coefficient of dry friction", _NOT_NEGATIVE, advice="no friction is 0"),
    Quantity("phase", "time", _FINITE, formula="in half forcing periods, pi / omega", advice="0 is phase 0"),
    Quantity("speed", "speed of an impact", _FINITE, "m/s"),
    Quantity("time", "time", _FINITE, "s"),
    Quantity("velocity", "velocity", _FINITE, formula="in units of A pi / omega", advice=_AT_REST),
)
"""All quantities that an argument of a public function can have, whatever the name of the argument."""


def synonyms(name: str) -> tuple[str, ...]:
    """Return the axes that determine the same constant as `name`, itself included: kappa, omega0 and k."""
    return tuple(synonym for synonym, axis in AXES.items() if axis.constant == AXES[name].constant)


def split_wall(name: str) -> tuple[str, str]:
    """Split a per-wall name: ("kappa", "left") for kappa_left; ("d", "") for a quantity of both walls."""
    base, _, side = name.rpartition("_")
    # Only the endings left and right name a wall: eps_M and penetration_limit keep their underscores.
    return (base, side) if side in SIDES else (name, "")


def without_wall(name: str) -> str:
    """Return the name without the wall: kappa for kappa_left and for kappa."""
    return split_wall(name)[0]


def both_walls_name(name: str) -> str:
    """Return the axis of both walls for a per-wall axis; "" for any other axis."""
    return without_wall(name) if split_wall(name)[1] else ""


def check(name: str, value: Any, argument: str | None = None) -> None:
    """Raise ValueError unless every element of `value` is in the range of quantity `name`; traced values pass.

    Args:
        name: Name of the quantity.
        value: A number or an array.
        argument: Name that an error uses; default is `name`.

    Raises:
        ValueError: "r must lie in (0, 1]; got -0.2 at index (3, 7); an elastic wall is r = 1".

    Warns:
        UserWarning: For an inclination beyond pi/2, which suggests degrees instead of rad.
    """
    import numpy as np  # not at the top: importing the table must not load NumPy

    from vijax.runtime import validation

    if not validation.is_concrete(value):
        return
    quantity, called = ARGUMENT_QUANTITIES[name], argument or name
    array = validation.validate_numbers(called, value, quantity.remedy)
    # Rules are False for NaN, so that NaN is reported as a value out of range.
    good = quantity.rule.holds(array)
    if not np.all(good):
        raise ValueError(
            f"{called} {quantity.rule.must}; got {validation.first_invalid(array, good)}; {quantity.remedy}"
        )
    # Inclinations are periodic, hence valid; only the likely mistake is reported.
    if name == "beta" and (steepest := np.abs(array).max()) > 0.5 * math.pi:
        advice = "20 degrees are 20deg on the command line, and numpy.deg2rad(20) in Python"
        warnings.warn(f"{called} is up to {steepest:.6g} rad, which is beyond pi/2; {advice}", stacklevel=2)


# --- results -------------------------------------------------------------------------------------------------------


class ResultQuantity(NamedTuple):
    """A result quantity of impacts and orbits.

    Attributes:
        units: Unit, in the notation of datasets.
        text: Description, for datasets.
        label: Axis label of a picture.
    """

    units: str
    text: str
    label: str = ""

    @property
    def attributes(self) -> dict[str, str]:
        """Return the attributes of a variable of a dataset."""
        return {"units": self.units, "long_name": self.text}


RESULT_QUANTITIES = {
    "v_in": ResultQuantity(
        "1", "velocity at the onset, in units of A pi / omega", r"$v_\mathrm{in}$, velocity at the impact"
    ),
    "v_out": ResultQuantity(
        "1", "velocity at the exit, in units of A pi / omega", r"$v_\mathrm{out}$, velocity after the impact"
    ),
    "restitution": ResultQuantity("1", "-v_out / v_in", r"$-v_\mathrm{out} / v_\mathrm{in}$, effective restitution"),
    "phase": ResultQuantity(
        "1", "phase of the onset, in half forcing periods", "phase of the impact [half forcing periods]"
    ),
    "duration": ResultQuantity(
        "1", "duration of the contact, in half forcing periods", "duration of the contact [half forcing periods]"
    ),
    "depth": ResultQuantity("m", "penetration of the membrane", "penetration [m]"),
    "E": ResultQuantity("J", "energy harvested from the impact", r"$E_j$, energy of the impact [J]"),
    "P": ResultQuantity("J", "energy harvested per half forcing period", "$P$ [J per half period]"),
    "u_strobe": ResultQuantity("1", "displacement at phase 0, in units of A pi^2 / omega^2", "$u$ at phase 0"),
    "v_strobe": ResultQuantity("1", "velocity at phase 0, in units of A pi / omega", r"$\dot{u}$ at phase 0"),
    "multiplier": ResultQuantity("1", "largest modulus of a Floquet multiplier", "largest modulus of a multiplier"),
    "side": ResultQuantity("1", "wall: -1 left, 1 right"),
}
POINT_QUANTITIES = ("v_in", "v_out", "restitution", "phase", "duration", "depth", "E", "P", "u_strobe", "v_strobe")
"""Quantities that a picture of an orbit diagram can show."""
BRANCH_QUANTITIES = ("v_in", "phase", "duration", "depth", "P", "multiplier")
"""Quantities that a picture of branches can show."""
