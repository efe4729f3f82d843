"""What every quantity is called, what it is in and what its values must be: the one table that all others read.

Begin with `AXES`. Nothing here loads JAX or NumPy until a value is checked, so that help of the command can tell at
once what its options are.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """What values of a quantity must be, in code, elementwise and false of NaN, and in words."""

    holds: Callable[[Any], Any]
    must: str


_POSITIVE = Rule(lambda x: (x > 0) & (x < math.inf), "must be positive and finite")
_FINITE = Rule(lambda x: abs(x) < math.inf, "must be finite")
_NOT_NEGATIVE = Rule(lambda x: (x >= 0) & (x < math.inf), "must be finite and not negative")
_LIMIT = Rule(lambda x: x > 0, "must be positive")
_REAL = Rule(lambda x: (x == x) | (x != x), "must be a real number")
_PART = Rule(lambda x: (x > 0) & (x <= 1), "must lie in (0, 1]")


@dataclass(frozen=True)
class Quantity:
    """A quantity that may be given: of the pair, of the device, or of the start.

    Attributes:
        name: What arguments, fields and options call it.
        text: What it is.
        rule: What its values must be.
        unit: What plain numbers of it are in, in SI; "" for a pure number.
        formula: How a pure number follows from the device, or what it is in units of.
        symbol: In TeX; its name unless given.
        alias_of: The constant of the device that it is another name for.
        default: What it is unless given, as the command would take it or in words.
        advice: What to do about values that it cannot have, unless to say what it is will do.
        given_only: Whether it may be given, but is neither tuned nor followed along, as its constant is.
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
    given_only: bool = False

    @property
    def constant(self) -> str:
        """Name the constant of the device that it decides."""
        return self.alias_of or self.name

    @property
    def long_name(self) -> str:
        """Say what it is, with the formula."""
        return f"{self.text}, {self.formula}" if self.formula else self.text

    @property
    def cf(self) -> str:
        """Write the unit as datasets do: m s-2."""
        above, _, below = (self.unit or "1").partition("/")
        unit, _, power = below.partition("^")
        return f"{above} {unit}-{power or 1}" if below else above

    @property
    def attributes(self) -> dict[str, str]:
        """Name the attributes of a coordinate of a dataset."""
        return {"units": self.cf, "long_name": self.long_name, "symbol": self.symbol or self.name}

    @property
    def remedy(self) -> str:
        """Say, as an error does, what to do about a value that it cannot have."""
        return self.advice or f"it is the {self.text} in {self.unit}"


def _named(*quantities: Quantity) -> dict[str, Quantity]:
    return {quantity.name: quantity for quantity in quantities}


START, START_REACH = (0.05853, -0.47898), 0.49
"""The start unless given, u0 and v0, off the centre of every gap; the displacement is at most this part of the gap."""

FREE_GAP = 2 / math.pi**2
"""Gap d above which a ball on level ground may fly for ever without an impact, with amplitude 1/pi^2."""

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
        given_only=True,
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

_OF_ONE_WALL = {
    "kappa": "stiffness of the {} wall",
    "r": "coefficient of restitution of a free contact with the {} wall",
    "omega0": "natural frequency of ball and {} membrane",
    "k": "stiffness of the {} membrane",
}


def _of_one_wall(name: str, side: str) -> Quantity:
    whole = _COMMON[name]
    symbol = rf"{whole.symbol or name}^\mathrm{{{side}}}"
    alias_of = f"{whole.alias_of}_{side}" if whole.alias_of else ""
    text = _OF_ONE_WALL[name].format(side)
    return replace(whole, name=f"{name}_{side}", text=text, symbol=symbol, alias_of=alias_of, default="")


PARAMETERS = _COMMON | _named(*(_of_one_wall(name, side) for name in _OF_ONE_WALL for side in SIDES))
"""What of pair and device may be an axis; what each wall has of its own last."""

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
"""Where the motion of a cell begins."""

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
"""All that may be given by value: the axes, and the constants of the device that are none."""

GIVEN = QUANTITIES | _named(
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
"""All quantities that an argument of a public function may be, whatever the argument is called."""


def synonyms(name: str) -> tuple[str, ...]:
    """Find the axes that decide the same as one does, itself among them: kappa, omega0 and k."""
    return tuple(one for one, axis in AXES.items() if axis.constant == AXES[name].constant)


def parted(name: str) -> tuple[str, str]:
    """Part the name of what one wall has: ("kappa", "left"); ("d", "") of what both walls share."""
    whole, _, side = name.rpartition("_")
    return (whole, side) if side in SIDES else (name, "")


def whole(name: str) -> str:
    """Name a quantity without the wall that it is of: kappa for kappa_left and for kappa."""
    return parted(name)[0]


def of_both_walls(name: str) -> str:
    """Name the axis that gives both walls what this one gives one of them; "" for an axis of the whole."""
    return whole(name) if parted(name)[1] else ""


def check(name: str, value: Any, argument: str | None = None) -> None:
    """Raise unless every element of `value` may be the quantity `name`; traced values pass unseen.

    Args:
        name: Of the quantity.
        value: A number or an array.
        argument: What an error speaks of, unless it is called as the quantity is.

    Raises:
        ValueError: "r must lie in (0, 1]; got -0.2 at index (3, 7); an elastic wall is r = 1".

    Warns:
        UserWarning: An inclination beyond pi/2, as degrees taken for rad.
    """
    import numpy as np  # here, as the table must not load it

    from vijax.runtime import checks

    if not checks.is_concrete(value):
        return
    quantity, called = GIVEN[name], argument or name
    array = checks.numbers(called, value, quantity.remedy)
    good = quantity.rule.holds(array)
    if not np.all(good):
        raise ValueError(f"{called} {quantity.rule.must}; got {checks.first(array, good)}; {quantity.remedy}")
    if name == "beta" and (steepest := np.abs(array).max()) > 0.5 * math.pi:
        advice = "20 degrees are 20deg on the command line, and numpy.deg2rad(20) in Python"
        warnings.warn(f"{called} is up to {steepest:.6g} rad, which is beyond pi/2; {advice}", stacklevel=2)


# --- what is measured ------------------------------------------------------------------------------------------------


class Measured(NamedTuple):
    """What is measured of impacts and orbits, whatever records it.

    Attributes:
        units: As datasets write them.
        text: What it is, for datasets.
        label: What a picture writes at its axis.
    """

    units: str
    text: str
    label: str = ""

    @property
    def attributes(self) -> dict[str, str]:
        """Name the attributes of a variable of a dataset."""
        return {"units": self.units, "long_name": self.text}


MEASURED = {
    "v_in": Measured(
        "1", "velocity at the onset, in units of A pi / omega", r"$v_\mathrm{in}$, velocity at the impact"
    ),
    "v_out": Measured(
        "1", "velocity at the exit, in units of A pi / omega", r"$v_\mathrm{out}$, velocity after the impact"
    ),
    "restitution": Measured("1", "-v_out / v_in", r"$-v_\mathrm{out} / v_\mathrm{in}$, effective restitution"),
    "phase": Measured("1", "phase of the onset, in half forcing periods", "phase of the impact [half forcing periods]"),
    "duration": Measured(
        "1", "duration of the contact, in half forcing periods", "duration of the contact [half forcing periods]"
    ),
    "depth": Measured("m", "penetration of the membrane", "penetration [m]"),
    "E": Measured("J", "energy harvested from the impact", r"$E_j$, energy of the impact [J]"),
    "P": Measured("J", "energy harvested per half forcing period", "$P$ [J per half period]"),
    "u_strobe": Measured("1", "displacement at phase 0, in units of A pi^2 / omega^2", "$u$ at phase 0"),
    "v_strobe": Measured("1", "velocity at phase 0, in units of A pi / omega", r"$\dot{u}$ at phase 0"),
    "multiplier": Measured("1", "largest modulus of a Floquet multiplier", "largest modulus of a multiplier"),
    "side": Measured("1", "wall: -1 left, 1 right"),
}
POINT_QUANTITIES = ("v_in", "v_out", "restitution", "phase", "duration", "depth", "E", "P", "u_strobe", "v_strobe")
"""What a picture of an orbit diagram may show."""
BRANCH_QUANTITIES = ("v_in", "phase", "duration", "depth", "P", "multiplier")
"""What a picture of branches may show."""
