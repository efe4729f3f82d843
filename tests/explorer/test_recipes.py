"""The command and the lines that a panel shows call what the panel has called, with the same arguments."""

import shlex
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax.cli.main import vijax as commands
from vijax.explorer import answers, basin, branch, line, optimum, recipes, view
from vijax.explorer.plane import cell, explored
from vijax.explorer.source import Source


class CalledError(Exception):
    """What a function raises that is to be called and not run."""


@pytest.fixture
def heard(monkeypatch):
    """Put something in place of a function, in a panel's room and at the top, that keeps its arguments."""
    calls = []

    def keep(*args, **named):
        named.pop("progress", None)
        calls.append((args, {name: value for name, value in named.items() if name != "device"}, named.get("device")))
        raise CalledError

    def put(room, name, public):
        monkeypatch.setattr(room, name, keep)
        monkeypatch.setattr(vijax, public, keep, raising=False)
        return calls

    return put


@pytest.fixture(scope="module")
def found():
    """A cell of a rigid and of a soft map over quantities of a device that is not the usual one."""
    with no_cell_runs():
        axes = {"s": np.linspace(0.1, 0.3, 3), "omega0": np.geomspace(40, 400, 3), "beta": -0.1, "r": 0.6}
        made = vijax.sweep(**axes, omega=4.0, device=vijax.Harvester(V=1500.0), periods=500)
    plane = explored(made)
    return plane, cell(plane, (1, 2), {})


def same(calls) -> None:
    """Compare what a panel has called with what its lines call."""
    (args, named, device), (own_args, own, own_device) = calls
    assert list(map(str, args)) == list(map(str, own_args))
    np.testing.assert_equal(own, {name: value for name, value in named.items() if name in own})
    assert {name: value for name, value in named.items() if name not in own} == {
        name: recipes._USUAL[name] for name in set(named) - set(own)
    }
    if own_device is not None and device is not None:
        # What axes say besides is theirs to say.
        assert (own_device.V, own_device.m_b) == (device.V, device.m_b) == (1500.0, vijax.Harvester().m_b)


def read(command: str) -> dict:
    """Read a command as its page does; nothing is run."""
    _, name, *words = shlex.split(command)
    page = commands.get_command(None, name)
    return page.make_context(name, words).params


def test_a_line(found, heard):
    plane, own = found
    calls = heard(line, "orbit_diagram", "orbit_diagram")
    with pytest.raises(CalledError):
        line.line(own, plane.y, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_line(own, plane.y).python, {})
    same(calls)


def test_a_basin(found, heard):
    _, own = found
    calls = heard(basin, "basins", "basins")
    with pytest.raises(CalledError):
        basin.basin(own, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_basin(own).python, {})
    same(calls)


def test_an_optimum(found, heard):
    plane, own = found
    calls = heard(optimum, "optimise", "optimise")
    with pytest.raises(CalledError):
        optimum.optima(own, plane.y)
    with pytest.raises(CalledError):
        exec(recipes.of_optimum(own, plane.y).python, {})
    ((device,), named, _), ((own_device,), own_named, _) = calls
    assert named == own_named
    for name in ("s", "omega0", "r", "A", "omega", "beta", "V", "m_b"):
        assert float(getattr(own_device, name)) == float(getattr(device, name))


def test_a_branch(found, heard):
    plane, own = found
    calls = heard(branch, "family", "follow_families")
    moved = SimpleNamespace(orbit="the orbit", numbers={"period": 1.0}, name="1:1")
    with pytest.raises(CalledError):
        branch.branch(own, moved, plane.y)
    lines = recipes.of_branch(own, moved, plane.y).python.splitlines()
    begin = next(number for number, text in enumerate(lines) if text.startswith("device ="))
    with pytest.raises(CalledError):
        exec("\n".join(["import vijax", *lines[begin:]]), {"orbit": "the orbit"})
    ((args, named, device), (own_args, own_named, own_device)) = calls
    assert args == own_args
    assert named == own_named
    for name in ("A", "omega", "omega0", "V"):
        assert float(getattr(own_device, name)) == float(getattr(device, name))


def test_commands_are_such_as_their_pages_read(found, tmp_path):
    plane, own = found
    source = Source(None)
    source.path = tmp_path / "a plane.zarr"
    first, gamma = view.first_view(plane), repr(own.arguments["gamma"])
    beta = repr(float(own.device.beta))
    assert gamma.startswith("-")
    assert beta.startswith("-")
    for recipe, told in (
        (recipes.of_line(own, plane.y), {"along": "omega0=40.0:400.0:96:log", "s": "0.2", "r": "0.6", "gamma": gamma}),
        (recipes.of_basin(own), {"s": "0.2", "omega0": "400.0", "v0": "-0.6:0.6:100"}),
        (recipes.of_optimum(own, plane.y), {"tune": "omega0", "bounds": "omega0=40.0:400.0", "beta": beta}),
        (
            recipes.of_map(source, plane, first, False, False),
            {"s": "0.1:0.3:3", "omega0": "40.0:400.0:3:log", "show": "P"},
        ),
        (recipes.of_map(source, plane, first, False, True), {"map": str(source.path), "ground": "P"}),
        (recipes.of_map(source, plane, first, True, True), {"map": None, "s": "0.1:0.3:3", "r": "0.6"}),
    ):
        found_params = read(recipe.command)
        given = {name: value[0] if isinstance(value, tuple) else value for name, value in found_params.items() if value}
        assert {name: given.get(name) for name in told} == told


def test_the_nearest_optimum_stands_first_with_what_limits_it(found, monkeypatch):
    plane, own = found
    near = float(own.arguments["omega0"])
    made = [
        SimpleNamespace(values={"omega0": near * far}, label=name, P=P, active=active, stopped=stopped)
        for far, name, P, active, stopped in (
            (0.5, "1:2", 2e-5, (), "maximum"),
            (0.9, "1:1", 1e-5, ("penetration",), "bounds"),
            (0.2, "2:2", 3e-5, (), "evaluations"),
        )
    ]
    monkeypatch.setattr(optimum, "optimise", lambda *_, **__: SimpleNamespace(orbits=made))
    listed = optimum.optima(own, plane.y)
    assert [(one.name, one.limits) for one in listed] == [
        ("1:1", ("penetration",)),
        ("1:2", ("interior",)),
        ("2:2", ("evaluations",)),
    ]
    rows = answers.optimum_rows(plane.y, listed)
    assert rows[1] == [f"{0.9 * near:.6g}", "1:1", "1e-05", "penetration"]


def test_a_rigid_cell_has_no_optimum_and_a_start_is_tuned_by_none(found):
    plane, own = found
    with pytest.raises(ValueError, match="wall must be soft"):
        optimum.optima(replace(own, pair=vijax.impact_pair(0.2, None, 0.5)), plane.y)
    with pytest.raises(ValueError, match="along must be an axis that a design can tune"):
        optimum.optima(own, replace(plane.y, name="u0"))


def test_a_cell_of_walls_that_differ_is_had_again_by_wall(heard):
    device = vijax.Harvester(V=vijax.Sides(1500.0, 1700.0))
    with no_cell_runs():
        axes = {"d": np.linspace(0.1, 0.3, 3), "kappa_left": np.geomspace(40, 400, 3), "kappa_right": 60.0}
        plane = explored(vijax.sweep(**axes, r_right=0.6, device=device))
    own = cell(plane, (1, 2), {})
    assert own.arguments == {"d": 0.2, "kappa_left": 400.0, "kappa_right": 60.0, "gamma": 0.0, "r_left": 0.5} | {
        "r_right": 0.6,
        "omega": plane.fixed["omega"],
        "A": 1.0,
    }
    assert own.device.V == device.V
    lines = recipes.of_motion(own, SimpleNamespace(orbit=None)).python.splitlines()
    told = {}
    exec("\n".join([lines[0], *(line for line in lines if line.startswith("pair ="))]), told)
    for mine, theirs in zip(jax.tree.leaves(told["pair"]), jax.tree.leaves(own.pair), strict=True):
        assert float(mine) == float(theirs)
    assert eval(recipes._device(recipes._constants(own)), {"vijax": vijax}).V == device.V
    calls = heard(line, "orbit_diagram", "orbit_diagram")
    with pytest.raises(CalledError):
        line.line(own, plane.y, lambda done, total: None)
    with pytest.raises(CalledError):
        exec(recipes.of_line(own, plane.y).python, {})
    (_, named, _), (_, again, _) = calls
    assert {name: named[name] for name in ("d", "kappa_right", "r_right")} == {
        "d": 0.2,
        "kappa_right": 60.0,
        "r_right": 0.6,
    }
    assert named["along"] == again["along"] == "kappa_left"
    words = read(recipes.of_basin(own).command)
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


@pytest.mark.parametrize(("axes", "wanted"), FORMS, ids=[" ".join(axes) for axes, _ in FORMS])
def test_a_cell_is_opened_however_its_walls_were_given(axes, wanted):
    with no_cell_runs():
        made = vijax.sweep(**axes)
    own = cell(explored(made), (1, 1), {})
    assert {name: pytest.approx(value) for name, value in wanted.items()} == {
        name: own.arguments[name] for name in wanted
    }
    assert own.pair.walls == axes.get("wall", "soft")
    here = made.isel({name: 1 for name, values in axes.items() if isinstance(values, list)})
    assert float(own.pair.d) == pytest.approx(float(here.d))
    assert float(own.device.s) == pytest.approx(float(here.d) * float(own.device.length_unit))
