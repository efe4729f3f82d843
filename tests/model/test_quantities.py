"""The table of quantities: whoever speaks of a quantity finds it there, and what it says is what the package does."""

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
from vijax.model import quantities, variables
from vijax.model.device import LIMITS, Harvester, with_constants
from vijax.model.pair import ImpactPair
from vijax.orbits.parameter import MOVED
from vijax.planes.axes import Axes, Parameters, parse_axis
from vijax.planes.cells import cells
from vijax.planes.orbit_diagram import plan
from vijax.plots import branch_diagrams, orbit_diagrams

AXES, PARAMETERS, QUANTITIES = quantities.AXES, quantities.PARAMETERS, quantities.QUANTITIES
CONSTANTS = [field.name for field in dataclasses.fields(Harvester)]
PAGES = [command.vijax.get_command(click.Context(command.vijax), name) for name in command.vijax.list_commands(None)]


def test_every_axis_and_every_constant_of_the_device_is_in_the_table():
    assert list(Parameters.__annotations__) == list(PARAMETERS)
    assert set(Axes.__annotations__) == set(AXES)
    assert {field.name for field in dataclasses.fields(ImpactPair)} - {"law", "waves"} < set(PARAMETERS)
    of_walls = {f"{name}_{side}" for name in ("omega0", "r") for side in quantities.SIDES}
    assert of_walls < set(AXES)
    assert set(QUANTITIES) == set(AXES) | set(CONSTANTS)
    given_only = {name for name, one in QUANTITIES.items() if one.given_only}
    assert set(variables.NAMES) == set(QUANTITIES) - set(quantities.STARTS) - set(LIMITS) - given_only
    assert set(MOVED) == set(PARAMETERS) - given_only
    assert all(name == one.name for name, one in QUANTITIES.items())
    with pytest.raises(TypeError, match=f"the axes are {', '.join(AXES)}"):
        cells({"colour": 1.0}, Harvester(), "soft")


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name not in ("docs", "doctor", "explore")], ids=lambda page: page.name
)
def test_every_option_that_takes_values_is_an_axis_and_says_what_the_table_says(page):
    options = {option.name: option for option in page.params if option.metavar == "VALUES"}
    assert list(options) in (list(AXES), list(PARAMETERS))
    for name, option in options.items():
        assert option.opts == [f"--{name}"]
        unit = f", {AXES[name].unit}" if AXES[name].unit else ""
        assert option.help.partition(" [")[0] == AXES[name].long_name + unit


@pytest.mark.parametrize("page", [page for page in PAGES if any(one.name == "quantity" for one in page.params)])
def test_every_quantity_that_a_picture_shows_is_in_the_table(page):
    (option,) = [one for one in page.params if one.name == "quantity"]
    rooms = {"orbit-diagram": orbit_diagrams.check_quantity, "branch": branch_diagrams.check_branch_quantity}
    for name in option.type.choices:
        assert quantities.MEASURED[name].label
        rooms[page.name](name)


def test_what_has_a_unit_is_given_by_the_device():
    """An option whose name is physical makes the plane the device's."""
    from vijax.cli.options import DEVICE, PHYSICAL

    of_walls = {f"{name}_{side}" for name in ("omega0", "k") for side in quantities.SIDES}
    assert {"omega", "A", "beta", "s", "distance", "omega0", "k"} | of_walls == DEVICE
    assert {"s", "distance", "omega0", "k"} | of_walls == PHYSICAL


@pytest.mark.parametrize("name", [name for name, axis in PARAMETERS.items() if axis.default])
def test_a_default_is_that_of_the_device(name):
    assert parse_axis(name, AXES[name].default) == pytest.approx(float(variables.value_of(Harvester(), name)))


def test_a_start_that_is_not_given_is_the_one_of_the_table():
    narrow, wide = (cells({"d": d}, Harvester(), "soft").quantities for d in (0.1, 0.3))
    u0, v0 = (float(text) for text in re.fullmatch(r"min\((.+), .+\) (.+)", " ".join(_starts())).groups())
    assert (float(wide["u0"]), float(wide["v0"])) == (u0, v0)
    assert AXES["u0"].default == f"min({u0}, {float(narrow['u0']) / 0.1:g} d)"


def _starts():
    return [axis.default for axis in quantities.STARTS.values()]


@pytest.mark.parametrize("name", variables.ALIASES)
def test_another_name_of_a_constant_decides_it(name):
    """The device of a map is the same by whatever name it is given, and two of them are refused."""
    device = Harvester(beta=0.02)
    value, constant = float(variables.value_of(device, name)), AXES[name].constant
    whole = quantities.of_both_walls(name)
    usual, asked = (
        cells(given, device, "soft").quantities for given in ({f"{whole}_left": value} if whole else {}, {name: value})
    )
    for one in ("d", "gamma", *(("kappa_left", "kappa_right") if whole else ("kappa",))):
        assert float(asked[one]) == pytest.approx(float(usual[one]), rel=1e-12)
    assert constant in quantities.synonyms(name)
    made = variables.tuned(device, (name,), variables.variables((name,), [1.1 * value]))
    assert float(variables.value_of(made, name)) == pytest.approx(1.1 * value, rel=1e-12)
    with pytest.raises(ValueError, match="give the same quantity; give one of them"):
        cells({name: value, constant: 0.1}, device, "soft")


@pytest.mark.parametrize("name", [name for name, one in QUANTITIES.items() if one.unit])
def test_docstrings_name_the_units_of_the_table(name):
    whole = quantities.of_both_walls(name) or name
    said = re.search(rf"^ +{whole}: .*\[(.+?)\]", inspect.getdoc(Harvester), re.MULTILINE)
    if whole in ("k", "distance"):
        assert name not in CONSTANTS
        said = re.search(r"\[(.+?)\]", inspect.getdoc(getattr(Harvester, whole).fget))
    assert said[1] == QUANTITIES[name].unit


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
def test_rules_hold_at_their_ends(name):
    good, bad = EDGES[name]
    quantities.check(name, good)
    quantities.check(name, np.array(good, np.float32)[-1:])
    for value in bad:
        rule = QUANTITIES[name].rule.must
        with pytest.raises(ValueError, match=rf"here {re.escape(rule)}; got \S+ at index 1; "):
            quantities.check(name, [good[-1], value], "here")


def test_no_error_lacks_a_remedy():
    for name, one in QUANTITIES.items():
        assert one.remedy == one.remedy.strip()
        assert not one.remedy.endswith(" in"), f"{name} has no unit and no advice"


def test_membranes_are_a_diameter_further_apart_than_the_ball_travels():
    device = Harvester(r_b=0.004)
    asked, plain = (
        cells(given, device, "soft").quantities["d"] for given in ({"distance": [0.05, 0.06]}, {"s": [0.042, 0.052]})
    )
    np.testing.assert_allclose(asked, plain, rtol=1e-14)
    assert asked.dims == ("distance",)
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


def test_whole_numbers_of_a_device_have_derivatives():
    made = Harvester(V=1500, s=[1, 2], penetration_limit=1)
    assert isinstance(made.V, float)
    assert made.s.dtype == np.float64
    assert isinstance(with_constants(made, k=560, V_left=1000).V.left, float)
    slope = jax.grad(lambda device: device.V * device.R0)(Harvester(V=1500))
    assert (float(slope.V), float(slope.R0)) == (0.0063, 1500.0)
    assert isinstance(HuntCrossley(1, 2, 3).chi, float)
    assert isinstance(Hyperelastic(2, 1, 9).prestretch, float)


@pytest.mark.parametrize(("name", "advice"), [("s", "give s as an axis"), ("m_b", "m_b is no axis")])
def test_a_device_of_several_is_refused_with_what_can_be_done(name, advice):
    several = Harvester(**{name: np.array([0.003, 0.004])})
    message = rf"device.{name} must be one number; got shape \(2,\); {advice}, or make a call for each device"
    with pytest.raises(ValueError, match=message):
        sweep(device=several)


def test_a_diagram_may_be_along_every_parameter():
    with pytest.raises(ValueError, match=f"along must be among {', '.join(PARAMETERS)}; got 'u0'"):
        plan("u0", [0.1, 0.2], {})


def test_the_table_is_had_without_jax():
    source = Path(quantities.__file__).read_text()
    assert not re.findall(r"^(?:import|from) (?:jax|numpy|vijax)", source, re.MULTILINE)


def test_a_name_that_is_no_constant_is_refused_with_those_that_are():
    with pytest.raises(TypeError, match=r"mass must be a constant of the device; known are m_b, .*limit$"):
        Harvester(mass=1.0)
    with pytest.raises(TypeError, match=r"a membrane of stiffness k has omega0 = sqrt\(k/m_b\)$"):
        Harvester(k=3.0)
