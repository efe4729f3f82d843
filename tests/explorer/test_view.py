"""What a page shows stands in its address, within bounds; what a cell is follows from the map; recipes say it again."""

import shlex
from urllib.parse import parse_qsl

import numpy as np
import pytest

import vijax
from tests.helpers import no_cell_runs
from vijax.cli.main import main
from vijax.explorer import answers, recipes, view
from vijax.explorer.branch import CellBranch
from vijax.explorer.plane import cell, explored
from vijax.explorer.view import View

COORDINATES = ("d", "kappa", "r", "gamma", "u0", "v0")


def unrun(**axes):
    """Make a map without running it: what a cell is does not depend on what it does."""
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
    """A map over quantities of the device, of which the nondimensional ones all vary."""
    omega, device = np.pi * np.array([1.0, 4.0, 9.0]), vijax.Harvester(V=1500.0)
    return unrun(omega=omega, omega0=[40.0, 400.0], A=[1.0, 2.0], s=0.2, beta=0.1, device=device)


def test_a_view_is_restored_by_its_address(plane):
    shown = View("label", "log", (3, 1), {"r": 0.43210987654321, "v0": -0.25}, "d", ("branch",), True)
    assert view.from_query(plane, dict(parse_qsl(view.query(shown)))) == shown


def test_an_address_without_a_query_opens_on_the_best_cell_that_is_admissible(power):
    some = power.assign(admissible=(power["kappa"] < 100) & (power["P"] > 0))
    column, row = view.from_query(explored(some), {}).pick
    assert some["P"].isel(d=column, kappa=row) == some["P"].where(some["admissible"]).max() < some["P"].max()


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
def test_what_an_address_cannot_say_is_refused_in_a_line(plane, name, text):
    with pytest.raises(ValueError, match="must"):
        view.from_query(plane, {name: text})


def test_every_cell_is_that_of_the_map(power, physical):
    for dataset in (power, physical):
        plane = explored(dataset)
        (x, y), pick = (plane.x.name, plane.y.name), (1, 1)
        own = dataset.isel({x: 1, y: 1} | dict.fromkeys(plane.further, 0))
        found = cell(plane, pick, {})
        got = {name: float(getattr(found.pair, name)) for name in COORDINATES[:4]} | {"u0": found.u0, "v0": found.v0}
        assert got == pytest.approx({name: float(own[name]) for name in COORDINATES}, rel=1e-14)
        again = unrun(device=found.device, **found.settings, **found.arguments)
        assert float(found.device.V) == dataset.attrs["harvester_V"]
        assert float(again["P"]) == pytest.approx(float(own["P"]), rel=1e-12)


def test_a_further_axis_and_what_is_fixed_can_be_moved(physical):
    plane = explored(physical)
    assert set(plane.fixed) == {"s", "r", "beta"}
    assert set(view.bounds(plane)) == {"s", "r", "beta", "u0", "v0", "A"}
    found = cell(plane, (0, 1), {"A": 2.0, "s": 0.1})
    assert float(found.pair.d) == pytest.approx(0.1 / (2.0 * np.pi**2) * np.pi**2)
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
def test_what_cannot_be_looked_into_is_said_at_the_door(power, changed, must):
    with pytest.raises(ValueError, match=must):
        explored(changed(power))


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        (("low", "high"), "it ends at the low end of the range and at the high end of the range."),
        (("high", "high"), "it ends at the high end of the range, either way."),
        (("closed", "closed"), "it is closed."),
        (("grazing flight", "points"), "it ends at a grazing flight and after 600 orbits."),
    ],
)
def test_how_a_branch_ends_is_a_sentence(ends, said):
    met = (("fold", 0.2, 0.1), ("fold", 0.2, 0.3), ("flip", 0.1, 0.1))
    found = CellBranch("kappa", (), met, ends, None)
    assert answers.branch_text(found) == f"The branch has folds at \u03ba = 0.2; {said}"
    assert answers.branch_rows(found) == [["met", "\u03ba"], ["flip", "0.1"], ["fold", "0.2"]]


@pytest.mark.long
def test_the_lines_to_copy_give_what_the_page_shows(physical, tmp_path, capsys, monkeypatch):
    from vijax.explorer.motion import motion

    monkeypatch.chdir(tmp_path)
    plane = explored(physical)
    found = cell(plane, (1, 1), {"r": 0.6})
    moved = motion(found)
    recipe = recipes.of_motion(found, moved)
    made: dict = {}
    exec(recipe.python, made)
    assert float(made["found"]["P"]) == moved.numbers["P"]
    assert (float(made["end"].u_strobe), float(made["end"].v_strobe)) == moved.end
    flown = vijax.trajectory(found.pair, found.u0, found.v0, periods=400).states
    assert moved.end == pytest.approx((float(flown.u[-1]), float(flown.v[-1])), abs=1e-9)
    if moved.orbit is not None:
        assert np.array_equal(np.asarray(made["orbit"].multipliers), np.asarray(moved.orbit.multipliers))
    rows = dict(answers.cell_rows(found, moved))
    assert rows["P"].startswith(f"{float(made['found']['P']):.6g} J per half period")
    assert rows["power"] == f"{float(made['found']['power']):.6g} W"
    assert rows["penetration"].startswith(f"{1e3 * float(made['found']['max_penetration']):.6g} mm (limit 6.3 mm)")
    assert rows["label"] == moved.name
    if moved.orbit is not None:
        first = complex(np.asarray(made["orbit"].multipliers)[0, 0])
        assert rows["multipliers"].startswith(f"{first.real:.6g}")
    assert main([*shlex.split(recipe.command)[1:], "--out", "cell.zarr"]) == 0
    assert f"{moved.numbers['P']:.6g}" in capsys.readouterr().out
