"""Settings of maps: functions reject the settings that they do not use; defaults have a single definition."""

import dataclasses
import inspect
import re

import pytest

import vijax
from vijax.impact.method_choice import method_attributes
from vijax.maps import basins, compare, orbit_diagram, sweep
from vijax.maps.sweep_settings import DiagramSettings, SweepSettings
from vijax.model.walls.laws import HuntCrossley

PLANE = {"d": 0.2, "kappa": [30.0, 40.0]}
# Another value for every setting of a sweep, together with the settings that it requires.
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
# The settings of a sweep that the planning functions use.
PLANNERS = {
    "sweep": (lambda chosen: sweep.plan(PLANE, settings=chosen), set(OTHERS)),
    "compare": (lambda chosen: compare.plan(PLANE, settings=chosen), {"periods", "until", "transient", "dtype"}),
    "basins": (lambda chosen: basins.plan_basins(PLANE, settings=chosen), {"periods", "wall"}),
    "fractions": (lambda chosen: basins.plan_fractions(PLANE, settings=chosen), {"periods", "wall"}),
}


@pytest.mark.parametrize("planner", PLANNERS)
def test_planners_reject_the_settings_that_they_do_not_use(planner):
    plan, read = PLANNERS[planner]
    refused = set()
    for name, chosen in OTHERS.items():
        if set(chosen) <= read:
            plan(SweepSettings(**chosen))
        else:
            with pytest.raises(ValueError, match="must be left out of"):
                plan(SweepSettings(**chosen))
            refused.add(name)
    assert refused == set(OTHERS) - read


def test_orbit_diagram_rejects_the_settings_that_it_does_not_use():
    read = {"periods", "wall", "dtype"}
    for name, chosen in OTHERS.items():
        if name in read:
            diagram = orbit_diagram.plan("d", [0.2, 0.3], {}, None, DiagramSettings(recorded_periods=5, **chosen))
            assert getattr(diagram.plan.settings, name) == chosen[name]
        else:
            with pytest.raises(ValueError, match="must be left out of an orbit diagram"):
                DiagramSettings(**chosen)


@pytest.mark.parametrize("name", OTHERS)
def test_arguments_of_sweep_become_settings(monkeypatch, name):
    monkeypatch.setattr(sweep, "run", lambda planned, *_: planned.settings)
    assert vijax.sweep(**PLANE, **OTHERS[name]) == SweepSettings(**OTHERS[name])


@pytest.mark.parametrize("name", OTHERS)
def test_settings_become_attributes_of_a_map(name):
    def attributes(chosen):
        planned = sweep.plan(PLANE, settings=SweepSettings(**chosen))
        return planned.settings.dataset_attributes | method_attributes(planned.method)

    chosen = OTHERS[name]
    others = {other: value for other, value in chosen.items() if other != name}
    changed = attributes(chosen).items() ^ attributes(others).items()
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
def test_functions_have_the_defaults_of_the_settings(function, settings):
    fields = {field.name: field for field in dataclasses.fields(settings)}
    shared = {name: parameter for name, parameter in inspect.signature(function).parameters.items() if name in fields}
    assert {"periods"} < set(shared)
    for name, argument in shared.items():
        assert argument.default == fields[name].default, name
    if settings is SweepSettings and function is vijax.sweep:
        assert set(shared) == set(fields)


@pytest.mark.parametrize(
    ("settings", "message"),
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
def test_invalid_settings_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        SweepSettings(**settings)
    with pytest.raises(ValueError, match=message):
        vijax.sweep(**PLANE, **settings)


def test_replaced_settings_are_validated():
    with pytest.raises(ValueError, match="recorded_periods must be at most periods; got 25 of 20"):
        dataclasses.replace(DiagramSettings(), periods=20)


@pytest.mark.parametrize("settings", [SweepSettings, DiagramSettings])
def test_settings_are_documented_with_their_defaults(settings):
    entries = dict(re.findall(r"^ {4}([a-z_, ]+): (.+?)$", inspect.getdoc(settings), re.MULTILINE))
    documented = {name: text for names, text in entries.items() for name in names.split(", ")}
    defaults = {name: getattr(settings, name) for name in settings.__annotations__}
    assert set(documented) == set(defaults)
    for name, default in defaults.items():
        assert default is None or str(default) in documented[name]
