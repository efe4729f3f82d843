"""Designs and `scripts/design.py`: known optima, cliffs, tolerances, reports, invalid input.

The tests share a file because they share compiled programs.
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
from vijax.design import design_search, objective, optimise
from vijax.design.design_search import DeviceSearch
from vijax.design.objective import AscentBatch, ObjectiveSpec
from vijax.design.report import describe
from vijax.design.report_lines import format_report, format_table
from vijax.design.robustness import off_design
from vijax.design.robustness import surroundings as around
from vijax.design.robustness.tolerance import Tolerance, ToleranceStatistics, nodes
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.runtime.files import write_json

FAST = Harvester(A=3.0, omega=10 * math.pi, V=1700.0)
FAST = dataclasses.replace(FAST, s=0.2 * FAST.length_unit)
PAPER = Harvester(s=0.2)
LIMITED = Harvester(s=0.2, energy_ratio_limit=0.05)
# Reference optimum of the small fast device.
KAPPA, ENERGY, DEPTH = 4.00713, 57.75761e-6, 6.026e-3


def kappa(optimum):
    return optimum.device.omega0 * math.pi / optimum.device.omega


@pytest.fixture(scope="module")
def designs():
    """Optimise the devices in one call; a small `max_impacts` shortens compilation."""
    return optimise.optimise_all([FAST, PAPER, LIMITED], survey_points=128, starts=2, max_impacts=2, motion="periodic")


def test_devices_are_designed_in_groups_of_limited_size(monkeypatch):
    groups: list[list[float]] = []
    nothing: Any = None

    def search(task, *_):
        assert len(task.box) == len(task.devices)
        groups.append([device.s for device in task.devices])
        return [DeviceSearch(nothing, 0.0) for _ in task.devices]

    monkeypatch.setattr(design_search, "search_designs", search)
    gaps = np.linspace(0.1, 0.2, 11).tolist()
    devices = [Harvester(s=s) for s in gaps]
    points = optimise._MAX_GROUP_STARTS // (4 * 8)
    assert len(optimise.optimise_all(devices, survey_points=points, starts=8)) == 11
    assert groups == [gaps[:4], gaps[4:8], gaps[8:]]
    # With a second quantity a survey has sixteen times as many starts.
    groups.clear()
    optimise.optimise_all(devices[:3], survey_points=points // 8, starts=8, tune=("kappa", "d"))
    assert groups == [gaps[:2], gaps[2:3]]
    # In a wide gap a survey has eight times as many starts.
    groups.clear()
    optimise.optimise_all([*devices[:2], Harvester(s=50.0), devices[3]], survey_points=points // 2, starts=8)
    assert groups == [gaps[:2], [50.0], gaps[3:4]]


def test_optimum_of_a_small_fast_device(designs):
    best = designs[0].best
    assert kappa(best) == pytest.approx(KAPPA, abs=1e-5)
    assert best.objective_value == pytest.approx(ENERGY, rel=1e-7)
    assert float(best.state.depth.max()) == pytest.approx(DEPTH, abs=1e-6)
    assert float(best.state.multiplier) == pytest.approx(0.533, abs=1e-3)
    assert (best.stopped, best.active, best.label) == ("maximum", (), "1:1")
    assert abs(best.gradient["omega0"]) < 1e-5


@pytest.mark.long
def test_a_device_that_loses_its_orbit_does_not_widen_the_margins(designs):
    best = designs[0].best
    cloud, none = nodes((Tolerance("omega0", 0.05),), None), jnp.zeros((1, 1))
    spec = ObjectiveSpec(jnp.asarray(cloud.factors), jnp.asarray(cloud.weights), ("omega0",), cloud.names, "mean")
    device = jax.tree.map(lambda x: jnp.array([x], float), best.device)
    here = jnp.log(jnp.array([[best.values["omega0"]]]))
    batch = AscentBatch(device, best.orbit.sequence, best.orbit.impact_unknowns, here, none, none)
    # A device 5 % softer than the shifted device lies beyond the fold.
    shifted = here + math.log(3.8 / KAPPA)
    evaluation = jax.jit(objective.evaluate_objective)(
        spec, batch, shifted, here, objective.follow_node_orbits(spec, batch)
    )
    exists = np.asarray(evaluation.memory.exists)[0]
    margins = np.asarray(evaluation.margins).reshape(exists.size, -1)
    assert exists[0]
    assert not exists.all()
    np.testing.assert_array_equal(margins[~exists], np.broadcast_to(margins[0], margins[~exists].shape))
    assert (margins[exists] != margins[0]).any()


def test_penetration_limit_is_active_for_the_papers_device(designs):
    best = designs[1].best
    assert kappa(best) == pytest.approx(64.669, abs=1e-3)
    deepest = float(best.state.depth.max())
    assert deepest <= PAPER.depth_limit
    assert deepest == pytest.approx(PAPER.depth_limit, rel=1e-6)
    assert len(best.active) == 1
    assert "penetration limit" in best.active[0]
    # P would increase beyond the limit.
    assert best.gradient["omega0"] < -1


def test_the_energy_ratio_limit_is_a_constraint_of_a_design(designs):
    best, state = designs[2].best, designs[2].best.state
    assert float((state.energy / state.work).max()) == pytest.approx(LIMITED.energy_ratio_limit, rel=1e-6)
    assert (state.energy <= LIMITED.energy_ratio_limit * state.work).all()
    assert "energy ratio limit" in best.active[0]
    assert best.objective_value < designs[1].best.objective_value
    text = "\n".join(format_report(describe(designs[2])))
    assert "harvested at most 5 % of the energy that an impact gives, of 5 % allowed" in text
    assert "active constraints: energy ratio limit" in text


def test_optima_are_admissible_stable_and_agree_with_simulations(designs):
    for entry in [optimum for design in designs for optimum in design.optima]:
        state = entry.state
        assert (state.energy <= state.work).all()
        assert (state.depth <= entry.device.depth_limit).all()
        assert state.multiplier < 1
        assert int(entry.orbit.status[0]) == Status.OK
        assert entry.evaluations <= 60
        assert all(math.isfinite(x) for x in (*entry.values.values(), *entry.gradient.values(), entry.objective_value))
        low, high = designs[0].bounds["omega0"] if entry.device.omega > 20 else designs[1].bounds["omega0"]
        assert low <= entry.values["omega0"] <= high
    best = designs[0].best
    swept = vijax.sweep(
        d=0.2, kappa=kappa(best), r=0.5, device=best.device, v0=np.array([-0.47898, 0.25]), outputs=["P", "admissible"]
    )
    assert float(swept["P"].max()) == pytest.approx(best.objective_value, rel=1e-9)
    assert bool(swept["admissible"].all())


@pytest.mark.long
def test_best_orbit_is_the_same_if_all_motions_compete(designs):
    any_motion = optimise.optimise(FAST, survey_points=128, starts=2, max_impacts=2)
    assert any_motion.best.values["omega0"] == pytest.approx(designs[0].best.values["omega0"], rel=1e-9)
    assert (any_motion.best.label, any_motion.best.P_stderr) == ("1:1", 0.0)
    # Orbits that cannot win are not climbed.
    assert 0 < any_motion.ascents < designs[0].ascents


def test_orbit_persists_to_its_fold_and_most_starts_reach_it(designs):
    (extent,) = off_design.parameter_ranges(designs[0].best)
    # The fold is 7.8 % below the optimum; the motion persists in the whole range above.
    assert extent.below.percent == pytest.approx(7.8, abs=0.5)
    assert (extent.below.persists, extent.above.persists) == (False, True)
    # The motion beyond the fold is another orbit, possibly with the same label.
    assert extent.below.P < 0.6 * designs[0].best.P
    assert extent.above.percent == 10
    assert extent.percent == extent.below.percent
    arrival = off_design.arrival_statistics(designs[0].best)
    assert arrival.share > 0.9
    assert 1 <= arrival.median <= arrival.p90 <= arrival.periods


def test_paths_rise_and_begin_at_an_attractor(designs):
    for entry in designs[0].optima:
        assert entry.path.shape == (entry.path_objective.size, 1)
        assert entry.path_objective[-1] == entry.objective_value
    best = designs[0].best
    assert best.path_objective[-1] > best.path_objective[0]
    # The ascent never lowers the objective with the barrier; the barrier has weight 0.03 at first.
    assert (np.diff(best.path_objective) > -0.02 * best.objective_value).all()
    assert best.path_objective.argmax() >= len(best.path_objective) - 2


def test_a_supremum_is_no_maximum(designs):
    # Another 1:1 orbit of the device ends in a fold while its power rises.
    ends = [entry for entry in designs[0].optima if entry.stopped == "supremum"]
    assert ends
    assert all(entry.objective_value < designs[0].best.objective_value for entry in ends)


def test_tolerances_of_a_design(designs):
    best = designs[0].best
    narrow = optimise.tolerance_statistics(best, [Tolerance("omega0", 0.05)])
    assert narrow.lost == narrow.inadmissible == 0
    assert narrow.worst < narrow.mean < best.objective_value
    # The orbit ends 7.8 % below the optimum, so a wider distribution has devices without it.
    wide = optimise.tolerance_statistics(best, [Tolerance("omega0", 0.1)])
    assert wide.lost == pytest.approx((0.1 - 0.078) / 0.2, abs=0.06)
    assert wide.worst == 0


@pytest.mark.long
def test_optima_are_ranked_by_the_mean_power_of_their_devices(designs):
    fast = designs[0]
    ranking = off_design.rank_under_tolerances(fast.optima, [Tolerance("omega0", 0.05)])
    means = [spread.mean for _, spread in ranking]
    assert means == sorted(means, reverse=True)
    assert sorted(entry.P for entry, _ in ranking) == sorted(entry.P for entry in fast.optima)
    first, spread = ranking[0]
    assert first is fast.best
    # If no device loses the orbit, the mean agrees with a quadrature along the orbit.
    assert spread.mean == pytest.approx(
        optimise.tolerance_statistics(first, [Tolerance("omega0", 0.05)]).mean, rel=0.02
    )
    # Beyond the fold, 8 % away, devices have other motion instead of this orbit.
    (_, far), *_ = off_design.rank_under_tolerances([first], [Tolerance("omega0", 0.2)])
    along = optimise.tolerance_statistics(first, [Tolerance("omega0", 0.2)])
    assert along.lost > 0.1
    assert far.lost < 0.5 * along.lost
    # A report mentions another optimum with a higher mean under tolerances.
    for order, ahead in ((ranking, False), (ranking[::-1], True)):
        report = describe(fast, tolerances=[Tolerance("omega0", 0.05)], spread=spread, ranking=order)
        assert ("another optimum has a higher mean there" in "\n".join(format_report(report))) == ahead


def test_report_states_which_devices_count_in_mean_and_worst(designs):
    tolerance = [Tolerance("omega0", 0.02)]
    endings = []
    for spread in (
        ToleranceStatistics(3e-5, 2e-5, 0.0, 0.0),
        ToleranceStatistics(2e-5, 3e-5, 0.0, 0.438),
        ToleranceStatistics(2e-5, 0.0, 0.1, 0.0),
    ):
        text = "\n".join(format_report(describe(designs[0], tolerances=tolerance, spread=spread)))
        endings.append([re.search(rf"{name} P .* of nominal(.*)", text)[1] for name in ("mean", "worst")])
    assert endings[0] == ["", ""]
    assert endings[1] == [", those that are inadmissible counting as 0", ", inadmissible ones counting with their P"]
    assert endings[2] == [", those that lose the motion counting as 0", ""]


@pytest.mark.parametrize(
    ("depth", "ratio", "message"),
    [
        (0.00593, 0.155, "inadmissible: the largest P without limits is at s = 0.1 m"),
        (0.00593, 1.5, "not physical: the largest P"),
        (0.007, 0.155, "not physical: the largest P"),
    ],
)
def test_motion_excluded_by_a_user_limit_alone_is_physical(designs, depth, ratio, message):
    peak = {"P": 1.0, "max_penetration": depth, "energy_ratio": ratio, "admissible": False}
    values = {name: (("direction", "s"), [[value]]) for name, value in peak.items()}
    diagram = xr.Dataset(values, {"s": [0.1]}, {"along": "s", "harvester_R0": 0.0063})
    assert message in "\n".join(format_report(describe(designs[0], diagram=diagram)))


def test_worst_case_design_has_less_nominal_power(designs):
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
    nominal = designs[0].best
    assert robust.objective_value > optimise.tolerance_statistics(nominal, tolerance).worst
    assert float(robust.state.P) < nominal.objective_value
    assert optimise.tolerance_statistics(robust, tolerance).worst == pytest.approx(robust.objective_value, rel=1e-12)
    # At the kink both ends of the tolerance yield the same P, and no step along kappa raises both.
    assert robust.values["omega0"] > nominal.values["omega0"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"objective": "energy"}, "objective must be among P, power"),
        ({"objective": "mean"}, "tolerances must be given with"),
        ({"tolerances": [Tolerance("omega0", 0.05)]}, "tolerances must come with objective mean, worst or expected"),
        ({"tune": ("omega0", "k")}, "must name a quantity once"),
        ({"bounds": {"r": (0.1, 0.2)}}, "bounds must be of a tuned quantity"),
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
def test_invalid_arguments_raise(settings, words):
    with pytest.raises(ValueError, match=words):
        optimise.optimise(FAST, **settings)


def test_invalid_devices_raise():
    with pytest.raises(ValueError, match="must hold at least one"):
        optimise.optimise_all([])
    with pytest.raises(ValueError, match="V must not be zero"):
        optimise.optimise(dataclasses.replace(FAST, V=0.0))
    with pytest.raises(ValueError, match="must be one number; got shape"):
        optimise.optimise(jax.tree.map(lambda x: np.full(2, x), FAST))


# Devices with gaps that a ball crosses in several periods. Reference: best P of a sweep, 200 values of 64 starts.
SHAKER = Harvester(s=0.04, A=12.0, omega=36 * math.pi, m_b=0.005, R0=0.008, w0=0.0003, V=1500.0)
WIDE = Harvester(
    s=0.00671816, A=14.2558, omega=168.026, r=0.305025, m_b=0.00666067, R0=0.00669786, V=1532.13, r_b=0.004
)


@pytest.mark.parametrize(("device", "swept"), [pytest.param(SHAKER, 27e-9, marks=pytest.mark.long), (WIDE, 21.6e-9)])
def test_design_in_a_wide_gap_exceeds_the_best_of_a_sweep(device, swept):
    # Most starts lead to slow aperiodic motion. Its mean power decreases with the simulated time.
    best = optimise.optimise(device, survey_points=32, max_impacts=2).best
    assert swept < best.P
    assert int(best.orbit.status[0]) == Status.OK
    assert (best.state.energy <= best.state.work).all()


@pytest.mark.long
def test_basin_weighted_design_exceeds_the_weighted_nominal_power(designs):
    nominal = designs[0].best
    best = around.maximise_basin_power(designs[0], starts=16, points=5)
    assert best.objective_value >= float(nominal.state.P) * around.surroundings(nominal, starts=16).share
    assert best.objective_value <= float(best.state.P) * (1 + 1e-9)
    assert int(best.orbit.status[0]) == Status.OK
    assert best.label == nominal.label
    low, high = designs[0].bounds["omega0"]
    assert low <= best.values["omega0"] <= high


# --- the script ------------------------------------------------------------------------------------------------------

SMALL_EFFORT = ["--survey-points", "128", "--starts", "1", "--max-impacts", "2"]
DIAGRAM_OPTIONS = ["--diagram-points", "12", "--basin-starts", "100"]
SMALL_DEVICE = ["--r", "0.5", "--A", "3", "--omega", "10pi", "--set", "V=1700"]

INVALID = [
    (["--tune", "mass"], "tune must be among"),
    (["--tune", "d,s"], "tune must name a quantity once"),
    (["--bounds", "omega0=20"], "bounds must be NAME=LO:HI"),
    (["--bounds", "mass=1:2"], "bounds must be NAME=LO:HI"),
    (["--bounds", "r=0.2:0.4"], "bounds must be of a tuned quantity"),
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
    (["--over", "kappa=4:40:3"], "over must name a quantity that is not tuned"),
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


@pytest.mark.parametrize(("arguments", "message"), INVALID, ids=[" ".join(arguments) for arguments, _ in INVALID])
def test_invalid_input_prints_a_line_with_exit_code_2(folder, capsys, arguments, message):
    assert script.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert len(error.splitlines()) == 1
    assert not list(folder.iterdir())


def strict(path):
    """Read a report; JSON that is not strict raises."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_report_is_strict_json_and_written_atomically(folder):
    write_json(
        {"a": np.array([1.0, np.nan]), "b": (np.float64(np.inf), np.bool_(True), None, "c")}, folder / "one.json"
    )
    assert strict(folder / "one.json") == {"a": [1.0, None], "b": [None, True, None, "c"]}
    with pytest.raises(TypeError):
        write_json({"a": object()}, folder / "two.json")
    assert [path.name for path in folder.iterdir()] == ["one.json"]


@pytest.mark.long
def test_optimum_of_the_small_device_lies_near_a_cliff(folder, capsys):
    assert script.main(["--d", "0.2", *SMALL_DEVICE, *SMALL_EFFORT, *DIAGRAM_OPTIONS, "--tolerance", "omega0=5%"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["design.json", "design.png"]
    report, printed = strict(folder / "design.json"), capsys.readouterr().out
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
    assert sum(entry["share"] for entry in near["attractors"]) == pytest.approx(1)
    spread = report["spread"]
    assert 0.8 * ENERGY < spread["worst"] < spread["mean"] < ENERGY
    assert report["tolerances"] == [{"name": "omega0", "spread": 0.05, "kind": "uniform"}]
    for text in (
        "P 57.75761 uJ per half period",
        "an interior optimum",
        "below, fold 7.8",
        "wrote design.json, design.png",
    ):
        assert text in printed


@pytest.mark.long
def test_designs_along_an_axis(folder, capsys):
    arguments = [
        *SMALL_DEVICE,
        "--over",
        "d=0.16,0.2",
        *SMALL_EFFORT[:-1],
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
    assert [entry["best"]["pair"]["d"] for entry in report["designs"]] == pytest.approx([0.16, 0.2])
    assert report["designs"][1]["best"]["P"] == pytest.approx(ENERGY, rel=1e-6)
    assert "d 0.2: omega0 = 40.07126 rad/s, 1:1, P 57.758 uJ, 577.58 uW, interior" in capsys.readouterr().out
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")
    # Orbits with more than two impacts are climbed, too.
    impact_counts = [
        entry["label"].split("/")[0].split(":") for design in report["designs"] for entry in design["others"]
    ]
    assert max(int(left) + int(right) for left, right in impact_counts) > 2


@pytest.mark.long
def test_report_of_an_optimum_on_the_penetration_limit(folder, capsys):
    assert script.main(["--d", "0.2", "--out", "paper.json", *SMALL_EFFORT, *DIAGRAM_OPTIONS]) == 0
    report, printed = strict(folder / "paper.json"), capsys.readouterr().out
    assert max(report["best"]["penetration"]) == pytest.approx(report["best"]["penetration_limit"], rel=1e-6)
    assert "active constraints: penetration limit" in printed
    assert not report["highest"]["admissible"]
    assert report["highest"]["P"] > 100 * report["best"]["P"]
    assert "not physical: the largest P without limits is at omega0" in printed
    assert not (folder / "design.png").exists()


@pytest.mark.long
def test_chaos_is_a_design_with_its_standard_error(folder, capsys):
    chaos = ["--d", "0.12", "--tune", "kappa", "--bounds", "kappa=390:410", "--survey-points", "4", "--starts", "2"]
    assert script.main([*chaos, *DIAGRAM_OPTIONS, "--max-impacts", "2"]) == 0
    printed, report = capsys.readouterr().out, strict(folder / "design.json")
    best = report["best"]
    assert (best["label"], best["active"]) == ("aperiodic", ["lower bound of kappa"])
    assert best["pair"]["kappa"] == pytest.approx(390, rel=1e-8)
    device = dataclasses.replace(Harvester(), s=0.12 * float(Harvester().length_unit))
    swept = vijax.sweep(d=0.12, kappa=390.0, v0=np.linspace(-0.5, 0.5, 64), periods=1000, device=device)
    P = swept.P.values[swept.period.values == 0]
    noise = np.hypot(P.std() / np.sqrt(P.size), best["P_stderr"])
    assert abs(P.mean() - best["P"]) < 4 * noise
    assert best["P_stderr"] < 0.01 * best["P"]
    assert "aperiodic: P " in printed
    assert "64 samples simulated for 5,000 periods each at exactly these values" in printed
    assert "active constraints: lower bound of kappa" in printed
    assert (folder / "design.png").read_bytes().startswith(b"\x89PNG")


def test_report_names_the_limit_that_no_motion_satisfies(folder, capsys):
    shallow = ["--d", "0.12", "--tune", "kappa", "--bounds", "kappa=390:410", "--survey-points", "4", "--starts", "2"]
    shallow += ["--max-impacts", "2", "--set", "penetration_limit=1e-6", "--out", "none.json"]
    assert script.main([*shallow, *DIAGRAM_OPTIONS]) == 0
    printed, survey = capsys.readouterr().out, strict(folder / "none.json")["survey"]
    assert strict(folder / "none.json")["best"] is None
    assert survey["limit"] == "penetration limit"
    assert survey["violation"] > 1
    assert "the penetration limit is broken everywhere: the motion with the smallest violation exceeds it by" in printed
    assert "no admissible motion was found; motions of the survey:" in printed


def test_failed_surveys_print_advice():
    nothing = {
        "orbits": 0,
        "admissible": 0,
        "aperiodic_points": 0,
        "P": 0.0,
        "values": {},
        "permanent_contact": 0.0,
        "no_impact": 0.0,
    }
    nothing |= {"limit": "", "violation": 0.0, "undecided": 0.0}
    for results, message in (
        ({"orbits": 3, "limit": "penetration limit", "violation": 0.5}, "the penetration limit is broken everywhere"),
        ({"orbits": 3}, "3 periodic orbits that break a constraint: widen the bounds or the limits"),
        ({"orbits": 3, "admissible": 3}, "3 admissible orbits without an optimum"),
        ({"aperiodic_points": 2}, "none of it admissible"),
        ({"permanent_contact": 1.0}, "100 % of the starts in permanent contact with one wall: raise A or lower beta"),
        ({"no_impact": 0.5}, "50 % of the starts without impacts"),
        ({"undecided": 0.25}, "25 % of the starts undecided"),
        ({}, "no motion that settles"),
    ):
        design = {"best": None, "survey": nothing | results}
        (line,) = format_table({"over": {"name": "d", "values": [0.1]}, "designs": [design]})
        assert line.startswith("d 0.1: no admissible motion; ")
        assert message in line
