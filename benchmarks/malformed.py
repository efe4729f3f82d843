"""Malformed calls, from tables: a public function, one of its arguments, and values that it must reject.

Building a case runs nothing. Every case has exactly one mistake; all its other arguments are valid and small.
"""

import math
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import vijax
from vijax.continuation import branch_continuation, branch_dataset, branch_events, branch_switching, limits
from vijax.continuation.curves import curve_table, curves, orbit_curves
from vijax.continuation.from_map import map_curves
from vijax.design import optimise, optimum, report
from vijax.design.report_lines import format_report, format_table
from vijax.design.robustness.surroundings import maximise_basin_power, surroundings
from vijax.design.robustness.tolerance import Tolerance, nodes
from vijax.design.robustness.tolerance_plane import tolerance_plane
from vijax.maps.compare import cheapest_model
from vijax.model import device
from vijax.orbits import motion, orbit_properties, orbit_search, periodic, shooting, symmetry
from vijax.plots import branch_diagrams, designs, kind_maps, number_maps, orbit_diagrams
from vijax.simulation import simulate

NAN, INF, HUGE = math.nan, math.inf, 10**45


class Case(NamedTuple):
    """One mistake: its text, the arguments that the message must name, and a function that makes the call."""

    text: str
    names: tuple[str, ...]
    make: Callable[[], Any]


# --- valid arguments -------------------------------------------------------------------------------------------------


def pair() -> vijax.ImpactPair:
    """Make a soft cell."""
    return vijax.impact_pair(0.2, 40.0, 0.5)


def an_orbit() -> periodic.Orbit:
    """Return a record as a search returns it, made by hand so that nothing is compiled."""
    sequence = shooting.Sequence(jnp.array([[1, -1]], jnp.int32), jnp.array([2.0]), jnp.array([False]))
    wide = vijax.impact_pair([0.2], [40.0], [0.5])
    impact_unknowns, two = jnp.array([[[0.1, 0.5, 0.05], [1.1, 0.5, 0.05]]]), jnp.full((1, 2), 0.01)
    multipliers, zero = jnp.full((1, 2), 0.1 + 0j), jnp.zeros(1)
    return periodic.Orbit(wide, sequence, impact_unknowns, two, two, multipliers, zero, jnp.zeros(1, jnp.int32))


def a_design() -> optimise.Design:
    """Make a design without optima."""
    return optimise.Design((), ("omega0",), {"omega0": (20.0, 400.0)}, "P", (), 0, 0)


def an_optimum() -> optimum.Optimum:
    """Return an optimum with no valid field but its orbit."""
    path = np.zeros((1, 1))
    fields: dict[str, Any] = {"values": {}, "gradient": {}, "active": (), "path": path, "path_objective": path[0]}
    fields |= {"device": vijax.Harvester(), "label": "1:1", "objective_value": 0.0, "P": 0.0, "P_stderr": 0.0}
    return optimum.Optimum(**fields, stopped="maximum", orbit=an_orbit(), state=None, evaluations=0)


def a_map() -> xr.Dataset:
    """Make a dataset that is no map."""
    return xr.Dataset({"mass": ("d", [1.0, 2.0])})


def a_plane() -> xr.Dataset:
    """Return a map of two axes without computed cells."""
    axes = {"d": [0.1, 0.2], "kappa": [3.0, 40.0]}
    constants = {"r": 0.5, "gamma": 0.0, "omega": 6.0, "A": 1.0, "u0": 0.05, "v0": -0.4}
    return xr.Dataset({"status": (("d", "kappa"), np.zeros((2, 2), int))}, coords=axes | constants)


# --- kinds of bad values ---------------------------------------------------------------------------------------------

# Counts that may be 0 have their own group.
INTEGER = (True, 1.5, NAN, "3", [3], 3j, -1, HUGE)
COUNT = (*INTEGER, 0)
REAL = (True, "0.5", NAN, [0.1, 0.2], 1j, {}, -INF)
NUMBERS = ("0.1", [], NAN, INF, True, 1j, object(), [0.1, "x"], {"a": 1}, math.sin, np.array([]))
AXIS = (*NUMBERS, [[0.1]])
START = ("0.1", [], NAN, INF, True, 1j, object())
DEVICE = ("paper", {}, 3.0, vijax.Harvester, pair)
PAIR = ("soft", None, 3.0, {"d": 0.2}, (0.2, 40.0, 0.5, 0.0), vijax.Harvester)
ORBIT = ("1:1", None, 3.0, [], pair)
FUNCTION = (3, "bar", True, [])
CHOICE = (3, None, "HARD", ["soft"], True)
FLAG = ("yes", 1, None)
PATH = (3, 1.5, b"map", ["map.zarr"], {})
TARGET = (*PATH, "", "nowhere/map.zarr", "/proc/map.zarr", "/dev/null/map.zarr")
DATASET = (None, 3, "map.zarr", [], xr.Variable("d", [1.0]))
SEED = (True, 1.5, "3", [3], -1, HUGE)
CELL = {"d": 0.2, "kappa": 40.0}

Table = dict[str, tuple[Callable[..., Any], dict[str, Any], dict[str, tuple[Any, ...]]]]

# By name of the function: the function, its valid arguments, and invalid values by argument.
CALLS: Table = {
    "sweep": (
        vijax.sweep,
        CELL,
        {
            "d": AXIS,
            "kappa": (*AXIS, 0, -3.0),
            "r": (1.5, -0.2, [0.5, 2.0], "half"),
            "gamma": (NAN, "level", [INF]),
            "u0": START,
            "v0": START,
            "omega": (0, "pi", []),
            "A": (-1, "1 g"),
            "periods": COUNT,
            "transient": INTEGER,
            "wall": CHOICE,
            "until": CHOICE,
            "method": CHOICE,
            "dtype": (*CHOICE, float),
            "outputs": (3, ["P", 3], "Q", ["Q"], [], [["P"]]),
            "device": DEVICE,
            "progress": FUNCTION,
            "out": TARGET,
            "overwrite": FLAG,
            "workers": (2,),
            "refine": (*INTEGER, 0, 9),
            "steps": (100,),
            "solver": ("Tsit5",),
            "membrane": ("hertz", 0.5),
        },
    ),
    "sweep into a store": (
        vijax.sweep,
        CELL | {"out": "map.zarr"},
        {"workers": (True, 1.5, [2], 0, HUGE), "overwrite": FLAG},
    ),
    "sweep by ode": (
        vijax.sweep,
        CELL | {"method": "ode"},
        {
            "rtol": (*REAL, 0, -1e-8, INF),
            "atol": (*REAL, 0, -1e-8, INF),
            "solver": (3, "Euler", ["Tsit5"], True),
            "membrane": ("hertz", 0.5, vijax.HuntCrossley),
        },
    ),
    "sweep by rk4": (vijax.sweep, CELL | {"method": "rk4"}, {"steps": (*COUNT, 4)}),
    "basins": (
        vijax.basins,
        CELL | {"u0": [0.0, 0.1], "v0": [0.0, 0.1]},
        {
            "u0": START,
            "v0": START,
            "d": ([], "0.1", NAN),
            "r": (np.linspace(0.1, 2, 1000), 10**4000),
            "merge_mirrors": FLAG,
            "periods": COUNT,
            "wall": CHOICE,
            "device": DEVICE,
            "progress": FUNCTION,
        },
    ),
    "basin_fractions": (
        vijax.basin_fractions,
        CELL,
        {
            "starts": COUNT,
            "speed": (*REAL, 0, -0.6, INF),
            "seed": SEED,
            "merge_mirrors": FLAG,
            "periods": COUNT,
            "device": DEVICE,
            "progress": FUNCTION,
            "u0": (0.1,),
        },
    ),
    "compare": (
        vijax.compare,
        CELL,
        {
            "tolerance": (*REAL, 0, -0.05, INF),
            "periods": COUNT,
            "until": CHOICE,
            "device": DEVICE,
            "progress": FUNCTION,
        },
    ),
    "lyapunov": (
        vijax.lyapunov,
        CELL,
        {"starts": (*COUNT, 1), "periods": COUNT, "transient": INTEGER, "device": DEVICE, "progress": FUNCTION},
    ),
    "survival": (
        vijax.survival,
        CELL,
        {
            "starts": COUNT,
            "speed": (*REAL, 0),
            "seed": SEED,
            "periods": (*COUNT, 7),
            "device": DEVICE,
            "progress": FUNCTION,
        },
    ),
    "orbit_diagram": (
        vijax.orbit_diagram,
        {"along": "d", "values": [0.2, 0.3], "kappa": 40.0},
        {
            "along": (3, None, "u0", "", ["d"], "mass"),
            "values": (0.2, [], "0.1", NAN, None, [[0.1]], ["a"], [0.0]),
            "direction": CHOICE,
            "periods": COUNT,
            "recorded_periods": (*COUNT, 401),
            "wall": CHOICE,
            "dtype": CHOICE,
            "device": DEVICE,
            "progress": FUNCTION,
        },
    ),
    "optimise": (
        vijax.optimise,
        {},
        {
            "device": DEVICE,
            "tune": (3, (), ("mass",), ("omega0", "k"), [3], None),
            "bounds": (3, {"r": (0.1, 0.2)}, {"omega0": 3}, {"omega0": (3,)}, {"omega0": ("a", "b")}, [("omega0",)]),
            "objective": CHOICE,
            "tolerances": (3, "omega0=5%", [3], [("omega0", 0.05)], [Tolerance("omega0", 0.05)]),
            "max_evaluations": (*COUNT, 1),
            "survey_points": (*COUNT, 1),
            "starts": COUNT,
            "max_impacts": COUNT,
            "survey_periods": COUNT,
        },
    ),
    "optimise over tolerances": (
        vijax.optimise,
        {"objective": "mean", "tolerances": [Tolerance("omega0", 0.05)]},
        {
            "samples": COUNT,
            "tolerances": ([("omega0", 0.05)], [Tolerance("omega0", 0.05), Tolerance("k", 0.05)]),
        },
    ),
    "Tolerance": (
        Tolerance,
        {"name": "omega0", "spread": 0.05},
        {
            "name": (3, None, "mass", "beta", ["omega0"]),
            "spread": (*REAL, INF, 0, 1, -0.1, 2.0, "5%"),
            "kind": (*CHOICE, "normal"),
        },
    ),
    "optimise_all": (optimise.optimise_all, {}, {"devices": (3, [], [3], "paper", None, vijax.Harvester())}),
    "under": (
        optimise.tolerance_statistics,
        {"optimum": an_optimum(), "tolerances": [Tolerance("omega0", 0.05)]},
        {
            "optimum": (3, None, "best", a_design()),
            "tolerances": (3, "omega0", [3], ["omega0"]),
            "samples": COUNT,
        },
    ),
    "trajectory": (
        vijax.trajectory,
        {"pair": pair(), "u0": 0.05, "v0": -0.4, "periods": 4},
        {
            "pair": PAIR,
            "u0": (*START, None),
            "v0": (*START, None),
            "t0": (*START, -1.0, 8.0, 100.0, None),
            "periods": (*COUNT, 10**12),
            "max_impacts": (*COUNT, 10**9),
            "method": (3, "euler", None, vijax.sweep),
            "solver": ("Tsit5",),
            "steps": (100,),
        },
    ),
    "trajectory in a rigid gap": (
        vijax.trajectory,
        {"pair": vijax.impact_pair(0.2, None, 0.5), "v0": 0.0, "periods": 4},
        {"u0": (0.2, -0.11, 5.0)},
    ),
    "steady": (
        vijax.steady,
        {"device": vijax.Harvester(), "orbit": an_orbit()[0]},
        {
            "device": (*DEVICE, None),
            "orbit": (*ORBIT, an_orbit()),
            "pair": PAIR[:1] + PAIR[2:],
            "membrane": (3, "linear", vijax.HuntCrossley, vijax.HuntCrossley(0.3)),
        },
    ),
    "impact_pair": (
        vijax.impact_pair,
        {"d": 0.2, "kappa": 40.0, "r": 0.5},
        {
            "d": (*NUMBERS, 0, -0.1, None),
            "kappa": (0, INF, "stiff", [], True),
            "r": (0, 1.5, NAN, [], "half", vijax.Sides(0.5, None)),
            "gamma": (NAN, INF, [], "level", None),
        },
    ),
    "Harvester": (
        vijax.Harvester,
        {},
        {
            "m_b": (0, "3.5 g", NAN, True, [], None),
            "s": (-1, "0.3 m", []),
            "omega": (0, None, {}),
            "r": (0, 1.5, "half"),
            "r_b": (1.0,),
            "V": (NAN, "2 kV", None),
            "penetration_limit": (0, -1, "R0", []),
        },
    ),
    "Harvester.pair": (vijax.Harvester().pair, {}, {"wall": CHOICE}),
    "HuntCrossley": (vijax.HuntCrossley, {"chi": 0.5}, {"chi": (*REAL, -0.1), "exponent": (*REAL, 0.5)}),
    "harvested_energy": (
        vijax.harvested_energy,
        {"device": vijax.Harvester(), "depth": 1e-3},
        {"device": (*DEVICE, None), "depth": ("1 mm", None, {}, 1j, True, [[1.0], [2.0, 3.0]])},
    ),
    "load": (vijax.load, {}, {"path": (*PATH, "", "nowhere", "/dev/null", None)}),
    "save": (
        vijax.save,
        {"dataset": a_map(), "path": "map.zarr"},
        {"dataset": DATASET, "path": (*TARGET, None), "overwrite": FLAG},
    ),
    "orbit_search.find_orbits": (
        orbit_search.find_orbits,
        {"pair": pair(), "impacts": "1:1"},
        {
            "pair": (*PAIR, vijax.impact_pair([0.2, 0.3], 40.0, 0.5)),
            "impacts": (3, None, "", "up", "0:0", "1:1/0T", "99999999999:1", "1000:1000", "R" * 5000, ["R", "L"]),
            "period": (True, 1.5, "3", [3], -1, 0, HUGE, 7),
            "guesses": (*COUNT, 10**9),
            "seed": SEED,
        },
    ),
    "orbit_search.orbits_from_states": (
        orbit_search.orbits_from_states,
        {"pair": pair(), "u": 0.05, "v": -0.4},
        {
            "pair": PAIR,
            "u": (*START, None),
            "v": (*START, None),
            "t": (*START, -1.0, 2.0),
            "period": (*COUNT, 10**9),
            "settle": INTEGER,
        },
    ),
    "orbit_search.orbits_from_states beyond a rigid wall": (
        orbit_search.orbits_from_states,
        {"pair": vijax.impact_pair(0.2, None, 0.5), "v": 0.0},
        {"u": (0.2, -0.11, [0.0, 5.0])},
    ),
    "summarise": (
        simulate.summarise,
        {
            "pair": vijax.impact_pair([0.2], [40.0], 0.5),
            "u0": jnp.zeros(1),
            "v0": jnp.zeros(1),
            "scale": simulate.Scale(*jnp.ones((4, 1))),
            "device": vijax.Harvester(),
        },
        {
            "pair": (*PAIR, pair()),
            "u0": ("0.1", None, NAN, jnp.zeros(2)),
            "v0": ("0.1", None, NAN, jnp.zeros(2)),
            "scale": (1.0, None, (1.0, 1.0)),
            "device": (*DEVICE, None),
            "periods": COUNT,
            "until": CHOICE,
            "transient": INTEGER,
            "outputs": (3, ["Q"], None),
            "method": ("ode", 3),
            "count": (*INTEGER, 2),
            "on": ("cpu", 0, []),
        },
    ),
    "periodic.solve": (
        periodic.solve,
        {"pair": an_orbit().pair, "sequence": an_orbit().sequence, "impact_unknowns": an_orbit().impact_unknowns},
        {"pair": PAIR, "sequence": ("RL", None, [1, -1]), "impact_unknowns": ("x", None, [], 3.0)},
    ),
    **{
        f"orbit.{function.__name__}": (function, {}, {"orbit": ORBIT})
        for function in (
            symmetry.is_symmetric,
            symmetry.close_half_way,
            symmetry.double,
            symmetry.unfold,
            orbit_properties.counts,
            orbit_properties.orbit_labels,
        )
    },
    "orbit_properties.orbit_impacts": (orbit_properties.orbit_impacts, {}, {"orbit": ORBIT}),
    "orbit_properties.orbit_power": (
        orbit_properties.orbit_power,
        {"orbit": an_orbit(), "device": vijax.Harvester()},
        {"orbit": ORBIT, "device": (*DEVICE, None)},
    ),
    "orbit_properties.orbit_path": (
        orbit_properties.orbit_path,
        {"orbit": an_orbit()},
        {"orbit": ORBIT, "samples": COUNT},
    ),
    "continuation.follow_orbits": (
        branch_continuation.follow_orbits,
        {"orbit": an_orbit(), "along": "d", "within": (0.1, 0.3)},
        {
            "orbit": ORBIT,
            "along": (3, None, "mass", ["d"]),
            "within": (3, None, (0.3, 0.1), (0.1,), ("a", "b"), (0.1, NAN), (0.25, 0.3), "0.1:0.3"),
            "direction": CHOICE,
            "device": DEVICE,
            "points": (*COUNT, 10**9),
            "settings": (3, None, {"max_step": 0.02}),
        },
    ),
    "switching.follow_families": (
        branch_switching.follow_families,
        {"orbit": an_orbit(), "along": "d", "within": (0.1, 0.3)},
        {
            "orbit": ORBIT,
            "along": (3, "mass"),
            "within": (3, (0.3, 0.1)),
            "device": DEVICE,
            "max_switches": (True, 1.5, "3", -1, HUGE),
            "points": (0, 1.5, 10**9),
            "settings": (3, None),
        },
    ),
    "switching.switch_branch": (
        branch_switching.switch_branch,
        {"point": branch_events.Point("flip", 0.2, an_orbit()), "along": "d", "within": (0.1, 0.3)},
        {
            "point": (3, None, "flip", branch_events.Point("fold", 0.2, an_orbit())),
            "along": (3, "mass"),
            "within": (3, (0.3, 0.1)),
            "points": (0, 1.5, 10**9),
        },
    ),
    "curves.follow_curves": (
        curves.follow_curves,
        {
            "points": [branch_events.Point("fold", 0.2, an_orbit())],
            "along": "d",
            "within": {"d": (0.1, 0.3), "kappa": (3, 400)},
        },
        {
            "points": (3, None, [], ["fold"], "fold"),
            "along": (3, "mass"),
            "within": (3, (0.1, 0.3), {"d": (0.1, 0.3)}, {"d": (0.3, 0.1), "r": (0.2, 0.8)}, {"d": 3, "r": (0.2, 0.8)}),
            "max_points": (*COUNT, 1),
            "settings": (3, "fine"),
            "device": DEVICE,
        },
    ),
    "bifurcation_curves": (
        map_curves.bifurcation_curves,
        {"dataset": a_map()},
        {
            "dataset": (*DATASET, a_map()),
            "max_rounds": INTEGER,
            "max_seconds": (*REAL, 0, -1),
            "round_borders": COUNT,
            "max_points": (*COUNT, 1),
            "progress": FUNCTION,
        },
    ),
    "limit_points": (limits.limit_points, {"branches": []}, {"branches": (3, None, ["d"]), "device": DEVICE}),
    "curves_about": (
        orbit_curves.curves_about,
        {"orbit": an_orbit(), "within": {"d": (0.1, 0.3), "kappa": (3, 400)}},
        {
            "orbit": ORBIT,
            "within": (3, {"d": (0.1, 0.3)}, {"d": (0.3, 0.1), "r": (0.2, 0.8)}),
            "max_points": (*COUNT, 1),
        },
    ),
    "tolerance_plane": (
        tolerance_plane,
        {"optimum": an_optimum(), "tolerances": [Tolerance("omega0", 0.05), Tolerance("s", 0.02)]},
        {
            "optimum": (3, None, "best", a_design()),
            "tolerances": (3, [3], [Tolerance("s", 0.1)], [Tolerance("s", 0.1), Tolerance("V", 0.1)]),
        },
    ),
    "curve_rows": (curve_table.curve_rows, {}, {"dataset": (*DATASET, a_map())}),
    "branch_dataset.branch_dataset": (branch_dataset.branch_dataset, {}, {"branches": (3, None, [], ["d"], "d")}),
    "surroundings": (
        surroundings,
        {"optimum": an_optimum()},
        {
            "optimum": (3, None, "best", a_design()),
            "starts": (*COUNT, 10**9),
            "reach": (*REAL, 0, 1, -1),
            "seed": SEED,
        },
    ),
    "maximise_basin_power": (
        maximise_basin_power,
        {"design": a_design()},
        {
            "design": (3, None, "best"),
            "starts": COUNT,
            "reach": (*REAL, 0, -1, 2.0),
            "points": (*COUNT, 2),
            "seed": SEED,
        },
    ),
    "report.describe": (
        report.describe,
        {"design": a_design()},
        {"design": (3, None, "best"), "surroundings": (3, "all"), "diagram": (3, a_map()), "tolerances": (3, [3])},
    ),
    "report_lines.format_report": (
        lambda report: next(format_report(report)),
        {},
        {"report": (3, None, "best", a_design(), {})},
    ),
    "report_lines.format_table": (lambda report: next(format_table(report)), {}, {"report": (3, None, "best")}),
    "designs.design": (
        designs.design,
        {"diagram": a_map(), "report": {"best": None}},
        {"diagram": (*DATASET, a_map())},
    ),
    "designs.design_map": (designs.design_map, {}, {"report": (3, None, "best")}),
    "report.describe_optimum": (report.describe_optimum, {}, {"optimum": (3, None, "best")}),
    **{
        f"plot.{function.__name__}": (function, {"dataset": a_map()}, {"dataset": DATASET})
        for function in (
            number_maps.power_map,
            kind_maps.label_map,
            kind_maps.basin_map,
            kind_maps.multistability_map,
            number_maps.difference_map,
        )
    },
    "number_maps.variable_map": (
        number_maps.variable_map,
        {"dataset": a_map(), "name": "mass"},
        {"dataset": DATASET, "name": (3, None, ["mass"], "P")},
    ),
    "orbit_diagrams.orbit_diagram": (orbit_diagrams.orbit_diagram, {}, {"dataset": DATASET}),
    "branch_diagrams.branches": (branch_diagrams.branches, {}, {"dataset": DATASET}),
    "tolerance.nodes": (
        nodes,
        {"tolerances": (Tolerance("omega0", 0.05),)},
        {"tolerances": (3, "omega0", [3]), "samples": COUNT, "seed": SEED},
    ),
    "explore": (
        vijax.explore,
        {"source": a_plane(), "browser": False, "port": 0},
        {
            "source": (3, [], {}, b"map.zarr", "", "nowhere.zarr", "/dev/null", a_map(), xr.Variable("d", [1.0])),
            "curves": (3, [], {}, b"curves.zarr", "", "nowhere.zarr", "/dev/null", a_map(), a_plane()),
            "address": (3, None, "", [], "0.0.0.0", "nowhere"),
            "port": (True, 1.5, NAN, "80", [80], -1, 65536, HUGE),
            "allow_origin": (3, None, "", "*", ["lab", 3], [""], "http://lab:5006", "lab:port", "lab:70000", "a b"),
            "browser": FLAG,
        },
    ),
    "curve": (
        motion.curve,
        {"pair": pair(), "t": [0.1], "side": [1], "v_in": [0.5], "v_out": [-0.4], "duration": [0.05]},
        {"pair": PAIR, "t": ("x", None, 0.1), "side": ("x", None, 1, [1, -1]), "samples": COUNT},
    ),
    "motion.states": (
        motion.states,
        {"pair": pair(), "t": [0.1], "side": [1], "v_in": [0.5], "v_out": [-0.4], "duration": [0.05], "when": [0.2]},
        {"pair": PAIR, "v_in": ("x", [0.1, 0.2]), "when": ("x", None, [], True, 0.2)},
    ),
    "cheapest_model": (
        cheapest_model,
        {"found": a_map(), "tolerance": 0.05},
        {"found": (*DATASET, a_map()), "tolerance": (*REAL, 0)},
    ),
    "with_constants": (
        device.with_constants,
        {"device": vijax.Harvester()},
        {"device": (*DEVICE, None), "mass": (1.0,), "k": (0, "560 N/m", NAN), "m_b": (0, "3 g")},
    ),
    "with_pair": (
        device.with_pair,
        {"device": vijax.Harvester(), "pair": pair()},
        {"device": (*DEVICE, None), "pair": PAIR},
    ),
}


# Made in advance, as objects created while a call is traced would be traced too.
_PAIR, _ORBIT = pair(), an_orbit()

# Functions that are not differentiable: the traced argument and the call.
TRACED: dict[str, Callable[[Any], Any]] = {
    "d of sweep": lambda x: vijax.sweep(d=x, kappa=40.0),
    "r of sweep": lambda x: vijax.sweep(**CELL, r=x),
    "device of sweep": lambda x: vijax.sweep(**CELL, device=vijax.Harvester(V=x)),
    "v0 of basins": lambda x: vijax.basins(**CELL, v0=x),
    "d of basin_fractions": lambda x: vijax.basin_fractions(d=x),
    "kappa of compare": lambda x: vijax.compare(d=0.2, kappa=x),
    "d of lyapunov": lambda x: vijax.lyapunov(d=x),
    "speed of survival": lambda x: vijax.survival(**CELL, speed=x),
    "values of orbit_diagram": lambda x: vijax.orbit_diagram(along="d", values=x),
    "kappa of orbit_diagram": lambda x: vijax.orbit_diagram(along="d", values=[0.1, 0.2], kappa=x),
    "device of optimise": lambda x: vijax.optimise(vijax.Harvester(s=x)),
    "bounds of optimise": lambda x: vijax.optimise(bounds={"omega0": (20.0, x)}),
    "pair of search": lambda x: orbit_search.find_orbits(vijax.impact_pair(x, 40.0, 0.5), "1:1"),
    "u of orbits_from_states": lambda x: orbit_search.orbits_from_states(_PAIR, x, 0.1),
    "within of follow": lambda x: branch_continuation.follow_orbits(_ORBIT, "d", (0.1, x)),
    "reach of surroundings": lambda x: maximise_basin_power(a_design(), reach=x),
}

# Calls with a missing or superfluous argument.
SHAPES: dict[str, Callable[[], Any]] = {
    "kapa of sweep": lambda: vijax.sweep(kapa=3.0),
    "progres of sweep": lambda: vijax.sweep(**CELL, progres=print),
    "d and s of sweep": lambda: vijax.sweep(d=0.2, s=0.3),
    "k and omega0 of sweep": lambda: vijax.sweep(k=500.0, omega0=300.0),
    "gamma and beta of basins": lambda: vijax.basins(gamma=0.1, beta=0.1),
    "workers without out": lambda: vijax.sweep(**CELL, workers=2),
    "merge_mirrors on a slope": lambda: vijax.basins(**CELL, gamma=0.1, merge_mirrors=True),
    "u0 outside a rigid gap": lambda: vijax.sweep(**CELL, u0=0.2, wall="rigid"),
    "values missing": lambda: vijax.orbit_diagram(along="d"),
    "d given twice": lambda: vijax.orbit_diagram(along="d", values=[0.1, 0.2], d=0.3),
    "gamma of with_pair": lambda: device.with_pair(vijax.Harvester(), vijax.impact_pair(0.2, 40.0, 0.5, 20.0)),
    "d and kappa of other shapes": lambda: vijax.impact_pair([0.1, 0.2], [1.0, 2.0, 3.0], 0.5),
    "u0 and v0 of other shapes": lambda: vijax.trajectory(pair(), [0.0, 0.1], [0.1, 0.2, 0.3], 4),
    "u and v of other shapes": lambda: orbit_search.orbits_from_states(pair(), [0.0, 0.1], [0.1, 0.2, 0.3]),
    "r with Hunt-Crossley": lambda: vijax.trajectory(
        pair(), 0.05, -0.4, 4, method="ode", membrane=vijax.HuntCrossley(0.5)
    ),
    "kapa of impact_pair": lambda: vijax.impact_pair(0.2, kapa=40.0, r=0.5),
    "mass of Harvester": lambda: vijax.Harvester(mass=1.0),
    "V of optimise": lambda: vijax.optimise(vijax.Harvester(V=0.0)),
    "device of several": lambda: vijax.optimise(vijax.Harvester(s=np.array([0.1, 0.2]))),
    "kappa of a rigid wall": lambda: branch_continuation.follow_orbits(rigid_orbit(), "kappa", (3.0, 40.0)),
}

# More than any machine can hold or finish.
LARGE: dict[str, Callable[[], Any]] = {
    "d and kappa of 10^12 cells": lambda: vijax.sweep(d=np.linspace(0.1, 0.3, 10**6), kappa=np.linspace(3, 40, 10**6)),
    "omega and omega0 of 10^12 cells": lambda: vijax.sweep(
        omega=np.linspace(3, 9, 10**6), omega0=np.linspace(20, 400, 10**6)
    ),
    "periods in single precision": lambda: vijax.sweep(**CELL, periods=10**8, dtype="float32"),
    "starts of 10^9": lambda: vijax.basin_fractions(**CELL, starts=10**9),
    "starts and d of 10^12": lambda: vijax.basin_fractions(d=np.linspace(0.1, 0.3, 10**6), starts=10**6),
    "u0 and v0 of 10^12": lambda: vijax.basins(**CELL, u0=np.linspace(0, 0.1, 10**6), v0=np.linspace(0, 1, 10**6)),
    "starts of survival": lambda: vijax.survival(**CELL, starts=10**9),
    "starts of lyapunov": lambda: vijax.lyapunov(**CELL, starts=10**9),
    "values and kappa of 10^10": lambda: vijax.orbit_diagram(
        along="d", values=np.linspace(0.1, 0.3, 10**5), kappa=np.linspace(3, 40, 10**5)
    ),
    "recorded_periods of 10^9": lambda: vijax.orbit_diagram(
        along="d", values=[0.1, 0.2], periods=10**9, recorded_periods=10**9
    ),
    "periods of 10^9 recorded": lambda: vijax.trajectory(pair(), 0.05, -0.4, 10**9),
    "periods of 10^8 and u0 of many": lambda: vijax.trajectory(pair(), np.zeros(10**4), -0.4, 10**7),
    "samples of 10^9": lambda: orbit_properties.orbit_path(an_orbit(), 10**9),
    "guesses of 5005 sequences": lambda: orbit_search.find_orbits(pair(), "6:9", guesses=10**7),
    "points of 10^9": lambda: branch_continuation.follow_orbits(an_orbit(), "d", (0.1, 0.3), points=10**9),
    "survey_points and starts of 10^12": lambda: vijax.optimise(survey_points=10**6, starts=10**6),
    "samples of optimise": lambda: vijax.optimise(
        objective="mean", tolerances=[Tolerance("omega0", 0.05)], samples=10**12
    ),
    "devices of many": lambda: optimise.optimise_all([vijax.Harvester()] * 10**4, survey_points=1000, starts=1000),
}


def rigid_orbit() -> periodic.Orbit:
    """Make `an_orbit` between rigid walls."""
    soft = an_orbit()
    return periodic.Orbit(**(vars(soft) | {"pair": vijax.impact_pair([0.2], None, [0.5])}))


def calls() -> Iterator[Case]:
    """Yield the malformed calls."""
    for function_name, (function, valid, invalid) in CALLS.items():
        for argument, values in invalid.items():
            for value in values:
                make = partial(function, **(valid | {argument: value}))
                yield Case(f"{function_name}({argument}={_short(value)})", (argument,), make)
    for text, traced in TRACED.items():
        yield Case(f"traced: {text}", _names(text), partial(jax.eval_shape, traced, 0.2))
    for text, make in (SHAPES | LARGE).items():
        yield Case(text, _names(text), make)


def _names(text: str) -> tuple[str, ...]:
    """Return the argument names at the beginning of a text: "d and s of sweep"."""
    words = text.split()
    return (words[0], words[2]) if words[1] == "and" else (words[0],)


def _short(value: Any) -> str:
    # Without addresses, which differ between processes.
    return re.sub(r" at 0x[0-9a-f]+", "", " ".join(repr(value).split()))[:60]
