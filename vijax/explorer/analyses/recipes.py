"""Commands and Python code that reproduce a panel, for the user to copy."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vijax.explorer.analyses import basin, branch, line, motion, optimum
from vijax.explorer.analyses.motion import CellMotion
from vijax.explorer.export import map_function
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.source import Source
from vijax.explorer.view import View
from vijax.maps.sweep_settings import SPEED
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.quantities import AXES, SIDES, split_wall
from vijax.model.walls.sides import Sides, values_by_name

_DEVICE = Harvester()
# Argument values that a call may omit, because they are the values of the default device.
_DEFAULTS = {"gamma": 0.0} | {name: float(getattr(_DEVICE, name)) for name in ("r", "omega", "A")}
_DEFAULTS |= {"r_left": _DEFAULTS["r"], "r_right": _DEFAULTS["r"]}


@dataclass(frozen=True)
class Recipe:
    """Code that reproduces a panel.

    Attributes:
        command: A shell command; "" if no command can reproduce the panel.
        python: Lines of Python.
    """

    command: str
    python: str


@dataclass(frozen=True)
class _Run:
    """Arguments, settings and device of a `sweep` call; the fields have the names of the fields of `ExploredCell`."""

    arguments: dict[str, Any]
    settings: dict[str, Any]
    device: Harvester


def non_default(arguments: Mapping[str, float]) -> dict[str, float]:
    """Return the arguments with values that differ from the default device."""
    return {name: value for name, value in arguments.items() if value != _DEFAULTS.get(name)}


def _constants(cell: ExploredCell | _Run) -> dict[str, float]:
    """Return the constants that differ from the device of Tables I and II and that are no axis of `sweep`.

    A constant that differs between the walls has one name per wall, such as V_left.
    """
    constants: dict[str, float] = {}
    for name in CONSTANTS:
        if name not in AXES:
            per_wall = values_by_name(name, getattr(cell.device, name)).items()
            constants |= {argument: float(value) for argument, value in per_wall if value != getattr(_DEVICE, name)}
    if cell.device.penetration_limit is not None:
        constants["penetration_limit"] = float(cell.device.penetration_limit)
    if cell.device.energy_ratio_limit != _DEVICE.energy_ratio_limit:
        constants["energy_ratio_limit"] = float(cell.device.energy_ratio_limit)
    return constants


def _device(constants: Mapping[str, float]) -> str:
    """Return the Python call that makes the device of Tables I and II with some constants replaced."""
    argument_texts: dict[str, str] = {}
    for name, value in constants.items():
        field, side = split_wall(name)
        if not side:
            argument_texts[name] = repr(value)
        elif field not in argument_texts:
            both = (constants.get(f"{field}_{wall}", getattr(_DEVICE, field)) for wall in SIDES)
            argument_texts[field] = f"vijax.Sides({', '.join(map(repr, both))})"
    return f"vijax.Harvester({', '.join(f'{name}={text}' for name, text in argument_texts.items())})"


def _device_constants(device: Harvester, names: tuple[str, ...]) -> dict[str, float]:
    """Return constants of a device by name; a constant that differs between the walls has a name per wall, V_left."""
    per_constant = (values_by_name(name, getattr(device, name)) for name in names)
    return {argument: float(value) for per_wall in per_constant for argument, value in per_wall.items()}


def _keyword_arguments(arguments: Mapping[str, Any]) -> str:
    """Return the text of keyword arguments."""
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())


def _options(cell: ExploredCell | _Run, without: tuple[str, ...] = ()) -> str:
    words = [
        f"--{name}={value!r}" if value < 0 else f"--{name} {value!r}"
        for name, value in non_default(cell.arguments).items()
        if name not in without
    ]
    words += [f"--{name} {value}" for name, value in cell.settings.items()]
    words += [f"--set {name}={value!r}" for name, value in _constants(cell).items()]
    return " ".join(words)


def _arguments(cell: ExploredCell | _Run, without: tuple[str, ...] = ()) -> str:
    values: dict[str, Any] = {name: value for name, value in non_default(cell.arguments).items() if name not in without}
    parts = [f"{name}={value!r}" for name, value in (values | cell.settings).items() if name not in without]
    if constants := _constants(cell):
        parts.append(f"device={_device(constants)}")
    return ", ".join(parts)


def _number(value: Any) -> str:
    """Return the Python text of a field of a pair: a number, None, or `Sides` of the two walls' numbers."""
    if isinstance(value, Sides):
        return f"vijax.Sides({_number(value.left)}, {_number(value.right)})"
    return repr(None if value is None else float(value))


def of_motion(cell: ExploredCell, cell_motion: CellMotion) -> Recipe:
    """Return the code that computes a motion, its label, P and multipliers."""
    pair = cell.pair
    r = cell.r
    point = f"along={r!r}, values=[{cell.arguments[r]!r}], direction='up', periods={motion.SETTLE}, recorded_periods=1"
    lines = [
        "import vijax",
        f"result = vijax.sweep({_arguments(cell)})",
        f"pair = vijax.impact_pair({', '.join(map(_number, (pair.d, pair.kappa, pair.r, pair.gamma)))})",
        f"end = vijax.orbit_diagram({point}, {_arguments(cell, (r, 'periods'))}).isel({r}=0, strobe=-1)",
    ]
    if cell_motion.orbit is not None:
        period = int(cell_motion.numbers["period"])
        lines.append(f"orbit = vijax.orbits_from_states(pair, end.u_strobe, end.v_strobe, period={period})")
        lines.append("vijax.orbit_labels(orbit), orbit.multipliers")
    return Recipe(f"vijax sweep {_options(cell)}", "\n".join(lines))


def of_line(cell: ExploredCell, axis: Axis) -> Recipe:
    """Return the code that computes the orbit diagram along an axis through a cell."""
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
    """Return the command options that specify a cell, without the arguments and settings named in `without`."""
    settings = {name: value for name, value in cell.settings.items() if name not in without}
    return _options(_Run(cell.arguments, settings, cell.device), without)


def of_basin(cell: ExploredCell) -> Recipe:
    """Return the code that computes the basins of a cell."""
    starts = ("u0", "v0")
    return Recipe(
        f"vijax basins {_options(cell, starts)} --v0=-{SPEED!r}:{SPEED!r}:{basin.SIDE}",
        "import numpy as np\nimport vijax\n"
        f"vijax.basins(v0=np.linspace(-{SPEED!r}, {SPEED!r}, {basin.SIDE}), {_arguments(cell, starts)})",
    )


def of_branch(cell: ExploredCell, cell_motion: CellMotion, axis: Axis) -> Recipe:
    """Return the code that computes the branch through a cell: the lines of `of_motion`, then the continuation."""
    low, high = float(axis.values[0]), float(axis.values[-1])
    branch_lines = (
        f"device = {_device(_device_constants(cell.device, ('A', 'omega', 'omega0')) | _constants(cell))}\n"
        f"branches = vijax.follow_families(orbit, {axis.name!r}, ({low!r}, {high!r}), device=device, "
        f"max_switches={branch.MOST_SWITCHES}, points={branch.MOST_POINTS}, "
        f"settings=vijax.ContinuationSettings(max_grazings={branch.MOST_GRAZINGS}))"
    )
    return Recipe("", f"{of_motion(cell, cell_motion).python}\n{branch_lines}")


def of_optimum(cell: ExploredCell, axis: Axis) -> Recipe:
    """Return the code that computes the optima near a cell along an axis."""
    low, high = float(axis.values[0]), float(axis.values[-1])
    constants = _device_constants(cell.device, ("s", "omega0", "r", "A", "omega", "beta")) | _constants(cell)
    options = " ".join(
        f"--{name} {value!r}" if name in AXES else f"--set {name}={value!r}" for name, value in constants.items()
    )
    words = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in optimum.EFFORT.items())
    return Recipe(
        f"vijax design {options} --tune {axis.name} --bounds {axis.name}={low!r}:{high!r} {words}",
        f"import vijax\nvijax.optimise({_device(constants)}, tune={axis.name!r}, "
        f"bounds={{{axis.name!r}: ({low!r}, {high!r})}}, {_keyword_arguments(optimum.EFFORT)})",
    )


def of_map(source: Source, plane: ExploredPlane, page_view: View, recomputed: bool, curves: bool) -> Recipe:
    """Return the code that draws the picture of a map.

    The code reads the map from its store or, if the page has computed the map or there is no store, runs `sweep`.

    Args:
        source: Source of the map and its curves.
        plane: The map.
        page_view: The view of the map.
        recomputed: Whether the page has computed the map at other values of the sliders.
        curves: Whether curves are drawn over the map.
    """
    further = {name: float(plane.further[name][index]) for name, index in plane.slices(page_view.values).items()}
    run = _Run(plane.arguments((0, 0), further), plane.settings(), plane.device)
    axes, path = (plane.x, plane.y), None if recomputed else source.path
    name, even = page_view.variable, all(axis.even for axis in axes)
    spans = " ".join(f"--{axis.name} {_span(axis)}" for axis in axes)
    words = " ".join(filter(None, (spans, _options(run, (plane.x.name, plane.y.name)))))
    if curves:
        words = f"--map {shlex.quote(str(path))}" if path and not further else words
        picture = f"--ground {name} --unstable" if page_view.curves == "unstable" else f"--ground {name}"
        command = f"vijax curves {words} {picture} --plot map.png"
    else:
        command = f"vijax sweep {words} --show {name} --plot map.png"
    if not even and not (curves and path and not further):
        command = ""  # no command option expresses unevenly spaced values
    lines = ["import vijax", *_dataset(path, plane, run, further)]
    if curves:
        lines += [
            _curves(source),
            _save_line("curves", f"curves, dataset, ground={name!r}", page_view.curves == "unstable"),
        ]
    else:
        function = map_function(plane.dataset, name)
        lines.append(_save_line(function, f"dataset, {name!r}" if function == "variable_map" else "dataset", False))
    return Recipe(command, "\n".join(lines))


def _dataset(path: Path | None, plane: ExploredPlane, run: _Run, further: Mapping[str, float]) -> list[str]:
    """Return the Python lines that load or compute the dataset of a map, at the shown values of further axes."""
    if path is not None:
        selection = ", ".join(f"{name}={value!r}" for name, value in further.items())
        return [f"dataset = vijax.load({str(path)!r})" + (f".sel({selection})" if selection else "")]
    spaces = ", ".join(f"{axis.name}={_space(axis)}" for axis in (plane.x, plane.y))
    rest = _arguments(run, (plane.x.name, plane.y.name))
    return ["import numpy as np", f"dataset = vijax.sweep({', '.join(filter(None, (spaces, rest)))})"]


def _curves(source: Source) -> str:
    """Return the Python line that loads the curves from their store or, without a store, computes them."""
    if source.curves is not None and source.curves.path is not None:
        return f"curves = vijax.load({str(source.curves.path)!r})"
    return "curves = vijax.curve_dataset(vijax.bifurcation_curves(dataset))"


def _save_line(function: str, arguments: str, unstable: bool) -> str:
    return f"vijax.plots.save(vijax.plots.{function}({arguments}{', unstable=True' if unstable else ''}), 'map.png')"


def _span(axis: Axis) -> str:
    """Return the value of a command option for the values of an axis: LO:HI:N or LO:HI:N:log."""
    log = ":log" if axis.scale == "log" else ""
    return f"{float(axis.values[0])!r}:{float(axis.values[-1])!r}:{axis.values.size}{log}"


def _space(axis: Axis) -> str:
    """Return a Python expression for the values of an axis: linspace, geomspace or, if uneven, a list of the values."""
    if not axis.even:
        return f"np.array({axis.values.tolist()})"
    space = "geomspace" if axis.scale == "log" else "linspace"
    return f"np.{space}({float(axis.values[0])!r}, {float(axis.values[-1])!r}, {axis.values.size})"
