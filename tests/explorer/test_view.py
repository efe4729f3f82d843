"""The address of a page contains its view within bounds, cells follow from the map, and recipes reproduce them."""

import shlex
from urllib.parse import parse_qsl

import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax.cli.main import main
from vijax.explorer import view
from vijax.explorer.analyses import recipes, results
from vijax.explorer.analyses.branch import CellBranch
from vijax.explorer.plane import cell, explored
from vijax.explorer.view import View

COORDINATES = ("d", "kappa", "r", "gamma", "u0", "v0")


def unrun(**axes):
    """Return a map without cell runs; the definition of a cell does not depend on its results."""
    with no_cell_runs():
        return vijax.sweep(**axes)


@pytest.fixture(scope="module")
def power():
    """A small map, P over d and kappa."""
    return unrun(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4))


@pytest.fixture(scope="module")
def plane(power):
    return explored(power)


@pytest.fixture(scope="module")
def physical():
    """Map over quantities of the device in which all nondimensional quantities vary."""
    omega, device = np.pi * np.array([1.0, 4.0, 9.0]), vijax.Harvester(V=1500.0)
    return unrun(omega=omega, omega0=[40.0, 400.0], A=[1.0, 2.0], s=0.2, beta=0.1, device=device)


def test_a_view_is_restored_by_its_address(plane):
    page_view = View("label", "log", (3, 1), {"r": 0.43210987654321, "v0": -0.25}, "d", ("branch",), True)
    assert view.from_query(plane, dict(parse_qsl(view.query(page_view)))) == page_view


def test_default_pick_is_the_best_admissible_cell(power):
    dataset = power.assign(admissible=(power["kappa"] < 100) & (power["P"] > 0))
    column, row = view.from_query(explored(dataset), {}).pick
    assert (
        dataset["P"].isel(d=column, kappa=row) == dataset["P"].where(dataset["admissible"]).max() < dataset["P"].max()
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cell", "4,0"),
        ("cell", "-1,0"),
        ("cell", "x"),
        ("r", "1.5"),
        ("r", "nan"),
        ("gamma", "many"),
        ("variable", "<b>"),
        ("scale", "cubic"),
        ("along", "r"),
        ("open", "all"),
        ("beta", "0.1"),
    ],
)
def test_invalid_address_raises(plane, name, text):
    with pytest.raises(ValueError, match="must"):
        view.from_query(plane, {name: text})


def test_cells_agree_with_the_map(power, physical):
    for dataset in (power, physical):
        plane = explored(dataset)
        (x, y), pick = (plane.x.name, plane.y.name), (1, 1)
        map_cell = dataset.isel({x: 1, y: 1} | dict.fromkeys(plane.further, 0))
        picked = cell(plane, pick, {})
        actual = {name: float(getattr(picked.pair, name)) for name in COORDINATES[:4]} | {
            "u0": picked.u0,
            "v0": picked.v0,
        }
        assert actual == pytest.approx({name: float(map_cell[name]) for name in COORDINATES}, rel=1e-14)
        again = unrun(device=picked.device, **picked.settings, **picked.arguments)
        assert float(picked.device.V) == dataset.attrs["harvester_V"]
        assert float(again["P"]) == pytest.approx(float(map_cell["P"]), rel=1e-12)


def test_further_axes_and_fixed_quantities_can_change(physical):
    plane = explored(physical)
    assert set(plane.fixed) == {"s", "r", "beta"}
    assert set(view.bounds(plane)) == {"s", "r", "beta", "u0", "v0", "A"}
    picked = cell(plane, (0, 1), {"A": 2.0, "s": 0.1})
    assert float(picked.pair.d) == pytest.approx(0.1 / (2.0 * np.pi**2) * np.pi**2)
    assert plane.slices({"A": 2.0}) == {"A": 1}
    assert plane.differs({"A": 2.0}) == ()
    assert plane.differs({"s": 0.1}) == ("s",)


@pytest.mark.parametrize(
    ("changed", "must"),
    [
        (lambda power: power.isel(kappa=[0]), "two axes of more than one value; got d"),
        (lambda power: power.assign_attrs(until="window"), "until='attractor'"),
        (lambda power: power.assign_attrs(method="rk4"), "method='exact'"),
        (lambda power: power.assign_attrs(excitation="harmonics 1.0, 0.3"), "excitation='sine'"),
        (lambda power: power.rename(kappa="pressure"), "must be a map that vijax.sweep made"),
        (lambda power: power.assign_attrs(periods=10**9), "1 to 100,000 periods, .*; got 1,000,000,000"),
        (lambda power: 3, "dataset must be"),
    ],
)
def test_unsuitable_datasets_raise(power, changed, must):
    with pytest.raises(ValueError, match=must):
        explored(changed(power))


@pytest.mark.parametrize(
    ("ends", "sentence"),
    [
        (("low", "high"), "it ends at the low end of the range and at the high end of the range."),
        (("high", "high"), "it ends at the high end of the range, either way."),
        (("closed", "closed"), "it is closed."),
        (("grazing flight", "points"), "it ends at a grazing flight and after 600 orbits."),
    ],
)
def test_ends_of_a_branch_are_a_sentence(ends, sentence):
    events = (("fold", 0.2, 0.1), ("fold", 0.2, 0.3), ("flip", 0.1, 0.1))
    cell_branch = CellBranch("kappa", (), events, ends, None)
    assert results.branch_text(cell_branch) == f"The branch has folds at \u03ba = 0.2; {sentence}"
    assert results.branch_rows(cell_branch) == [["event", "\u03ba"], ["flip", "0.1"], ["fold", "0.2"]]


@pytest.mark.long
def test_recipe_reproduces_the_panel_of_a_motion(physical, tmp_path, capsys, monkeypatch):
    from vijax.explorer.analyses.motion import motion

    monkeypatch.chdir(tmp_path)
    plane = explored(physical)
    picked = cell(plane, (1, 1), {"r": 0.6})
    moved = motion(picked)
    recipe = recipes.of_motion(picked, moved)
    namespace: dict = {}
    exec(recipe.python, namespace)
    assert float(namespace["result"]["P"]) == moved.numbers["P"]
    assert (float(namespace["end"].u_strobe), float(namespace["end"].v_strobe)) == moved.end
    states = vijax.trajectory(picked.pair, picked.u0, picked.v0, periods=400).states
    assert moved.end == pytest.approx((float(states.u[-1]), float(states.v[-1])), abs=1e-9)
    if moved.orbit is not None:
        assert np.array_equal(np.asarray(namespace["orbit"].multipliers), np.asarray(moved.orbit.multipliers))
    rows = dict(results.cell_rows(picked, moved))
    assert rows["P"].startswith(f"{float(namespace['found']['P']):.6g} J per half period")
    assert rows["power"] == f"{float(namespace['found']['power']):.6g} W"
    assert rows["penetration"].startswith(f"{1e3 * float(namespace['found']['max_penetration']):.6g} mm (limit 6.3 mm)")
    assert rows["label"] == moved.name
    if moved.orbit is not None:
        first = complex(np.asarray(namespace["orbit"].multipliers)[0, 0])
        assert rows["multipliers"].startswith(f"{first.real:.6g}")
    assert main([*shlex.split(recipe.command)[1:], "--out", "cell.zarr"]) == 0
    assert f"{moved.numbers['P']:.6g}" in capsys.readouterr().out
