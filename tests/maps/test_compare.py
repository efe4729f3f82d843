"""Soft against rigid walls: hard limit, labels and their mirror images, noise, choice of a model by tolerance."""

import math

import numpy as np
import pytest
import xarray as xr

from scripts import grid as script
from vijax import plots
from vijax.maps import sweep as sweeps
from vijax.maps.compare import N_STDERR, CheapestModel, LabelAgreement, cheapest_model, compare, plan, rigid_from, run
from vijax.maps.sweep import load, save, sweep
from vijax.model.records import Status

# Rigid walls: chaos at d = 0.12; orbit 2:1/1T at d = 0.2, with soft walls for kappa above 1e3; orbit 1:1/1T above.
AXES = {"d": [0.12, 0.2, 0.25, 0.3], "kappa": [4.0, 1e2, 1e3, 1e4, 1e5]}
TOLERANCE = 0.01


@pytest.fixture(scope="module")
def comparison():
    return compare(**AXES, tolerance=TOLERANCE)


def compare_prescribed(**cells) -> xr.Dataset:
    """Return the comparison that `run` computes from two sweeps with prescribed results."""
    defaults = {"P": 1.0, "P_stderr": 0.0, "period": 1, "impacts_left": 1, "impacts_right": 1, "status": Status.OK}
    values = {f"{name}_{wall}": value for name, value in defaults.items() for wall in ("soft", "rigid")} | cells
    size = max(np.size(value) for value in values.values())
    kappa = ("kappa", np.arange(1.0, size + 1), {"units": "1"})
    return _run_on({name: np.broadcast_to(value, size) for name, value in values.items()}, kappa)


def _run_on(values, kappa) -> xr.Dataset:
    gamma = values.pop("gamma", np.zeros(kappa[1].size))

    def swept(planned, progress):
        wall = planned.settings.wall
        names = [name for name in values if name.endswith(f"_{wall}")]
        variables = {name.removesuffix(f"_{wall}"): ("kappa", values[name], {"long_name": ""}) for name in names}
        coordinates = {"kappa": kappa, "gamma": ("kappa", gamma)}
        return xr.Dataset(variables, coordinates, {"outputs": "", "wall": wall})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "run", swept)
        return run(plan({}))


def words(variable: xr.DataArray) -> list[str]:
    names = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    return [names[value] for value in variable.values.flat]


# --- the hard limit --------------------------------------------------------------------------------------------------


def test_stiff_walls_agree_with_rigid_walls(comparison):
    stiff = comparison.sel(kappa=[1e4, 1e5])
    assert np.all(stiff["label"] == LabelAgreement.AGREES)
    error = N_STDERR * stiff["relative_difference_stderr"]
    assert np.all(stiff["relative_difference"] < 0.002 + error)
    # The depth is proportional to 1/kappa and E_j is quadratic in the depth, so P falls with 1/kappa^2 for both walls.
    for wall in ("soft", "rigid"):
        ratio = comparison[f"P_{wall}"].sel(kappa=1e4) / comparison[f"P_{wall}"].sel(kappa=1e5)
        np.testing.assert_allclose(ratio, 100, rtol=0.03)


def test_difference_of_regular_orbits_is_proportional_to_1_over_kappa(comparison):
    regular = comparison["relative_difference"].sel(d=[0.25, 0.3], kappa=[1e2, 1e3, 1e4, 1e5])
    assert np.all(regular.diff("kappa") < 0)
    np.testing.assert_allclose(regular.sel(kappa=1e4) / regular.sel(kappa=1e5), 10, rtol=0.05)
    assert np.all(comparison["relative_difference_stderr"].sel(d=[0.25, 0.3], kappa=regular["kappa"]) == 0)


def test_compared_values_are_the_results_of_two_sweeps(comparison):
    for wall in ("soft", "rigid"):
        separate = sweep(**AXES, wall=wall, outputs=["P", "P_stderr", "period", "status"])
        for name in separate:
            np.testing.assert_array_equal(comparison[f"{name}_{wall}"], separate[name])
    assert comparison["period_rigid"].dims == ("d",)  # rigid cells that differ in kappa alone are one simulation
    np.testing.assert_array_equal(
        comparison["relative_difference"], abs(comparison["P_rigid"] - comparison["P_soft"]) / comparison["P_soft"]
    )


def test_soft_wall_at_resonance_differs_from_a_rigid_wall(comparison):
    assert np.all(comparison["relative_difference"].sel(kappa=4.0) > 0.5)
    assert set(words(comparison["cheapest_model"].sel(kappa=4.0))) <= {"soft", "undecided"}
    assert words(comparison["label"].sel(kappa=4.0, d=0.12)) == ["differs"]


# --- differences, noise and labels of prescribed cells ---------------------------------------------------------------


def test_error_of_the_difference_is_the_error_of_the_ratio():
    rng = np.random.default_rng(1)
    ratio = rng.normal(1.2, 0.003, 200_000) / rng.normal(1.0, 0.004, 200_000)
    comparison = compare_prescribed(P_rigid=1.2, P_stderr_rigid=0.003, P_stderr_soft=0.004)
    assert float(comparison["relative_difference"][0]) == pytest.approx(0.2)
    assert float(comparison["relative_difference_stderr"][0]) == pytest.approx(ratio.std(), rel=0.02)


def test_cells_without_energy():
    comparison = compare_prescribed(P_soft=[0, 0, 1, np.nan, 0], P_rigid=[0, 1, 0, 1, np.nan], P_stderr_rigid=0.1)
    np.testing.assert_array_equal(comparison["relative_difference"], [0, np.inf, 1, np.nan, np.nan])
    assert words(cheapest_model(comparison, 0.5)) == ["rigid", "soft", "soft", "undecided", "undecided"]


@pytest.mark.parametrize(
    ("soft", "rigid", "gamma", "label"),
    [
        ((1, 1, 1), (1, 1, 1), 0.0, "agrees"),
        ((2, 3, 2), (2, 2, 3), 0.0, "agrees"),
        ((2, 3, 2), (2, 2, 3), 0.1, "differs"),
        ((2, 3, 2), (2, 3, 2), 0.1, "agrees"),
        ((1, 1, 1), (2, 1, 1), 0.0, "differs"),
        ((1, 2, 1), (1, 1, 1), 0.0, "differs"),
        ((1, 2, 1), (1, 2, 2), 0.0, "differs"),
        ((0, -1, -1), (0, -1, -1), 0.0, "agrees"),
        ((0, -1, -1), (1, 1, 1), 0.0, "differs"),
        ((-1, -1, -1), (-1, -1, -1), 0.0, "undecided"),
        ((1, 1, 1), (-1, -1, -1), 0.0, "undecided"),
    ],
)
def test_labels(soft, rigid, gamma, label):
    names = ("period", "impacts_left", "impacts_right")
    cells = {f"{name}_soft": value for name, value in zip(names, soft, strict=True)}
    cells |= {f"{name}_rigid": value for name, value in zip(names, rigid, strict=True)}
    assert words(compare_prescribed(**cells, gamma=np.array([gamma]))["label"]) == [label]


# --- tolerance -------------------------------------------------------------------------------------------------------


def test_cheapest_model_follows_the_difference(comparison):
    noiseless = comparison["relative_difference_stderr"] == 0
    expected = xr.where(comparison["relative_difference"] <= TOLERANCE, CheapestModel.RIGID, CheapestModel.SOFT)
    assert np.all((comparison["cheapest_model"] == expected) | ~noiseless)
    xr.testing.assert_identical(
        cheapest_model(comparison, TOLERANCE).rename("cheapest_model"), comparison["cheapest_model"]
    )
    loose, strict = cheapest_model(comparison, 0.1), cheapest_model(comparison, 1e-4)
    assert np.all(
        (loose == CheapestModel.RIGID) | (strict != CheapestModel.RIGID)
    )  # a cell within the strict tolerance is within the loose one


@pytest.mark.parametrize(
    ("difference", "error", "model"),
    [
        (0.04, 0.003, "rigid"),
        (0.04, 0.004, "undecided"),
        (0.06, 0.004, "undecided"),
        (0.06, 0.003, "soft"),
        (0.05, 0.0, "rigid"),
        (0.06, np.nan, "undecided"),
    ],
)
def test_model_within_the_noise_is_undecided(difference, error, model):
    comparison = compare_prescribed(P_rigid=1 + difference, P_stderr_rigid=error)
    comparison["relative_difference"][:] = difference
    assert words(cheapest_model(comparison, 0.05)) == [model]


@pytest.mark.parametrize("status", Status)
@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_model_of_unfinished_cells_is_undecided(wall, status):
    ended = status in (Status.OK, Status.CONVERGING, Status.NO_IMPACT, Status.PERMANENT_CONTACT, Status.STICKING)
    comparison = compare_prescribed(**{f"status_{wall}": status})
    assert words(cheapest_model(comparison, 0.05)) == ["rigid" if ended else "undecided"]


def test_rigid_from_is_the_kappa_above_the_last_soft_cell():
    comparison = compare_prescribed(P_rigid=[2.0, 1.0, 1.2, 1.01, 1.0])
    onset = rigid_from(cheapest_model(comparison, 0.05))
    assert (float(onset), onset.axis) == (4.0, "kappa")
    assert float(rigid_from(cheapest_model(comparison.isel(kappa=[4, 2, 0, 3, 1]), 0.05))) == 4.0
    assert math.isnan(rigid_from(cheapest_model(comparison.isel(kappa=[0, 2]), 0.05)))
    assert rigid_from(cheapest_model(comparison.isel(kappa=0), 0.05)) is None


def test_rigid_from_of_a_plane(comparison):
    # In chaos three standard errors are 1.5 % here: the model is undecided within 1 %.
    np.testing.assert_array_equal(comparison["rigid_from"], [math.nan, 1e4, 1e3, 1e3])
    assert set(words(comparison["cheapest_model"].sel(d=0.12, kappa=[1e4, 1e5]))) == {"undecided"}
    assert words(comparison["label"].sel(d=0.2)) == ["differs"] * 3 + ["agrees"] * 2
    assert comparison["rigid_from"].dims == ("d",)


def test_without_a_tolerance_no_model_is_chosen():
    assert not {"cheapest_model", "rigid_from"} & set(compare_prescribed())


# --- end to end ------------------------------------------------------------------------------------------------------


def test_progress_counts_the_cells_of_both_walls():
    reports = []
    compare(**AXES, progress=lambda *counts: reports.append(counts))
    assert reports[0] == (0, 24)
    assert reports[-1] == (24, 24)
    assert [done for done, _ in reports] == sorted(done for done, _ in reports)


def test_comparison_is_saved_loaded_and_plotted(comparison, tmp_path):
    save(comparison, tmp_path / "comparison.zarr")
    xr.testing.assert_identical(load(tmp_path / "comparison.zarr"), comparison)
    figure = plots.difference_map(comparison)
    plots.save(figure, tmp_path / "comparison.png")
    assert (tmp_path / "comparison.png").stat().st_size
    legend_texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "rigid is enough within 1 %" in legend_texts
    assert figure.get_suptitle().startswith("soft against rigid walls")


def test_from_arguments_to_store_and_picture(comparison, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    axes = [part for name, values in AXES.items() for part in (f"--{name}", ",".join(map(str, values)))]
    assert script.main([*axes, "--compare", "rigid", "--tolerance", str(TOLERANCE)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["comparison.png", "comparison.zarr"]
    xr.testing.assert_equal(load(tmp_path / "comparison.zarr"), comparison)
    output = capsys.readouterr().out
    # At (0.3, 4) the motion is chaotic with intervals of almost no power, so the size of its error is random.
    chaotic = {"d": 0.3, "kappa": 4.0}
    difference, error = (comparison[f"relative_difference{end}"].sel(chaotic).item() for end in ("", "_stderr"))
    chaotic_model = CheapestModel.SOFT if difference - N_STDERR * error > TOLERANCE else CheapestModel.UNDECIDED
    models = [[1, 1, 2, 2, 2], [1, 1, 1, 0, 0], [1, 1, 0, 0, 0], [chaotic_model, 1, 0, 0, 0]]
    assert np.array_equal(comparison.cheapest_model.transpose("d", "kappa"), models)
    rigid, soft, undecided = (sum(row.count(index) for row in models) for index in range(3))
    for part in (
        "24 cells in",
        "soft cells by status: ok 20",
        "label: ",
        f"cheapest model within 1 %: rigid {rigid}, soft {soft}, undecided {undecided}",
        "least kappa from which on it is rigid: 1000 to 1e+04, median 1000 (3 of 4 found)",
        "wrote comparison.zarr, comparison.png",
    ):
        assert part in output, output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0}, "tolerance must be a positive number"),
        ({"tolerance": -0.1}, "tolerance must be a positive number"),
        ({"tolerance": math.nan}, "got nan"),
        ({"tolerance": math.inf}, "got inf"),
        ({"tolerance": "5 %"}, "got '5 %'"),
        ({"tolerance": [0.1]}, "tolerance must be"),
        ({"tolerance": True}, "tolerance must be"),
        ({"u0": 0.2, "d": 0.1}, "u0 must lie in the gap"),
        ({"kappa": math.inf}, "kappa must be positive and finite"),
        ({"periods": 0}, "periods must be"),
    ],
)
def test_invalid_arguments_are_rejected_before_any_simulation(monkeypatch, arguments, message):
    monkeypatch.setattr(sweeps, "run", None)
    with pytest.raises(ValueError, match=message):
        compare(**arguments)


def test_unknown_axis_is_rejected():
    with pytest.raises(TypeError, match="there is no axis 'wall'"):
        compare(wall="rigid")
