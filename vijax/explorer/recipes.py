"""The command and the Python lines that reproduce a panel, to copy."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vijax.explorer import basin, branch, line, motion, optimum
from vijax.explorer.export import map_function
from vijax.explorer.motion import CellMotion
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.source import Source
from vijax.explorer.view import View
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.quantities import AXES, SIDES, parted
from vijax.model.sides import Sides, named
from vijax.planes.sweep_settings import SPEED

_DEVICE = Harvester()
# Axes that need not be told where they are the device's own.
_USUAL = {"gamma": 0.0} | {name: float(getattr(_DEVICE, name)) for name in ("r", "omega", "A")}
_USUAL |= {"r_left": _USUAL["r"], "r_right": _USUAL["r"]}


@dataclass(frozen=True)
class Recipe:
    """How a panel is had again.

    Attributes:
        command: A line for a shell; "" where the command has no such page.
        python: Lines of Python.
    """

    command: str
    python: str


@dataclass(frozen=True)
class _Run:
    """What a call of `sweep` is told: axes, settings and the device, as an `ExploredCell` has them."""

    arguments: dict[str, Any]
    settings: dict[str, Any]
    device: Harvester


def told(arguments: Mapping[str, float]) -> dict[str, float]:
    """Leave out what a device has unless it is told otherwise."""
    return {name: value for name, value in arguments.items() if value != _USUAL.get(name)}


def _constants(cell: ExploredCell | _Run) -> dict[str, float]:
    """Name the constants that differ from those of Tables I and II, other than those that axes stand for.

    What a wall has of its own is under a name of its own, such as V_left.
    """
    found: dict[str, float] = {}
    for name in CONSTANTS:
        if name not in AXES:
            own = named(name, getattr(cell.device, name)).items()
            found |= {argument: float(value) for argument, value in own if value != getattr(_DEVICE, name)}
    if cell.device.penetration_limit is not None:
        found["penetration_limit"] = float(cell.device.penetration_limit)
    if cell.device.energy_ratio_limit != _DEVICE.energy_ratio_limit:
        found["energy_ratio_limit"] = float(cell.device.energy_ratio_limit)
    return found


def _device(constants: Mapping[str, float]) -> str:
    """Write the call that makes the device of Tables I and II with other constants."""
    given: dict[str, str] = {}
    for name, value in constants.items():
        field, side = parted(name)
        if not side:
            given[name] = repr(value)
        elif field not in given:
            both = (constants.get(f"{field}_{one}", getattr(_DEVICE, field)) for one in SIDES)
            given[field] = f"vijax.Sides({', '.join(map(repr, both))})"
    return f"vijax.Harvester({', '.join(f'{name}={text}' for name, text in given.items())})"


def _told(device: Harvester, names: tuple[str, ...]) -> dict[str, float]:
    """Name some constants of a device, of walls that differ those of each."""
    told = (named(name, getattr(device, name)) for name in names)
    return {argument: float(value) for own in told for argument, value in own.items()}


def _named(arguments: Mapping[str, Any]) -> str:
    """Write named arguments of a call."""
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())


def _options(cell: ExploredCell | _Run, without: tuple[str, ...] = ()) -> str:
    words = [
        f"--{name}={value!r}" if value < 0 else f"--{name} {value!r}"
        for name, value in told(cell.arguments).items()
        if name not in without
    ]
    words += [f"--{name} {value}" for name, value in cell.settings.items()]
    words += [f"--set {name}={value!r}" for name, value in _constants(cell).items()]
    return " ".join(words)


def _arguments(cell: ExploredCell | _Run, without: tuple[str, ...] = ()) -> str:
    given: dict[str, Any] = {name: value for name, value in told(cell.arguments).items() if name not in without}
    parts = [f"{name}={value!r}" for name, value in (given | cell.settings).items() if name not in without]
    if constants := _constants(cell):
        parts.append(f"device={_device(constants)}")
    return ", ".join(parts)


def _number(value: Any) -> str:
    """Write a number of a pair, or what each wall has."""
    if isinstance(value, Sides):
        return f"vijax.Sides({_number(value.left)}, {_number(value.right)})"
    return repr(None if value is None else float(value))


def of_motion(cell: ExploredCell, found: CellMotion) -> Recipe:
    """Say how a motion, its label, P and multipliers are had."""
    pair = cell.pair
    r = cell.r
    point = f"along={r!r}, values=[{cell.arguments[r]!r}], direction='up', periods={motion.SETTLE}, recorded_periods=1"
    lines = [
        "import vijax",
        f"found = vijax.sweep({_arguments(cell)})",
        f"pair = vijax.impact_pair({', '.join(map(_number, (pair.d, pair.kappa, pair.r, pair.gamma)))})",
        f"end = vijax.orbit_diagram({point}, {_arguments(cell, (r, 'periods'))}).isel({r}=0, strobe=-1)",
    ]
    if found.orbit is not None:
        period = int(found.numbers["period"])
        lines.append(f"orbit = vijax.orbits_from_states(pair, end.u_strobe, end.v_strobe, period={period})")
        lines.append("vijax.orbit_labels(orbit), orbit.multipliers")
    return Recipe(f"vijax sweep {_options(cell)}", "\n".join(lines))


def of_line(cell: ExploredCell, axis: Axis) -> Recipe:
    """Say how a line through a cell is had."""
    low, high, count = float(axis.values[0]), float(axis.values[-1]), line.POINTS
    log, space = (":log", "geomspace") if axis.scale == "log" else ("", "linspace")
    others = (axis.name, "periods")
    settings = f"direction='both', periods={line.PERIODS}, recorded_periods={line.RECORDED}"
    return Recipe(
        f"vijax orbit-diagram --along {axis.name}={low!r}:{high!r}:{count}{log} --direction both "
        f"--periods {line.PERIODS} --recorded-periods {line.RECORDED} {_options_of(cell, others)}",
        "import numpy as np\nimport vijax\n"
        f"vijax.orbit_diagram(along={axis.name!r}, values=np.{space}({low!r}, {high!r}, {count}), {settings}, "
        f"{_arguments(cell, others)})",
    )


def _options_of(cell: ExploredCell, without: tuple[str, ...]) -> str:
    """Write the options of a cell without some, settings among them."""
    kept = {name: value for name, value in cell.settings.items() if name not in without}
    return _options(_Run(cell.arguments, kept, cell.device), without)


def of_basin(cell: ExploredCell) -> Recipe:
    """Say how the basins of a cell are had."""
    starts = ("u0", "v0")
    return Recipe(
        f"vijax basins {_options(cell, starts)} --v0=-{SPEED!r}:{SPEED!r}:{basin.SIDE}",
        "import numpy as np\nimport vijax\n"
        f"vijax.basins(v0=np.linspace(-{SPEED!r}, {SPEED!r}, {basin.SIDE}), {_arguments(cell, starts)})",
    )


def of_branch(cell: ExploredCell, found: CellMotion, axis: Axis) -> Recipe:
    """Say how the branch through a cell is had; its lines go on from those of the motion."""
    low, high = float(axis.values[0]), float(axis.values[-1])
    more = (
        f"device = {_device(_told(cell.device, ('A', 'omega', 'omega0')) | _constants(cell))}\n"
        f"branches = vijax.follow_families(orbit, {axis.name!r}, ({low!r}, {high!r}), device=device, "
        f"max_switches={branch.MOST_SWITCHES}, points={branch.MOST_POINTS}, "
        f"settings=vijax.ContinuationSettings(max_grazings={branch.MOST_GRAZINGS}))"
    )
    return Recipe("", f"{of_motion(cell, found).python}\n{more}")


def of_optimum(cell: ExploredCell, axis: Axis) -> Recipe:
    """Say how the optima near a cell are had."""
    low, high = float(axis.values[0]), float(axis.values[-1])
    constants = _told(cell.device, ("s", "omega0", "r", "A", "omega", "beta")) | _constants(cell)
    options = " ".join(
        f"--{name} {value!r}" if name in AXES else f"--set {name}={value!r}" for name, value in constants.items()
    )
    words = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in optimum.EFFORT.items())
    return Recipe(
        f"vijax design {options} --tune {axis.name} --bounds {axis.name}={low!r}:{high!r} {words}",
        f"import vijax\nvijax.optimise({_device(constants)}, tune={axis.name!r}, "
        f"bounds={{{axis.name!r}: ({low!r}, {high!r})}}, {_named(optimum.EFFORT)})",
    )


def of_map(source: Source, plane: ExploredPlane, shown: View, made: bool, curves: bool) -> Recipe:
    """Say how the picture of a map is had: that of its store, or run anew where the page has made it.

    Args:
        source: Where the map and its curves come from.
        plane: The map.
        shown: What the page shows of it.
        made: Whether the page has made it.
        curves: Whether curves are drawn over it.
    """
    further = {name: float(plane.further[name][at]) for name, at in plane.slices(shown.values).items()}
    run = _Run(plane.arguments((0, 0), further), plane.settings(), plane.device)
    axes, path = (plane.x, plane.y), None if made else source.path
    name, even = shown.variable, all(axis.even for axis in axes)
    spans = " ".join(f"--{axis.name} {_span(axis)}" for axis in axes)
    words = " ".join(filter(None, (spans, _options(run, (plane.x.name, plane.y.name)))))
    if curves:
        words = f"--map {shlex.quote(str(path))}" if path and not further else words
        picture = f"--ground {name} --unstable" if shown.curves == "unstable" else f"--ground {name}"
        command = f"vijax curves {words} {picture} --plot map.png"
    else:
        command = f"vijax sweep {words} --show {name} --plot map.png"
    if not even and not (curves and path and not further):
        command = ""  # no option of the command says such values
    lines = ["import vijax", *_dataset(path, plane, run, further)]
    if curves:
        lines += [_curves(source), _drawn("curves", f"curves, dataset, ground={name!r}", shown.curves == "unstable")]
    else:
        function = map_function(plane.dataset, name)
        lines.append(_drawn(function, f"dataset, {name!r}" if function == "variable_map" else "dataset", False))
    return Recipe(command, "\n".join(lines))


def _dataset(path: Path | None, plane: ExploredPlane, run: _Run, further: Mapping[str, float]) -> list[str]:
    """Write the lines that give a map, what is shown of it alone."""
    if path is not None:
        place = ", ".join(f"{name}={value!r}" for name, value in further.items())
        return [f"dataset = vijax.load({str(path)!r})" + (f".sel({place})" if place else "")]
    spaces = ", ".join(f"{axis.name}={_space(axis)}" for axis in (plane.x, plane.y))
    rest = _arguments(run, (plane.x.name, plane.y.name))
    return ["import numpy as np", f"dataset = vijax.sweep({', '.join(filter(None, (spaces, rest)))})"]


def _curves(source: Source) -> str:
    """Write the line that gives the curves of a map."""
    if source.curves is not None and source.curves.path is not None:
        return f"curves = vijax.load({str(source.curves.path)!r})"
    return "curves = vijax.curve_dataset(vijax.bifurcation_curves(dataset))"


def _drawn(function: str, given: str, unstable: bool) -> str:
    return f"vijax.plots.save(vijax.plots.{function}({given}{', unstable=True' if unstable else ''}), 'map.png')"


def _span(axis: Axis) -> str:
    """Write an axis as an option has it."""
    log = ":log" if axis.scale == "log" else ""
    return f"{float(axis.values[0])!r}:{float(axis.values[-1])!r}:{axis.values.size}{log}"


def _space(axis: Axis) -> str:
    """Write an axis as Python has it; one that is not evenly spaced by all its values."""
    if not axis.even:
        return f"np.array({axis.values.tolist()})"
    space = "geomspace" if axis.scale == "log" else "linspace"
    return f"np.{space}({float(axis.values[0])!r}, {float(axis.values[-1])!r}, {axis.values.size})"
