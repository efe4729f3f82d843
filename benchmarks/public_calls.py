"""One valid call of every public function, record and method; tests and benchmarks change one argument of it.

`calls` is complete, as a test compares it with `vijax.__all__` and `vijax.plots.__all__`: a new parameter of a public
function needs an entry here, and is tested from then on.
"""

import inspect
from collections.abc import Callable, Iterator
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple, get_args

import numpy as np

import vijax
from benchmarks import malformed
from vijax import plots, public
from vijax.continuation import branch_continuation, branch_events
from vijax.design.robustness.tolerance import Tolerance
from vijax.plots import figure

RESULTS = frozenset(
    {
        "AperiodicOptimum",
        "Average",
        "BifurcationCurve",
        "Branch",
        "ConstancyTest",
        "Design",
        "Fit",
        "Impact",
        "MapCurves",
        "Misfit",
        "Optimum",
        "Orbit",
        "Smoothness",
        "State",
        "Status",
        "Steady",
        "Surroundings",
        "TolerancePlane",
        "Trajectory",
    }
)
"""Records that public functions return; users do not construct them."""
ABSTRACT = frozenset({"Excitation", "MembraneLaw"})
"""Records that are subclassed and have no parameters."""
INTERNAL = frozenset({"at", "by_wall_kind", "in_units", "is_rigid_at", "of"})
"""Methods that are called within compiled programs, and therefore validate nothing."""

CELL = {"d": 0.2, "kappa": 40.0}
WITHIN = {"d": (0.1, 0.3), "kappa": (3.0, 400.0)}


class PublicCall(NamedTuple):
    """A public function or record with valid arguments; no other parameter is required."""

    function: Callable[..., Any]
    right: dict[str, Any]

    @property
    def parameters(self) -> list[str]:
        """Return the names of its parameters; `**axes` counts as its named axes."""
        names: list[str] = []
        for name, parameter in inspect.signature(self.function).parameters.items():
            axes = get_args(parameter.annotation) if parameter.kind is parameter.VAR_KEYWORD else ()
            names += axes[0].__annotations__ if axes else [name]
        return names


def names() -> Iterator[str]:
    """Yield everything public with parameters: functions, records, and methods of records."""
    public_objects = {name: getattr(vijax, name) for name in public.__all__ if name not in RESULTS | ABSTRACT}
    public_objects |= {f"plots.{name}": getattr(plots, name) for name in plots.__all__}
    for name, item in public_objects.items():
        if isinstance(item, FunctionType):
            yield name
        elif isinstance(item, type):
            yield name
            for method, function in inspect.getmembers(item, inspect.isfunction):
                is_public = function.__module__.startswith("vijax.") and not method.startswith("_")
                if is_public and method not in INTERNAL and len(inspect.signature(function).parameters) > 1:
                    yield f"{name}.{method}"


def _branch() -> branch_continuation.Branch:
    orbit = malformed.an_orbit()
    return branch_continuation.Branch("d", np.array([0.2]), orbit, [], ("bounds", "bounds"))


def _pair_of_fields(d: Any, kappa: Any, r: Any, gamma: Any) -> Any:
    """Use a directly constructed `ImpactPair`: its fields are validated when it is used."""
    return vijax.trajectory(vijax.ImpactPair(d, kappa, r, gamma), 0.05, -0.4, 1)


def _of_sides(left: Any, right: Any) -> Any:
    """Use a `Sides`: its content is validated when it is used."""
    return vijax.Harvester(omega0=vijax.Sides(left, right))


@cache
def calls() -> dict[str, PublicCall]:
    """Return the valid calls, by name."""
    pair, orbit, optimum = malformed.pair(), malformed.an_orbit(), malformed.an_optimum()
    device, plane, spread = vijax.Harvester(), malformed.a_plane(), Tolerance("omega0", 0.05)
    path = vijax.Trajectory(None, 0, None, 0)  # type: ignore[arg-type]
    rubber, hertz = vijax.Hyperelastic(1.2, 0.1), vijax.HuntCrossley(0.5)
    record = vijax.Record([0.0, 0.1, 0.2], [0.0, 1.0, 0.0])
    valid: dict[str, dict[str, Any]] = {
        "ContinuationSettings": {},
        "DesignSettings": {},
        "Harmonics": {},
        "Harvester": {},
        "Harvester.friction": {"coefficient": 0.1},
        "Harvester.pair": {},
        "HuntCrossley": {"chi": 0.5},
        "HuntCrossley.energy": {"pair": pair, "w": 0.1},
        "HuntCrossley.bind": {"pair": pair},
        **{
            f"{law}.{method}": {"device": device}
            for law in ("HuntCrossley", "Hyperelastic")
            for method in ("nondimensional", "of_device")
        },
        **{f"{name}.nondimensional": {"device": device} for name in ("Harmonics", "Noise", "Record", "Waveform")},
        "HuntCrossley.acceleration": {"pair": pair, "w": 0.1, "z": 0.0},
        "Hyperelastic.acceleration": {"pair": pair, "w": 0.1, "z": 0.0},
        "Hyperelastic": {"prestretch": 1.2, "radius": 0.1},
        "Hyperelastic.energy": {"pair": pair, "w": 0.1},
        "Hyperelastic.bind": {"pair": pair},
        "ImpactPair": {"d": 0.2, "kappa": 40.0, "r": 0.5, "gamma": 0.0},
        "Noise": {"level": 0.1, "bandwidth": 8.0},
        "Record": {"time": [0.0, 0.1, 0.2], "acceleration": [0.0, 1.0, 0.0]},
        "Record.waveform": {"device": device},
        "Sides": {"left": 300.0, "right": 400.0},
        "Tolerance": {"name": "omega0", "spread": 0.05},
        "Waveform": {"values": [0.0, 1.0], "samples": 2.0},
        "average": {"device": device},
        "basin_fractions": CELL,
        "basins": CELL,
        "bifurcation_curves": {"dataset": plane},
        "branch_dataset": {"branches": [_branch()]},
        "cheapest_model": {"comparison": plane, "tolerance": 0.05},
        "compare": CELL,
        "curve_dataset": {"curves": []},
        "curve_rows": {"dataset": plane},
        "curves_about": {"orbit": orbit, "within": WITHIN},
        "arrival_statistics": {"optimum": optimum},
        "parameter_ranges": {"optimum": optimum},
        "tolerance_plane": {"optimum": optimum, "tolerances": [spread, Tolerance("s", 0.02)]},
        "explore": {"source": plane, "browser": False, "port": 0},
        "find_orbits": {"pair": pair, "impacts": "1:1"},
        "fit": {"times": [0.1, 0.9, 2.1, 2.9, 4.1, 4.9], "sides": [1, -1] * 3, "timing_error": 1e-3},
        "follow_curves": {"points": [branch_events.Point("fold", 0.2, orbit)], "along": "d", "within": WITHIN},
        "follow_families": {"orbit": orbit, "along": "d", "within": (0.1, 0.3)},
        "follow_orbits": {"orbit": orbit, "along": "d", "within": (0.1, 0.3)},
        "harvested_energy": {"device": device, "depth": 1e-3},
        "impact_pair": {"d": 0.2, "kappa": 40.0, "r": 0.5},
        "limit_points": {"branches": [_branch()]},
        "load": {"path": "map.zarr"},
        "lyapunov": CELL,
        "optimise": {},
        "orbit_diagram": {"along": "d", "values": [0.2, 0.3]},
        "orbit_impacts": {"orbit": orbit},
        "orbit_labels": {"orbit": orbit},
        "orbit_path": {"orbit": orbit},
        "orbit_power": {"orbit": orbit, "device": device},
        "orbits_from_states": {"pair": pair, "u": 0.05, "v": -0.4},
        "plots.basins": {"dataset": plane},
        "plots.branches": {"dataset": plane},
        "plots.curves": {"dataset": plane},
        "plots.design": {"diagram": plane, "report": {"best": None}},
        "plots.design_map": {"report": {"best": None}},
        "plots.difference_map": {"dataset": plane},
        "plots.energies": {"pair": pair, "path": path},
        "plots.fit": {"result": None},
        "plots.label_map": {"dataset": plane},
        "plots.orbit_diagram": {"dataset": plane},
        "plots.power_map": {"dataset": plane},
        "plots.response": {"dataset": plane},
        "plots.save": {"figure": figure.Figure(), "path": "picture.png"},
        "plots.trajectory": {"pair": pair, "path": path},
        "plots.variable_map": {"dataset": plane, "name": "status"},
        "response": {},
        "rigid_from": {"cheapest": plane["status"]},
        "save": {"dataset": plane, "path": "map.zarr"},
        "steady": {"device": device, "orbit": orbit[0]},
        "surroundings": {"optimum": optimum},
        "survival": CELL,
        "sweep": CELL,
        "trajectory": {"pair": pair, "u0": 0.05, "v0": -0.4, "periods": 1},
        "tolerance_statistics": {"optimum": optimum, "tolerances": [spread]},
        "maximise_basin_power": {"design": malformed.a_design()},
    }
    functions_of_records = {"ImpactPair": _pair_of_fields, "Sides": _of_sides}
    sine, noise = vijax.Harmonics(), vijax.Noise(0.1, 8.0)
    bound: dict[str, Any] = {"Harmonics": sine, "Noise": noise, "Waveform": record.waveform(device)}
    bound |= {"Harvester": device, "HuntCrossley": hertz, "Hyperelastic": rubber, "Record": record}
    calls_by_name = {}
    for name, arguments in valid.items():
        holder, _, method = name.rpartition(".")
        base: Any = plots if holder == "plots" else bound.get(holder, vijax)
        function: Any = functions_of_records.get(name) or getattr(base, method)
        calls_by_name[name] = PublicCall(function, arguments)
    return calls_by_name
