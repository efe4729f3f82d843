"""Designs, and `scripts/design.py`: optima that are known, cliffs, tolerances, reports, what is refused.

In one file, as the programs compiled for the one serve the other.
"""

import dataclasses
import json
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import vijax
from scripts import design as script
from vijax.design import objective, off_design, optimise, turns
from vijax.design import robustness as around
from vijax.design.objective import Batch, Scene
from vijax.design.report import describe
from vijax.design.report_lines import lines, table
from vijax.design.tolerance import Spread, Tolerance, nodes
from vijax.design.turns import DeviceSearch
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.runtime.files import write_json

FAST = Harvester(A=3.0, omega=10 * math.pi, V=1700.0)
FAST = dataclasses.replace(FAST, s=0.2 * FAST.length_unit)
PAPER = Harvester(s=0.2)
CAREFUL = Harvester(s=0.2, energy_ratio_limit=0.05)
# Of the small fast device, by the reference.
KAPPA, ENERGY, DEPTH = 4.00713, 57.75761e-6, 6.026e-3


def kappa(optimum):
    return optimum.device.omega0 * math.pi / optimum.device.omega


@pytest.fixture(scope="module")
def found():
    """The devices in one call; with `max_impacts` as low as here little is compiled."""
    return optimise.optimise_all([FAST, PAPER, CAREFUL], survey_points=128, starts=2, max_impacts=2, motion="periodic")


def test_devices_are_designed_in_groups_whose_balls_fit(monkeypatch):
    groups: list[list[float]] = []
    nothing: Any = None

    def sought(task, *_):
        assert len(task.box) == len(task.devices)
        groups.append([one.s for one in task.devices])
        return [DeviceSearch(nothing, 0.0) for _ in task.devices]

    monkeypatch.setattr(turns, "search", sought)
    gaps = np.linspace(0.1, 0.2, 11).tolist()
    devices = [Harvester(s=s) for s in gaps]
    points = optimise._TOGETHER // (4 * 8)
    assert len(optimise.optimise_all(devices, survey_points=points, starts=8)) == 11
    assert groups == [gaps[:4], gaps[4:8], gaps[8:]]
    # With a second quantity a survey has sixteen times as many balls.
    groups.clear()
    optimise.optimise_all(devices[:3], survey_points=points // 8, starts=8, tune=("kappa", "d"))
    assert groups == [gaps[:2], gaps[2:3]]
    # In a gap that is wide, one has eight times as many.
    groups.clear()
    optimise.optimise_all([*devices[:2], Harvester(s=50.0), devices[3]], survey_points=points // 2, starts=8)
    assert groups == [gaps[:2], [50.0], gaps[3:4]]


def test_the_small_fast_device(found):
    best = found[0].best
    assert kappa(best) == pytest.approx(KAPPA, abs=1e-5)
    assert best.height == pytest.approx(ENERGY, rel=1e-7)
    assert float(best.state.depth.max()) == pytest.approx(DEPTH, abs=1e-6)
    assert float(best.state.multiplier) == pytest.approx(0.533, abs=1e-3)
    assert (best.stopped, best.active, best.label) == ("maximum", (), "1:1")
    assert abs(best.gradient["omega0"]) < 1e-5


@pytest.mark.long
def test_a_device_that_loses_its_orbit_does_not_widen_the_margins(found):
    best = found[0].best
    cloud, none = nodes((Tolerance("omega0", 0.05),), None), jnp.zeros((1, 1))
    scene = Scene(jnp.asarray(cloud.factors), jnp.asarray(cloud.weights), ("omega0",), cloud.names, "mean")
    device = jax.tree.map(lambda x: jnp.array([x], float), best.device)
    here = jnp.log(jnp.array([[best.values["omega0"]]]))
    batch = Batch(device, best.orbit.sequence, best.orbit.knots, here, none, none)
    # A device 5 % softer than this one is beyond the fold.
    beside = here + math.log(3.8 / KAPPA)
    seen = jax.jit(objective.look)(scene, batch, beside, here, objective.begin(scene, batch))
    kept = np.asarray(seen.memory.there)[0]
    margins = np.asarray(seen.margins).reshape(kept.size, -1)
    assert kept[0]
    assert not kept.all()
    np.testing.assert_array_equal(margins[~kept], np.broadcast_to(margins[0], margins[~kept].shape))
    assert (margins[kept] != margins[0]).any()


def test_the_papers_device_is_held_by_the_penetration_limit(found):
    best = found[1].best
    assert kappa(best) == pytest.approx(64.669, abs=1e-3)
    deepest = float(best.state.depth.max())
    assert deepest <= PAPER.depth_limit
    assert deepest == pytest.approx(PAPER.depth_limit, rel=1e-6)
    assert len(best.active) == 1
    assert "penetration limit" in best.active[0]
    # It would gain by breaking it.
    assert best.gradient["omega0"] < -1


def test_the_energy_ratio_limit_is_a_constraint_of_a_design(found):
    best, state = found[2].best, found[2].best.state
    assert float((state.energy / state.work).max()) == pytest.approx(CAREFUL.energy_ratio_limit, rel=1e-6)
    assert (state.energy <= CAREFUL.energy_ratio_limit * state.work).all()
    assert "energy ratio limit" in best.active[0]
    assert best.height < found[1].best.height
    said = "\n".join(lines(describe(found[2])))
    assert "harvested at most 5 % of the energy that an impact gives, of 5 % allowed" in said
    assert "held by: energy ratio limit" in said


def test_every_optimum_is_admissible_attracting_and_what_a_simulation_says(found):
    for one in [optimum for each in found for optimum in each.optima]:
        state = one.state
        assert (state.energy <= state.work).all()
        assert (state.depth <= one.device.depth_limit).all()
        assert state.multiplier < 1
        assert int(one.orbit.status[0]) == Status.OK
        assert one.evaluations <= 60
        assert all(math.isfinite(x) for x in (*one.values.values(), *one.gradient.values(), one.height))
        low, high = found[0].bounds["omega0"] if one.device.omega > 20 else found[1].bounds["omega0"]
        assert low <= one.values["omega0"] <= high
    best = found[0].best
    swept = vijax.sweep(
        d=0.2, kappa=kappa(best), r=0.5, device=best.device, v0=np.array([-0.47898, 0.25]), outputs=["P", "admissible"]
    )
    assert float(swept["P"].max()) == pytest.approx(best.height, rel=1e-9)
    assert bool(swept["admissible"].all())


@pytest.mark.long
def test_where_any_motion_may_win_the_best_orbit_is_the_same(found):
    any_motion = optimise.optimise(FAST, survey_points=128, starts=2, max_impacts=2)
    assert any_motion.best.values["omega0"] == pytest.approx(found[0].best.values["omega0"], rel=1e-9)
    assert (any_motion.best.label, any_motion.best.P_stderr) == ("1:1", 0.0)
    # What cannot win is not climbed.
    assert 0 < any_motion.ascents < found[0].ascents


def test_an_orbit_lasts_to_its_fold_and_most_balls_arrive_there(found):
    (extent,) = off_design.extents(found[0].best)
    # The fold is 7.8 % below; above nothing happens, as far as was looked.
    assert extent.below.percent == pytest.approx(7.8, abs=0.5)
    assert (extent.below.lasts, extent.above.lasts) == (False, True)
    # What is beyond is another orbit, whatever its label.
    assert extent.below.P < 0.6 * found[0].best.P
    assert extent.above.percent == 10
    assert extent.percent == extent.below.percent
    met = off_design.arrival(found[0].best)
    assert met.share > 0.9
    assert 1 <= met.median <= met.most <= met.periods


def test_paths_rise_and_begin_at_an_attractor(found):
    for one in found[0].optima:
        assert one.path.shape == (one.heights.size, 1)
        assert one.heights[-1] == one.height
    best = found[0].best
    assert best.heights[-1] > best.heights[0]
    # What never falls is the height with the barrier, whose weight is 0.03 at first.
    assert (np.diff(best.heights) > -0.02 * best.height).all()
    assert best.heights.argmax() >= len(best.heights) - 2


def test_a_supremum_is_no_maximum(found):
    # Another 1:1 orbit of the device ends in a fold while it rises.
    ends = [one for one in found[0].optima if one.stopped == "supremum"]
    assert ends
    assert all(one.height < found[0].best.height for one in ends)


def test_tolerances_of_a_design(found):
    best = found[0].best
    narrow = optimise.under(best, [Tolerance("omega0", 0.05)])
    assert narrow.lost == narrow.inadmissible == 0
    assert narrow.worst < narrow.mean < best.height
    # The orbit ends 7.8 % below: of a wider distribution some devices fall off.
    wide = optimise.under(best, [Tolerance("omega0", 0.1)])
    assert wide.lost == pytest.approx((0.1 - 0.078) / 0.2, abs=0.06)
    assert wide.worst == 0


@pytest.mark.long
def test_optima_are_ranked_by_what_their_devices_give_whatever_their_motion(found):
    fast = found[0]
    ranking = off_design.ranked(fast.optima, [Tolerance("omega0", 0.05)])
    means = [spread.mean for _, spread in ranking]
    assert means == sorted(means, reverse=True)
    assert sorted(one.P for one, _ in ranking) == sorted(one.P for one in fast.optima)
    first, spread = ranking[0]
    assert first is fast.best
    # Where no device leaves the orbit it is what a quadrature along the orbit says.
    assert spread.mean == pytest.approx(optimise.under(first, [Tolerance("omega0", 0.05)]).mean, rel=0.02)
    # Beyond the fold, 8 % off, there is no such orbit, but other motion.
    (_, far), *_ = off_design.ranked([first], [Tolerance("omega0", 0.2)])
    along = optimise.under(first, [Tolerance("omega0", 0.2)])
    assert along.lost > 0.1
    assert far.lost < 0.5 * along.lost
    # A report tells of an optimum that is ahead there.
    for order, ahead in ((ranking, False), (ranking[::-1], True)):
        told = describe(fast, tolerances=[Tolerance("omega0", 0.05)], spread=spread, ranking=order)
        assert ("another optimum gives more there" in "\n".join(lines(told))) == ahead


def test_a_report_says_which_devices_count_in_mean_and_worst(found):
    tolerance = [Tolerance("omega0", 0.02)]
    said = []
    for spread in (Spread(3e-5, 2e-5, 0.0, 0.0), Spread(2e-5, 3e-5, 0.0, 0.438), Spread(2e-5, 0.0, 0.1, 0.0)):
        told = "\n".join(lines(describe(found[0], tolerances=tolerance, spread=spread)))
        said.append([re.search(rf"{name} P .* of nominal(.*)", told)[1] for name in ("mean", "worst")])
    assert said[0] == ["", ""]
    assert said[1] == [", those that are inadmissible counting nothing", ", inadmissible ones counting what they give"]
    assert said[2] == [", those that lose the motion counting nothing", ""]


@pytest.mark.parametrize(
    ("depth", "ratio", "says"),
    [
        (0.00593, 0.155, "beyond your limits: P alone would choose s = 0.1 m"),
        (0.00593, 1.5, "not physical: P alone"),
        (0.007, 0.155, "not physical: P alone"),
    ],
)
def test_what_only_your_limit_forbids_is_called_physical(found, depth, ratio, says):
    one = {"P": 1.0, "max_penetration": depth, "energy_ratio": ratio, "admissible": False}
    values = {name: (("direction", "s"), [[value]]) for name, value in one.items()}
    diagram = xr.Dataset(values, {"s": [0.1]}, {"along": "s", "harvester_R0": 0.0063})
    assert says in "\n".join(lines(describe(found[0], diagram=diagram)))


def test_the_worst_case_design_gives_up_nominal_power_for_it(found):
    tolerance = [Tolerance("omega0", 0.05)]
    robust = optimise.optimise(
        FAST,
        objective="worst",
        tolerances=tolerance,
        bounds={"omega0": (38.0, 45.0)},
        survey_points=128,
        starts=1,
        max_impacts=2,
    ).best
    nominal = found[0].best
    assert robust.height > optimise.under(nominal, tolerance).worst
    assert float(robust.state.P) < nominal.height
    assert optimise.under(robust, tolerance).worst == pytest.approx(robust.height, rel=1e-12)
    # At the kink both ends of the tolerance yield alike: no step along kappa raises both.
    assert robust.values["omega0"] > nominal.values["omega0"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"objective": "energy"}, "objective must be among P, power"),
        ({"objective": "mean"}, "tolerances must be given with"),
        ({"tolerances": [Tolerance("omega0", 0.05)]}, "tolerances must come with objective mean, worst or expected"),
        ({"tune": ("omega0", "k")}, "must name a quantity once"),
        ({"bounds": {"r": (0.1, 0.2)}}, "bounds must be those of a tuned quantity"),
        ({"motion": "chaotic"}, 'motion must be "any" or "periodic"; got'),
        ({"objective": "expected", "motion": "periodic"}, 'motion must be "any" with objective expected'),
        ({"objective": "expected", "samples": 9}, "samples must be left out with objective expected"),
        ({"reliability": 0.9}, "reliability must be 1 unless the objective is expected"),
        ({"objective": "expected", "reliability": 0.1}, "reliability must be a number from 0.5 to 1"),
        ({"max_evaluations": 1}, "max_evaluations must be a whole number of at least 2"),
        ({"starts": 0}, "starts must be a whole number of at least 1"),
        ({"survey_points": 1}, "survey_points must be a whole number of at least 2"),
        ({"max_impacts": 0.5}, "max_impacts must be a whole number of at least 1"),
    ],
)
def test_bad_input_is_told(settings, words):
    with pytest.raises(ValueError, match=words):
        optimise.optimise(FAST, **settings)


def test_devices_that_cannot_be_designed_are_told():
    with pytest.raises(ValueError, match="must hold at least one"):
        optimise.optimise_all([])
    with pytest.raises(ValueError, match="V must not be zero"):
        optimise.optimise(dataclasses.replace(FAST, V=0.0))
    with pytest.raises(ValueError, match="must be one number; got shape"):
        optimise.optimise(jax.tree.map(lambda x: np.full(2, x), FAST))


# Of gaps that a ball takes periods to cross, with what a sweep of 200 values from 64 starts gives.
SHAKER = Harvester(s=0.04, A=12.0, omega=36 * math.pi, m_b=0.005, R0=0.008, w0=0.0003, V=1500.0)
WIDE = Harvester(
    s=0.00671816, A=14.2558, omega=168.026, r=0.305025, m_b=0.00666067, R0=0.00669786, V=1532.13, r_b=0.004
)


@pytest.mark.parametrize(("device", "swept"), [pytest.param(SHAKER, 27e-9, marks=pytest.mark.long), (WIDE, 21.6e-9)])
def test_in_a_wide_gap_a_design_gives_more_than_a_sweep(device, swept):
    # Most starts stay on slow aperiodic motion, which gives less the longer it lasts.
    best = optimise.optimise(device, survey_points=32, max_impacts=2).best
    assert swept < best.P
    assert int(best.orbit.status[0]) == Status.OK
    assert (best.state.energy <= best.state.work).all()


@pytest.mark.long
def test_weighing_basins_moves_away_from_where_few_starts_lead(found):
    nominal = found[0].best
    best = around.weighted(found[0], starts=16, points=5)
    assert best.height >= float(nominal.state.P) * around.surroundings(nominal, starts=16).share
    assert best.height <= float(best.state.P) * (1 + 1e-9)
    assert int(best.orbit.status[0]) == Status.OK
    assert best.label == nominal.label
    low, high = found[0].bounds["omega0"]
    assert low <= best.values["omega0"] <= high


# --- the script ------------------------------------------------------------------------------------------------------

FEW = ["--survey-points", "128", "--starts", "1", "--max-impacts", "2"]
SHOWN = ["--diagram-points", "12", "--basin-starts", "100"]
SMALL = ["--r", "0.5", "--A", "3", "--omega", "10pi", "--set", "V=1700"]

BAD = [
    (["--tune", "mass"], "tune must be among"),
    (["--tune", "d,s"], "tune must name a quantity once"),
    (["--bounds", "omega0=20"], "bounds must be NAME=LO:HI"),
    (["--bounds", "mass=1:2"], "bounds must be NAME=LO:HI"),
    (["--bounds", "r=0.2:0.4"], "bounds must be those of a tuned quantity"),
    (["--bounds", "omega0=40:20"], "bounds of omega0 must be two finite bounds, the lower first"),
    (["--bounds", "omega0=-1:20"], "omega0 must be positive"),
    (["--tolerance", "omega0"], "tolerance must be NAME=5%"),
    (["--tolerance", "omega0=5%:normal"], '--tolerance: kind must be "uniform" or "lognormal"'),
    (["--tolerance", "beta=5%"], "--tolerance: name must be among"),
    (["--tolerance", "omega0=5%,omega0=2%"], "tolerances must name a constant once"),
    (["--objective", "most"], "objective must be among"),
    (["--objective", "worst"], "tolerances must be given with objective mean or worst"),
    (["--objective", "worst", "--tolerance", "s=1%:lognormal"], "tolerances of a worst case must be uniform"),
    (["--starts", "0"], "starts must be a whole number of at least 1; got 0"),
    (["--survey-points", "1"], "survey_points must be a whole number of at least 2; got 1"),
    (["--max-impacts", "0"], "max_impacts must be a whole number of at least 1; got 0"),
    (["--diagram-points", "1"], "diagram_points must be a whole number of at least 2; got 1"),
    (["--diagram-points", "1000000"], "diagram_points must be a whole number of at most 100,000; got 1000000"),
    (["--basin-starts", "0"], "basin_starts must be a whole number of at least 1; got 0"),
    (["--over", "d"], "over must be NAME=VALUES"),
    (["--over", "u0=0:0.1:3"], "over must be NAME=VALUES"),
    (["--over", "d=0.1:0.2:3", "--d", "0.2"], "over must name an axis that is not given besides"),
    (["--over", "d=0.1:0.2:3", "--s", "0.2"], "d and s give the same quantity"),
    (["--over", "kappa=4:40:3"], "over must name what is not tuned"),
    (["--d", "0.2,0.3"], "d must be one number"),
    (["--set", "V=0"], "V must not be zero"),
    (["--set", "d=1"], "give --d=1"),
    (["--r", "2"], "r must lie in (0, 1]; got 2"),
    (["--out", "design.zarr"], "out must end in .json"),
    (["--plot", "design.txt"], "plot must end in"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("arguments", "say"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, say):
    assert script.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert say in said
    assert len(said.splitlines()) == 1
    assert not list(folder.iterdir())


def strict(path):
    """A report; what is no strict JSON raises."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_a_report_is_strict_json_whole_or_not_at_all(folder):
    write_json(
        {"a": np.array([1.0, np.nan]), "b": (np.float64(np.inf), np.bool_(True), None, "c")}, folder / "one.json"
    )
    assert strict(folder / "one.json") == {"a": [1.0, None], "b": [None, True, None, "c"]}
    with pytest.raises(TypeError):
        write_json({"a": object()}, folder / "two.json")
    assert [path.name for path in folder.iterdir()] == ["one.json"]


@pytest.mark.long
def test_the_small_device_has_its_optimum_beside_the_cliff(folder, capsys):
    assert script.main(["--d", "0.2", *SMALL, *FEW, *SHOWN, "--tolerance", "omega0=5%"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["design.json", "design.png"]
    report, said = strict(folder / "design.json"), capsys.readouterr().out
    best = report["best"]
    assert best["pair"]["kappa"] == pytest.approx(KAPPA, rel=1e-5)
    assert best["P"] == pytest.approx(ENERGY, rel=1e-6)
    assert max(best["penetration"]) == pytest.approx(DEPTH, rel=1e-3)
    assert (best["label"], best["stopped"], best["active"]) == ("1:1", "maximum", [])
    assert best["largest_multiplier"] == pytest.approx(0.533, abs=1e-3)
    assert best["path"][-1] == pytest.approx([best["values"]["omega0"]], rel=1e-6)
    near = report["surroundings"]
    assert (near["below"]["kind"], near["below"]["percent"]) == ("fold", pytest.approx(-7.81, abs=0.05))
    assert (near["above"]["kind"], near["above"]["percent"]) == ("none", pytest.approx(50))
    assert near["attractors"][0]["label"] == "1:1"
    assert 0.9 < near["share"] <= 1
    assert sum(one["share"] for one in near["attractors"]) == pytest.approx(1)
    spread = report["spread"]
    assert 0.8 * ENERGY < spread["worst"] < spread["mean"] < ENERGY
    assert report["tolerances"] == [{"name": "omega0", "spread": 0.05, "kind": "uniform"}]
    for text in (
        "P 57.75761 uJ per half period",
        "an interior optimum",
        "below, fold 7.8",
        "wrote design.json, design.png",
    ):
        assert text in said


@pytest.mark.long
def test_designs_along_an_axis(folder, capsys):
    arguments = [
        *SMALL,
        "--over",
        "d=0.16,0.2",
        *FEW[:-1],
        "4",
        "--motion",
        "periodic",
        "--out",
        "map.json",
        "--plot",
        "map.png",
    ]
    assert script.main(arguments) == 0
    report = strict(folder / "map.json")
    assert report["over"] == {"name": "d", "values": [0.16, 0.2]}
    assert [one["best"]["pair"]["d"] for one in report["designs"]] == pytest.approx([0.16, 0.2])
    assert report["designs"][1]["best"]["P"] == pytest.approx(ENERGY, rel=1e-6)
    assert "d 0.2: omega0 = 40.07126 rad/s, 1:1, P 57.758 uJ, 577.58 uW, interior" in capsys.readouterr().out
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")
    # Orbits of more impacts than two climb too.
    found = [one["label"].split("/")[0].split(":") for design in report["designs"] for one in design["others"]]
    assert max(int(left) + int(right) for left, right in found) > 2


@pytest.mark.long
def test_an_optimum_on_the_penetration_limit_says_so_and_what_lies_beyond(folder, capsys):
    assert script.main(["--d", "0.2", "--out", "paper.json", *FEW, *SHOWN]) == 0
    report, said = strict(folder / "paper.json"), capsys.readouterr().out
    assert max(report["best"]["penetration"]) == pytest.approx(report["best"]["penetration_limit"], rel=1e-6)
    assert "held by: penetration limit" in said
    assert not report["highest"]["admissible"]
    assert report["highest"]["P"] > 100 * report["best"]["P"]
    assert "not physical: P alone would choose omega0" in said
    assert not (folder / "design.png").exists()


@pytest.mark.long
def test_chaos_is_a_design_with_its_standard_error(folder, capsys):
    chaos = ["--d", "0.12", "--tune", "kappa", "--bounds", "kappa=390:410", "--survey-points", "4", "--starts", "2"]
    assert script.main([*chaos, *SHOWN, "--max-impacts", "2"]) == 0
    said, report = capsys.readouterr().out, strict(folder / "design.json")
    best = report["best"]
    assert (best["label"], best["active"]) == ("aperiodic", ["lower bound of kappa"])
    assert best["pair"]["kappa"] == pytest.approx(390, rel=1e-8)
    there = dataclasses.replace(Harvester(), s=0.12 * float(Harvester().length_unit))
    flown = vijax.sweep(d=0.12, kappa=390.0, v0=np.linspace(-0.5, 0.5, 64), periods=1000, device=there)
    P = flown.P.values[flown.period.values == 0]
    noise = np.hypot(P.std() / np.sqrt(P.size), best["P_stderr"])
    assert abs(P.mean() - best["P"]) < 4 * noise
    assert best["P_stderr"] < 0.01 * best["P"]
    assert "aperiodic: P " in said
    assert "64 balls flown for 5,000 periods each at exactly these values" in said
    assert "held by: lower bound of kappa" in said
    assert (folder / "design.png").read_bytes().startswith(b"\x89PNG")


def test_where_no_motion_keeps_the_limits_the_report_says_which_stands(folder, capsys):
    shallow = ["--d", "0.12", "--tune", "kappa", "--bounds", "kappa=390:410", "--survey-points", "4", "--starts", "2"]
    shallow += ["--max-impacts", "2", "--set", "penetration_limit=1e-6", "--out", "none.json"]
    assert script.main([*shallow, *SHOWN]) == 0
    said, met = capsys.readouterr().out, strict(folder / "none.json")["survey"]
    assert strict(folder / "none.json")["best"] is None
    assert met["limit"] == "penetration limit"
    assert met["excess"] > 1
    assert "the penetration limit stands everywhere: the motion nearest to keeping the limits exceeds it by" in said
    assert "no admissible motion was found; what the survey met instead:" in said


def test_what_a_survey_met_says_what_to_do():
    nothing = {"orbits": 0, "admissible": 0, "restless": 0, "P": 0.0, "values": {}, "held": 0.0, "silent": 0.0}
    nothing |= {"limit": "", "excess": 0.0, "slow": 0.0}
    for met, says in (
        ({"orbits": 3, "limit": "penetration limit", "excess": 0.5}, "the penetration limit stands everywhere"),
        ({"orbits": 3}, "3 periodic orbits that break a constraint: widen the bounds or the limits"),
        ({"orbits": 3, "admissible": 3}, "3 admissible orbits that led to no optimum"),
        ({"restless": 2}, "none of it admissible"),
        ({"held": 1.0}, "100 % of the starts on one wall for ever: raise A or lower beta"),
        ({"silent": 0.5}, "50 % of the starts without impacts"),
        ({"slow": 0.25}, "25 % of the starts undecided"),
        ({}, "nothing that settles"),
    ):
        one = {"best": None, "survey": nothing | met}
        (line,) = table({"over": {"name": "d", "values": [0.1]}, "designs": [one]})
        assert line.startswith("d 0.1: no admissible motion; ")
        assert says in line
