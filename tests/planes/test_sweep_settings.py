"""Settings of planes: who reads which, that a door refuses what it would not read, and one place for every default."""

import dataclasses
import inspect
import re

import pytest

import vijax
from vijax.engine.method_choice import record
from vijax.model.laws import HuntCrossley
from vijax.planes import basins, compare, orbit_diagram, sweep
from vijax.planes.sweep_settings import DiagramSettings, SweepSettings

PLANE = {"d": 0.2, "kappa": [30.0, 40.0]}
# Another value for every setting of a sweep, with what it wants besides.
OTHERS = {
    "periods": {"periods": 7},
    "until": {"until": "window"},
    "transient": {"transient": 5, "until": "window"},
    "wall": {"wall": "rigid"},
    "method": {"method": "rk4"},
    "solver": {"solver": "Dopri8", "method": "ode"},
    "rtol": {"rtol": 1e-6, "method": "ode"},
    "atol": {"atol": 1e-7, "method": "ode"},
    "membrane": {"membrane": HuntCrossley(0.5), "method": "ode"},
    "steps": {"steps": 50, "method": "rk4"},
    "dtype": {"dtype": "float32"},
}
# What each door reads of a sweep's settings.
DOORS = {
    "sweep": (lambda chosen: sweep.plan(PLANE, settings=chosen), set(OTHERS)),
    "compare": (lambda chosen: compare.plan(PLANE, settings=chosen), {"periods", "until", "transient", "dtype"}),
    "basins": (lambda chosen: basins.plan_basins(PLANE, settings=chosen), {"periods", "wall"}),
    "fractions": (lambda chosen: basins.plan_fractions(PLANE, settings=chosen), {"periods", "wall"}),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_door_refuses_the_settings_that_it_does_not_read(door):
    plan, read = DOORS[door]
    refused = set()
    for name, chosen in OTHERS.items():
        if set(chosen) <= read:
            plan(SweepSettings(**chosen))
        else:
            with pytest.raises(ValueError, match="must be left out of"):
                plan(SweepSettings(**chosen))
            refused.add(name)
    assert refused == set(OTHERS) - read


def test_a_diagram_refuses_the_settings_that_it_does_not_read():
    read = {"periods", "wall", "dtype"}
    for name, chosen in OTHERS.items():
        if name in read:
            asked = orbit_diagram.plan("d", [0.2, 0.3], {}, None, DiagramSettings(recorded_periods=5, **chosen))
            assert getattr(asked.planned.settings, name) == chosen[name]
        else:
            with pytest.raises(ValueError, match="must be left out of an orbit diagram"):
                DiagramSettings(**chosen)


@pytest.mark.parametrize("name", OTHERS)
def test_every_argument_reaches_the_record(monkeypatch, name):
    monkeypatch.setattr(sweep, "run", lambda planned, *_: planned.settings)
    assert vijax.sweep(**PLANE, **OTHERS[name]) == SweepSettings(**OTHERS[name])


@pytest.mark.parametrize("name", OTHERS)
def test_every_setting_reaches_the_attributes_of_a_map(name):
    def told(chosen):
        planned = sweep.plan(PLANE, settings=SweepSettings(**chosen))
        return planned.settings.told | record(planned.method)

    chosen = OTHERS[name]
    usual = {other: value for other, value in chosen.items() if other != name}
    changed = told(chosen).items() ^ told(usual).items()
    assert name in {changed_name for changed_name, _ in changed}


@pytest.mark.parametrize(
    ("function", "settings"),
    [
        (vijax.sweep, SweepSettings),
        (vijax.compare, SweepSettings),
        (vijax.basins, SweepSettings),
        (vijax.basin_fractions, SweepSettings),
        (vijax.orbit_diagram, DiagramSettings),
    ],
)
def test_a_function_takes_the_defaults_and_types_of_the_record(function, settings):
    fields = {field.name: field for field in dataclasses.fields(settings)}
    shared = {name: one for name, one in inspect.signature(function).parameters.items() if name in fields}
    assert {"periods"} < set(shared)
    for name, argument in shared.items():
        assert argument.default == fields[name].default, name
    if settings is SweepSettings and function is vijax.sweep:
        assert set(shared) == set(fields)


@pytest.mark.parametrize(
    ("wrong", "say"),
    [
        ({"periods": 0}, "periods must be a whole number of at least 1; got 0"),
        ({"periods": 2**53}, "periods must be a whole number of at most 1,000,000,000"),
        ({"periods": 2**23 + 1, "dtype": "float32"}, "periods must be a whole number of at most 8,388,608"),
        ({"transient": 5}, "transient must be 0 with until='attractor', whose search begins at once; got 5"),
        ({"until": "never"}, 'until must be "attractor" or "window"'),
        ({"steps": 50}, "steps must be left out unless method is"),
        ({"wall": "rigid", "method": "rk4"}, 'wall must be "soft" for method="rk4"'),
    ],
)
def test_a_record_holds_only_what_can_be(wrong, say):
    with pytest.raises(ValueError, match=say):
        SweepSettings(**wrong)
    with pytest.raises(ValueError, match=say):
        vijax.sweep(**PLANE, **wrong)


def test_a_changed_record_is_checked_again():
    with pytest.raises(ValueError, match="recorded_periods must be at most periods; got 25 of 20"):
        dataclasses.replace(DiagramSettings(), periods=20)


@pytest.mark.parametrize("settings", [SweepSettings, DiagramSettings])
def test_every_setting_is_documented_with_its_default(settings):
    said = dict(re.findall(r"^ {4}([a-z_, ]+): (.+?)$", inspect.getdoc(settings), re.MULTILINE))
    documented = {name: text for names, text in said.items() for name in names.split(", ")}
    own = {name: getattr(settings, name) for name in settings.__annotations__}
    assert set(documented) == set(own)
    for name, default in own.items():
        assert default is None or str(default) in documented[name]
