"""The table of quantities contains all quantities of the package, and its text agrees with the package."""

import dataclasses
import inspect
import re
from pathlib import Path

import click
import jax
import numpy as np
import pytest

from vijax import HuntCrossley, Hyperelastic, sweep
from vijax.cli import main as command
from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS
from vijax.maps.axes import Axes, Parameters, parse_axis
from vijax.maps.cells import cells
from vijax.maps.orbit_diagram import plan
from vijax.model import quantities, tuned_quantities
from vijax.model.device import LIMITS, Harvester, with_constants
from vijax.model.pair import ImpactPair
from vijax.plots import branch_diagrams, orbit_diagrams

AXES, PARAMETERS, QUANTITIES = quantities.AXES, quantities.PARAMETERS, quantities.QUANTITIES
CONSTANTS = [field.name for field in dataclasses.fields(Harvester)]
PAGES = [command.vijax.get_command(click.Context(command.vijax), name) for name in command.vijax.list_commands(None)]


def test_all_axes_and_constants_of_the_device_are_in_the_table():
    assert list(Parameters.__annotations__) == list(PARAMETERS)
    assert set(Axes.__annotations__) == set(AXES)
    assert {field.name for field in dataclasses.fields(ImpactPair)} - {"law", "waves"} < set(PARAMETERS)
    of_walls = {f"{name}_{side}" for name in ("omega0", "r") for side in quantities.SIDES}
    assert of_walls < set(AXES)
    assert set(QUANTITIES) == set(AXES) | set(CONSTANTS)
    input_only = {name for name, entry in QUANTITIES.items() if entry.input_only}
    assert set(tuned_quantities.NAMES) == set(QUANTITIES) - set(quantities.STARTS) - set(LIMITS) - input_only
    assert set(AFFECTED_CONSTANTS) == set(PARAMETERS) - input_only
    assert all(name == entry.name for name, entry in QUANTITIES.items())
    with pytest.raises(TypeError, match=f"the axes are {', '.join(AXES)}"):
        cells({"colour": 1.0}, Harvester(), "soft")


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name not in ("docs", "doctor", "explore")], ids=lambda page: page.name
)
def test_options_with_values_are_axes_with_the_text_of_the_table(page):
    options = {option.name: option for option in page.params if option.metavar == "VALUES"}
    assert list(options) in (list(AXES), list(PARAMETERS))
    for name, option in options.items():
        assert option.opts == [f"--{name}"]
        unit = f", {AXES[name].unit}" if AXES[name].unit else ""
        assert option.help.partition(" [")[0] == AXES[name].long_name + unit


@pytest.mark.parametrize("page", [page for page in PAGES if any(entry.name == "quantity" for entry in page.params)])
def test_all_quantities_of_diagrams_are_in_the_table(page):
    (option,) = [parameter for parameter in page.params if parameter.name == "quantity"]
    checks = {"orbit-diagram": orbit_diagrams.check_quantity, "branch": branch_diagrams.check_branch_quantity}
    for name in option.type.choices:
        assert quantities.RESULT_QUANTITIES[name].label
        checks[page.name](name)


def test_quantities_with_units_follow_from_the_device():
    """An option with a physical name describes a plane of the device."""
    from vijax.cli.options.options import DEVICE, PHYSICAL

    of_walls = {f"{name}_{side}" for name in ("omega0", "k") for side in quantities.SIDES}
    assert {"omega", "A", "beta", "s", "distance", "omega0", "k"} | of_walls == DEVICE
    assert {"s", "distance", "omega0", "k"} | of_walls == PHYSICAL


@pytest.mark.parametrize("name", [name for name, axis in PARAMETERS.items() if axis.default])
def test_defaults_of_axes_equal_the_device(name):
    assert parse_axis(name, AXES[name].default) == pytest.approx(float(tuned_quantities.value_of(Harvester(), name)))


def test_the_default_start_equals_the_table():
    narrow, wide = (cells({"d": d}, Harvester(), "soft").quantities for d in (0.1, 0.3))
    u0, v0 = (float(text) for text in re.fullmatch(r"min\((.+), .+\) (.+)", " ".join(_starts())).groups())
    assert (float(wide["u0"]), float(wide["v0"])) == (u0, v0)
    assert AXES["u0"].default == f"min({u0}, {float(narrow['u0']) / 0.1:g} d)"


def _starts():
    return [axis.default for axis in quantities.STARTS.values()]


@pytest.mark.parametrize("name", tuned_quantities.ALIASES)
def test_alias_of_a_constant_specifies_the_constant(name):
    """The device of a map does not depend on the name of its argument, and two names of one constant are rejected."""
    device = Harvester(beta=0.02)
    value, constant = float(tuned_quantities.value_of(device, name)), AXES[name].constant
    base_name = quantities.both_walls_name(name)
    by_name, by_alias = (
        cells(arguments, device, "soft").quantities
        for arguments in ({f"{base_name}_left": value} if base_name else {}, {name: value})
    )
    for parameter in ("d", "gamma", *(("kappa_left", "kappa_right") if base_name else ("kappa",))):
        assert float(by_alias[parameter]) == pytest.approx(float(by_name[parameter]), rel=1e-12)
    assert constant in quantities.synonyms(name)
    made = tuned_quantities.tune_device(device, (name,), tuned_quantities.to_variables((name,), [1.1 * value]))
    assert float(tuned_quantities.value_of(made, name)) == pytest.approx(1.1 * value, rel=1e-12)
    with pytest.raises(ValueError, match="give the same quantity; give one of them"):
        cells({name: value, constant: 0.1}, device, "soft")


@pytest.mark.parametrize("name", [name for name, entry in QUANTITIES.items() if entry.unit])
def test_docstrings_name_the_units_of_the_table(name):
    base_name = quantities.both_walls_name(name) or name
    unit = re.search(rf"^ +{base_name}: .*\[(.+?)\]", inspect.getdoc(Harvester), re.MULTILINE)
    if base_name in ("k", "distance"):
        assert name not in CONSTANTS
        unit = re.search(r"\[(.+?)\]", inspect.getdoc(getattr(Harvester, base_name).fget))
    assert unit[1] == QUANTITIES[name].unit


EDGES = {
    "d": ([1e-300, 5], [0, -1, np.inf, np.nan]),
    "r": ([1e-9, 1, np.int64(1)], [0, 1.0001, -1, np.nan]),
    "gamma": ([0, -3.0, 1e30, np.int32(-7)], [np.inf, -np.inf, np.nan]),
    "C_T": ([0, 1e-9], [-1e-12, np.inf, np.nan]),
    "penetration_limit": ([1e-9, np.inf], [0, -1, np.nan]),
    "energy_ratio_limit": ([1e-9, 1], [0, 1.0001, np.inf, np.nan]),
    "u0": ([0, -0.2], [np.inf, np.nan]),
}


@pytest.mark.parametrize("name", EDGES)
def test_rules_are_valid_at_their_limits(name):
    good, bad = EDGES[name]
    quantities.check(name, good)
    quantities.check(name, np.array(good, np.float32)[-1:])
    for value in bad:
        rule = QUANTITIES[name].rule.must
        with pytest.raises(ValueError, match=rf"here {re.escape(rule)}; got \S+ at index 1; "):
            quantities.check(name, [good[-1], value], "here")


def test_all_errors_contain_a_remedy():
    for name, entry in QUANTITIES.items():
        assert entry.remedy == entry.remedy.strip()
        assert not entry.remedy.endswith(" in"), f"{name} has no unit and no advice"


def test_distance_of_membranes_is_the_free_travel_plus_the_diameter():
    device = Harvester(r_b=0.004)
    by_distance, by_travel = (
        cells(arguments, device, "soft").quantities["d"]
        for arguments in ({"distance": [0.05, 0.06]}, {"s": [0.042, 0.052]})
    )
    np.testing.assert_allclose(by_distance, by_travel, rtol=1e-14)
    assert by_distance.dims == ("distance",)
    made = with_constants(device, distance=0.014, r_b=0.005)
    assert (float(made.s), float(made.distance)) == (pytest.approx(0.004), pytest.approx(0.014))
    fits = r"distance must exceed the diameter of the ball, 2 r_b = 0.008 m; got 0.008 at index 1; give s"
    with pytest.raises(ValueError, match=fits):
        cells({"distance": [0.05, 0.008]}, device, "soft")
    with pytest.raises(ValueError, match="distance must exceed the diameter of the ball"):
        with_constants(device, distance=0.004)
    with pytest.raises(ValueError, match="s and distance give the same quantity"):
        cells({"distance": 0.1, "s": 0.1}, device, "soft")
    with pytest.raises(TypeError, match="a distance D apart have s = D - 2 r_b, the free travel of the ball"):
        Harvester(distance=0.014)


def test_integer_constants_of_a_device_are_converted_to_floats():
    made = Harvester(V=1500, s=[1, 2], penetration_limit=1)
    assert isinstance(made.V, float)
    assert made.s.dtype == np.float64
    assert isinstance(with_constants(made, k=560, V_left=1000).V.left, float)
    slope = jax.grad(lambda device: device.V * device.R0)(Harvester(V=1500))
    assert (float(slope.V), float(slope.R0)) == (0.0063, 1500.0)
    assert isinstance(HuntCrossley(1, 2, 3).chi, float)
    assert isinstance(Hyperelastic(2, 1, 9).prestretch, float)


@pytest.mark.parametrize(("name", "advice"), [("s", "give s as an axis"), ("m_b", "m_b is no axis")])
def test_errors_for_array_constants_contain_advice(name, advice):
    several = Harvester(**{name: np.array([0.003, 0.004])})
    message = rf"device.{name} must be one number; got shape \(2,\); {advice}, or make a call for each device"
    with pytest.raises(ValueError, match=message):
        sweep(device=several)


def test_a_diagram_may_be_along_any_parameter():
    with pytest.raises(ValueError, match=f"along must be among {', '.join(PARAMETERS)}; got 'u0'"):
        plan("u0", [0.1, 0.2], {})


def test_the_table_can_be_imported_without_jax():
    source = Path(quantities.__file__).read_text()
    assert not re.findall(r"^(?:import|from) (?:jax|numpy|vijax)", source, re.MULTILINE)


def test_the_error_for_an_unknown_constant_lists_the_constants():
    with pytest.raises(TypeError, match=r"mass must be a constant of the device; known are m_b, .*limit$"):
        Harvester(mass=1.0)
    with pytest.raises(TypeError, match=r"a membrane of stiffness k has omega0 = sqrt\(k/m_b\)$"):
        Harvester(k=3.0)
