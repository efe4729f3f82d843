"""The command and the code of a recipe call the function of their panel with the same arguments."""

import shlex
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax.cli.main import vijax as commands
from vijax.explorer import view
from vijax.explorer.analyses import basin, branch, line, optimum, recipes, results
from vijax.explorer.plane import cell, explored
from vijax.explorer.source import Source


class CalledError(Exception):
    """Raised by a replaced function, which is called but does not run."""


@pytest.fixture
def record_calls(monkeypatch):
    """Replace a function, in the module of a panel and in `vijax`, by a function that records its arguments."""
    calls = []

    def record(*args, **named):
        named.pop("progress", None)
        calls.append((args, {name: value for name, value in named.items() if name != "device"}, named.get("device")))
        raise CalledError

    def replace(module, name, public):
        monkeypatch.setattr(module, name, record)
        monkeypatch.setattr(vijax, public, record, raising=False)
        return calls

    return replace


@pytest.fixture(scope="module")
def plane_and_cell():
    """Plane and cell of a map over quantities of a device with constants other than the defaults."""
    with no_cell_runs():
        axes = {"s": np.linspace(0.1, 0.3, 3), "omega0": np.geomspace(40, 400, 3), "beta": -0.1, "r": 0.6}
        dataset = vijax.sweep(**axes, omega=4.0, device=vijax.Harvester(V=1500.0), periods=500)
    plane = explored(dataset)
    return plane, cell(plane, (1, 2), {})


def same(calls) -> None:
    """Check that the recipe makes the same call as the panel."""
    (args, named, device), (recipe_args, recipe_named, recipe_device) = calls
    assert list(map(str, args)) == list(map(str, recipe_args))
    np.testing.assert_equal(recipe_named, {name: value for name, value in named.items() if name in recipe_named})
    assert {name: value for name, value in named.items() if name not in recipe_named} == {
        name: recipes._DEFAULTS[name] for name in set(named) - set(recipe_named)
    }
    if recipe_device is not None and device is not None:
        # Other constants are specified by the axes.
        assert (recipe_device.V, recipe_device.m_b) == (device.V, device.m_b) == (1500.0, vijax.Harvester().m_b)


def read(command: str) -> dict:
    """Return the parameters of a command without running it."""
    _, name, *words = shlex.split(command)
    page = commands.get_command(None, name)
    return page.make_context(name, words).params


def test_recipe_of_a_line(plane_and_cell, record_calls):
    plane, picked = plane_and_cell
    calls = record_calls(line, "orbit_diagram", "orbit_diagram")
    with pytest.raises(CalledError):
        line.line(picked, plane.y, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_line(picked, plane.y).python, {})
    same(calls)


def test_recipe_of_a_basin(plane_and_cell, record_calls):
    _, picked = plane_and_cell
    calls = record_calls(basin, "basins", "basins")
    with pytest.raises(CalledError):
        basin.basin(picked, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_basin(picked).python, {})
    same(calls)


def test_recipe_of_an_optimum(plane_and_cell, record_calls):
    plane, picked = plane_and_cell
    calls = record_calls(optimum, "optimise", "optimise")
    with pytest.raises(CalledError):
        optimum.optima(picked, plane.y)
    with pytest.raises(CalledError):
        exec(recipes.of_optimum(picked, plane.y).python, {})
    ((device,), named, _), ((recipe_device,), recipe_named, _) = calls
    assert named == recipe_named
    for name in ("s", "omega0", "r", "A", "omega", "beta", "V", "m_b"):
        assert float(getattr(recipe_device, name)) == float(getattr(device, name))


def test_recipe_of_a_branch(plane_and_cell, record_calls):
    plane, picked = plane_and_cell
    calls = record_calls(branch, "follow_families", "follow_families")
    moved = SimpleNamespace(orbit="the orbit", numbers={"period": 1.0}, name="1:1")
    with pytest.raises(CalledError):
        branch.branch(picked, moved, plane.y)
    lines = recipes.of_branch(picked, moved, plane.y).python.splitlines()
    begin = next(number for number, text in enumerate(lines) if text.startswith("device ="))
    with pytest.raises(CalledError):
        exec("\n".join(["import vijax", *lines[begin:]]), {"orbit": "the orbit"})
    ((args, named, device), (recipe_args, recipe_named, recipe_device)) = calls
    assert args == recipe_args
    assert named == recipe_named
    for name in ("A", "omega", "omega0", "V"):
        assert float(getattr(recipe_device, name)) == float(getattr(device, name))


def test_commands_are_read_with_the_arguments_of_their_panels(plane_and_cell, tmp_path):
    plane, picked = plane_and_cell
    source = Source(None)
    source.path = tmp_path / "a plane.zarr"
    first, gamma = view.first_view(plane), repr(picked.arguments["gamma"])
    beta = repr(float(picked.device.beta))
    assert gamma.startswith("-")
    assert beta.startswith("-")
    for recipe, expected in (
        (
            recipes.of_line(picked, plane.y),
            {"along": "omega0=40.0:400.0:96:log", "s": "0.2", "r": "0.6", "gamma": gamma},
        ),
        (recipes.of_basin(picked), {"s": "0.2", "omega0": "400.0", "v0": "-0.6:0.6:100"}),
        (recipes.of_optimum(picked, plane.y), {"tune": "omega0", "bounds": "omega0=40.0:400.0", "beta": beta}),
        (
            recipes.of_map(source, plane, first, False, False),
            {"s": "0.1:0.3:3", "omega0": "40.0:400.0:3:log", "show": "P"},
        ),
        (recipes.of_map(source, plane, first, False, True), {"map": str(source.path), "ground": "P"}),
        (recipes.of_map(source, plane, first, True, True), {"map": None, "s": "0.1:0.3:3", "r": "0.6"}),
    ):
        parameters = read(recipe.command)
        arguments = {
            name: value[0] if isinstance(value, tuple) else value for name, value in parameters.items() if value
        }
        assert {name: arguments.get(name) for name in expected} == expected


def test_nearest_optimum_is_first_with_its_active_limits(plane_and_cell, monkeypatch):
    plane, picked = plane_and_cell
    near = float(picked.arguments["omega0"])
    orbits = [
        SimpleNamespace(values={"omega0": near * far}, label=name, P=P, active=active, stopped=stopped)
        for far, name, P, active, stopped in (
            (0.5, "1:2", 2e-5, (), "maximum"),
            (0.9, "1:1", 1e-5, ("penetration",), "bounds"),
            (0.2, "2:2", 3e-5, (), "evaluations"),
        )
    ]
    monkeypatch.setattr(optimum, "optimise", lambda *_, **__: SimpleNamespace(orbits=orbits))
    listed = optimum.optima(picked, plane.y)
    assert [(entry.name, entry.limits) for entry in listed] == [
        ("1:1", ("penetration",)),
        ("1:2", ("interior",)),
        ("2:2", ("evaluations",)),
    ]
    rows = results.optimum_rows(plane.y, listed)
    assert rows[1] == [f"{0.9 * near:.6g}", "1:1", "1e-05", "penetration"]


def test_optimum_requires_soft_walls_and_a_tunable_axis(plane_and_cell):
    plane, picked = plane_and_cell
    with pytest.raises(ValueError, match="wall must be soft"):
        optimum.optima(replace(picked, pair=vijax.impact_pair(0.2, None, 0.5)), plane.y)
    with pytest.raises(ValueError, match="along must be an axis that a design can tune"):
        optimum.optima(picked, replace(plane.y, name="u0"))


def test_recipe_of_a_cell_with_unequal_walls(record_calls):
    device = vijax.Harvester(V=vijax.Sides(1500.0, 1700.0))
    with no_cell_runs():
        axes = {"d": np.linspace(0.1, 0.3, 3), "kappa_left": np.geomspace(40, 400, 3), "kappa_right": 60.0}
        plane = explored(vijax.sweep(**axes, r_right=0.6, device=device))
    picked = cell(plane, (1, 2), {})
    assert picked.arguments == {"d": 0.2, "kappa_left": 400.0, "kappa_right": 60.0, "gamma": 0.0, "r_left": 0.5} | {
        "r_right": 0.6,
        "omega": plane.fixed["omega"],
        "A": 1.0,
    }
    assert picked.device.V == device.V
    lines = recipes.of_motion(picked, SimpleNamespace(orbit=None)).python.splitlines()
    namespace = {}
    exec("\n".join([lines[0], *(line for line in lines if line.startswith("pair ="))]), namespace)
    for actual, expected in zip(jax.tree.leaves(namespace["pair"]), jax.tree.leaves(picked.pair), strict=True):
        assert float(actual) == float(expected)
    assert eval(recipes._device(recipes._constants(picked)), {"vijax": vijax}).V == device.V
    calls = record_calls(line, "orbit_diagram", "orbit_diagram")
    with pytest.raises(CalledError):
        line.line(picked, plane.y, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_line(picked, plane.y).python, {})
    (_, named, _), (_, again, _) = calls
    assert {name: named[name] for name in ("d", "kappa_right", "r_right")} == {
        "d": 0.2,
        "kappa_right": 60.0,
        "r_right": 0.6,
    }
    assert named["along"] == again["along"] == "kappa_left"
    words = read(recipes.of_basin(picked).command)
    assert (words["kappa_left"], words["r_right"], words["constants"]) == (
        "400.0",
        "0.6",
        ("V_left=1500.0", "V_right=1700.0"),
    )


FORMS = [
    ({"d": [0.2, 0.25], "kappa": 40.0, "r_left": [0.4, 0.5]}, {"kappa": 40.0, "r_left": 0.5, "r_right": 0.5}),
    ({"d": [0.2, 0.25], "r": 0.4, "kappa_left": [30.0, 40.0]}, {"r": 0.4, "kappa_left": 40.0, "kappa_right": 400.0}),
    ({"d": [0.2, 0.25], "wall": "rigid_right", "kappa": 40.0, "r_left": [0.4, 0.5]}, {"kappa": 40.0, "r_right": 0.5}),
    ({"d": [0.2, 0.25], "wall": "rigid", "r_left": [0.4, 0.5]}, {"kappa": 400.0, "r_left": 0.5, "r_right": 0.5}),
    ({"omega": [5.0, 6.0], "wall": "rigid", "r_left": [0.4, 0.5]}, {"s": 0.3, "omega0": 400.0, "r_left": 0.5}),
    ({"omega": [5.0, 6.0], "wall": "rigid_right", "r_left": [0.4, 0.5]}, {"s": 0.3, "omega0_left": 400.0}),
]


@pytest.mark.parametrize(("axes", "expected"), FORMS, ids=[" ".join(axes) for axes, _ in FORMS])
def test_cells_of_maps_with_all_forms_of_wall_arguments(axes, expected):
    with no_cell_runs():
        dataset = vijax.sweep(**axes)
    picked = cell(explored(dataset), (1, 1), {})
    assert {name: pytest.approx(value) for name, value in expected.items()} == {
        name: picked.arguments[name] for name in expected
    }
    assert picked.pair.walls == axes.get("wall", "soft")
    here = dataset.isel({name: 1 for name, values in axes.items() if isinstance(values, list)})
    assert float(picked.pair.d) == pytest.approx(float(here.d))
    assert float(picked.device.s) == pytest.approx(float(here.d) * float(picked.device.length_unit))
