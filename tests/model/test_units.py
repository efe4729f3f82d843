"""Units: conversion to SI in every public function that takes physical quantities, and rejected units."""

import math
import sys
import types
from typing import Any

import numpy as np
import pint
import pytest

import vijax
from scripts import orbit_diagram as diagram_script
from vijax.continuation import branch_continuation
from vijax.maps import axes, map_dataset, orbit_diagram, sweep
from vijax.model import quantities, tuned_quantities, units
from vijax.model.device import CONSTANTS, Harvester, with_constants
from vijax.model.pair import impact_pair
from vijax.orbits import orbit_search

U = pint.UnitRegistry()
HZ = 2 * math.pi


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("omega", "5Hz", 5 * HZ),
        ("omega", "0.005 kHz", 5 * HZ),
        ("omega", "60rpm", HZ),
        ("omega", "6pi rad/s", 6 * math.pi),
        ("omega", "6pi", 6 * math.pi),
        ("omega0", "2Hz:10Hz:3", [2 * HZ, 6 * HZ, 10 * HZ]),
        ("omega0", "1Hz:100Hz:3:log", [HZ, 10 * HZ, 100 * HZ]),
        ("beta", "20deg", math.radians(20)),
        ("beta", "-20°", -math.radians(20)),
        ("s", "30cm", 0.3),
        ("s", "1e2mm,20cm", [0.1, 0.2]),
        ("s", "5e9picometer", 0.005),
        ("A", "981cm/s^2", 9.81),
        ("k", "0.56N/mm", 560.0),
        ("k", "5e2", 500.0),
    ],
)
def test_numbers_with_units_are_si(name, text, value):
    np.testing.assert_allclose(axes.parse_axis(name, text), value, rtol=1e-14)


def test_a_file_of_numbers_with_units(tmp_path):
    path = tmp_path / "axis"
    path.write_text("2Hz, 3Hz\n4Hz")
    np.testing.assert_allclose(axes.parse_axis("omega", f"@{path}"), np.array([2, 3, 4]) * HZ, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("omega", "5kg", "omega must be in rad/s, or in a unit of that kind; got one in kilogram"),
        ("beta", "5Hz", "beta must be in rad, .* got one in hertz"),
        ("s", "5parsnips", "s must be in m, or in a unit that pint knows; got 'parsnips'"),
        ("omega", "2:10Hz:9", "omega must have a unit at every number or at none; got '2:10Hz:9'"),
        ("s", "0.2,30cm", "s must have a unit at every number or at none"),
        ("d", "5mm", "d must be a number without a unit; got one in millimeter; with a unit there is s"),
        ("gamma", "5deg", "gamma must be a number without a unit; got one in degree; with a unit there is beta"),
        ("r", "1m", "r must be a number without a unit"),
        ("u0", "1mm", "u0 must be a number without a unit"),
        ("s", "-5mm", "s must be positive and finite; got -0.005"),
    ],
)
def test_wrong_units_are_rejected(name, text, message):
    with pytest.raises(ValueError, match=message):
        axes.parse_axis(name, text)


def test_all_constants_of_the_device_accept_their_unit():
    plain = Harvester(beta=0.1, penetration_limit=0.004)
    names = [name for name in (*CONSTANTS, "penetration_limit") if name in units.UNITS]
    scaled = {name: 1e3 * getattr(plain, name) * U.Unit(units.UNITS[name]) / 1e3 for name in names}
    for name in names:
        assert getattr(Harvester(**scaled), name) == pytest.approx(getattr(plain, name), rel=1e-14)
    assert set(CONSTANTS) - set(names) == {"r"}
    assert Harvester(omega=U.Quantity(5, "Hz")).omega == pytest.approx(5 * HZ, rel=1e-15)
    assert with_constants(plain, k=U.Quantity(0.56, "N/mm")).k == pytest.approx(560, rel=1e-14)
    with pytest.raises(ValueError, match="V must be in V, or in a unit of that kind; got one in millimeter"):
        Harvester(V=U.Quantity(1, "mm"))


def test_public_functions_convert_quantities_of_pint():
    swept = sweep.plan(
        {"omega": U.Quantity([2, 3], "Hz"), "s": [30 * U.cm, 0.4 * U.m]},
        ["P"],
    )
    np.testing.assert_allclose(swept.cells.axes["omega"], [2 * HZ, 3 * HZ], rtol=1e-14)
    np.testing.assert_allclose(swept.cells.axes["s"], [0.3, 0.4], rtol=1e-14)
    planned = orbit_diagram.plan("beta", U.Quantity([1, 2], "deg"), {})
    np.testing.assert_allclose(planned.plan.cells.axes["beta"], np.radians([1, 2]), rtol=1e-14)
    bounds = tuned_quantities.bounds_of(("omega0",), {"omega0": (2 * U.Hz, 3 * U.Hz)}, Harvester())
    np.testing.assert_allclose(bounds[:, 0], [2 * HZ, 3 * HZ], rtol=1e-14)
    harvested = vijax.harvested_energy(Harvester(), 2 * U.mm)
    assert float(harvested) == pytest.approx(float(vijax.harvested_energy(Harvester(), 0.002)), rel=1e-14)
    with pytest.raises(ValueError, match="d must be a number without a unit"):
        impact_pair(1 * U.mm, 40.0, 0.5)
    assert float(impact_pair(U.Quantity(0.2, ""), 40.0, 0.5).d) == 0.2
    with pytest.raises(ValueError, match="s must have a unit at every value or at none"):
        axes.check_axis("s", [0.3, 30 * U.cm])


def test_a_branch_between_bounds_with_units():
    orbits = orbit_search.find_orbits(Harvester(s=0.2).pair("rigid"), "RL", guesses=32)[:1]
    options = {"direction": "up", "points": 4, "device": Harvester(s=0.2)}
    with_units, plain = (
        branch_continuation.follow_orbits(orbits, "s", within, **options)[0]
        for within in ((19 * U.cm, 210 * U.mm), (0.19, 0.21))
    )
    np.testing.assert_allclose(with_units.values, plain.values, rtol=1e-12)


def test_datasets_write_the_same_units():
    written = {name: axis.cf_unit for name, axis in quantities.AXES.items()}
    assert written == dict.fromkeys(quantities.AXES, "1") | {
        **{
            "omega": "rad s-1",
            "omega0": "rad s-1",
            "s": "m",
            "distance": "m",
            "k": "N m-1",
            "A": "m s-2",
            "beta": "rad",
        },
        **{f"omega0_{side}": "rad s-1" for side in quantities.SIDES},
        **{f"k_{side}": "N m-1" for side in quantities.SIDES},
    }


def test_a_warning_if_radians_are_probably_degrees():
    with pytest.warns(UserWarning, match="beta is up to 20 rad, which is beyond pi/2; 20 degrees are 20deg"):
        Harvester(beta=20.0)
    with pytest.warns(UserWarning, match="beta is up to 20 rad"):
        axes.check_axis("beta", [0.1, -20.0])


def test_a_warning_if_gravity_causes_permanent_contact(tmp_path):
    settings: dict[str, Any] = {"d": [0.2, 0.3], "wall": "rigid", "periods": 30}
    for out in (None, tmp_path / "held.zarr"):
        with pytest.warns(UserWarning, match=r"gravity keeps the ball in permanent contact everywhere: gamma = 3.352"):
            inclined = vijax.sweep(**settings, beta=20 * U.deg, out=out)
    level = vijax.sweep(**settings, beta=0 * U.deg)
    assert (inclined.status == vijax.Status.PERMANENT_CONTACT).all()
    map_dataset.warn_if_permanent_contact(level)  # a warning would be an error


def test_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plans = []
    monkeypatch.setattr(orbit_diagram, "run", lambda planned, _: plans.append(planned) or _stop())
    chosen = ["--along", "omega=2Hz:10Hz:3", "--s", "30cm", "--set", "penetration_limit=4mm", "--set", "V=1.7kV"]
    with pytest.raises(_StopError):
        diagram_script.main(chosen)
    device = plans[0].plan.device
    assert (float(device.penetration_limit), float(device.V)) == (pytest.approx(0.004), 1700)
    np.testing.assert_allclose(plans[0].plan.cells.axes["omega"], np.array([2, 6, 10]) * HZ, rtol=1e-14)
    with pytest.raises(_StopError):
        diagram_script.main(["--along", "d=0.1:0.2:3", "--penetration-limit", "4mm", "--energy-ratio-limit", "0.1"])
    device = plans[1].plan.device
    assert (float(device.penetration_limit), device.energy_ratio_limit) == (pytest.approx(0.004), 0.1)
    assert diagram_script.main(["--energy-ratio-limit", "2"]) == 2
    assert "energy_ratio_limit must lie in (0, 1]; got 2.0; 1 admits all energy" in capsys.readouterr().err
    assert diagram_script.main(["--set", "V=2mm"]) == 2
    assert "V must be in V" in capsys.readouterr().err
    with pytest.raises(_StopError):
        diagram_script.main(["--beta", "20rad", "--along", "omega=1:2:3"])
    assert capsys.readouterr().err.count("warning: beta is up to 20 rad") == 1
    assert diagram_script.main(["--beta", "20", "--along", "omega=1:2:3"]) == 2
    assert capsys.readouterr().err.startswith("error: beta must have a unit beyond pi/2, as 20deg or 20rad; got '20'")


class _StopError(Exception):
    """Stops a script before it runs."""


def _stop():
    raise _StopError


@pytest.mark.long
def test_numbers_are_valid_while_another_thread_imports_pint(monkeypatch):
    """A module is registered before its import is complete: tracing during an import of pint by zarr once failed."""
    monkeypatch.setitem(sys.modules, "pint", types.ModuleType("pint"))
    assert units.plain_number("d", 0.2) == 0.2
    assert units.plain_number("d", [0.2, 0.3]) == [0.2, 0.3]
