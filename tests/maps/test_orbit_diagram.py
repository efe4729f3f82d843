"""Orbit diagrams: published sweeps, and every point against a simulation impact by impact."""

import numpy as np
import pytest

import vijax
from vijax.maps import orbit_diagram as diagrams
from vijax.maps.orbit_diagram import orbit_diagram
from vijax.maps.sweep_settings import DiagramSettings
from vijax.model.label import label
from vijax.model.records import State, Status
from vijax.simulation.impact_log import record_impacts


def labels(ds) -> list[str]:
    """Return the label n:m/pT of every point of one sweep, with mirror images merged."""
    return label(ds.period, ds.impacts_left, ds.impacts_right, ds.status, merge_mirrors=True).tolist()


def at(ds, low, high) -> set[str]:
    """Return the labels between two values of d, both included."""
    return set(labels(ds.isel(d=(ds.d.values > low - 1e-9) & (ds.d.values < high + 1e-9))))


# --- published sweeps -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rigid():
    """Sweep of Fig. 3 of the paper in both directions; claims H1, H3, H5 and H6."""
    values = np.round(np.arange(0.3, 0.149, -0.002), 3)
    return orbit_diagram(along="d", values=values, r=0.5, wall="rigid", direction="both")


def test_orbit_of_period_1_ends_at_the_published_d_for_decreasing_d(rigid):
    down = rigid.sel(direction="down")
    assert at(down, 0.188, 0.25) == {"1:1"}
    assert at(down, 0.178, 0.186) == {"2:4/2T"}
    assert at(down, 0.150, 0.168) == {"2:3/2T"}


@pytest.mark.long
def test_increasing_d_follows_the_other_branch(rigid):
    up = rigid.sel(direction="up")
    assert at(up, 0.188, 0.200) == {"1:2"}
    assert at(up, 0.202, 0.25) == {"1:1"}


@pytest.mark.long
def test_orbit_changes_at_the_published_omega_for_increasing_omega():
    """A device with soft walls at the start of the period-1 range of Fig. 12; claim F12a."""
    values = np.round(np.arange(3.02, 3.2, 0.03), 3)
    ds = orbit_diagram(along="omega", values=values, s=0.2, omega0=400.0, direction="up")
    expected = ["1:2" if omega < 3.12 else "1:1" for omega in values]
    assert labels(ds) == expected


# --- state at the next point ----------------------------------------------------------------------


def simulate_impacts(d, kappa, u0, v0, periods):
    """Simulate balls from phase 0 impact by impact (`test_record.py` compares this function with `trajectory`)."""
    d, u0, v0, zero = np.broadcast_arrays(*map(np.atleast_1d, (d, u0, v0, 0.0)))
    pair = vijax.impact_pair(d, kappa, np.full(d.shape, 0.5))
    zero_count = np.zeros(d.shape, np.int32)
    return record_impacts(pair, State(u0, v0, zero, zero_count, zero_count), periods, np.ones(d.shape, bool))


@pytest.mark.parametrize("wall", [pytest.param("soft", marks=pytest.mark.long), "rigid"])
def test_chain_of_equal_points_agrees_with_a_long_run(wall):
    """Onsets, speeds and states of three points of 4 periods agree with one run of 12 periods."""
    kappa = np.array([4.0, 12.65, 40.0, 400.0])
    ds = orbit_diagram(
        along="d", values=[0.12] * 3, kappa=kappa, r=0.5, direction="up", periods=4, recorded_periods=4, wall=wall
    )
    run = simulate_impacts(np.full(4, 0.12), kappa if wall == "soft" else None, 0.05853, -0.47898, 12)
    onset = 2 * run.impacts["n"] + run.impacts["t"]
    exits = onset + run.impacts["duration"]
    spanning = [((onset < end) & (exits > end)).any() for end in (8, 16)]
    assert any(spanning) == (wall == "soft")
    for i in range(kappa.size):
        chain, filled = ds.isel(kappa=i), run.filled[i]
        assert chain.filled.sum() == filled
        is_recorded = np.isfinite(chain.phase.values)
        onsets = 2 * (chain.period_number.values + 4 * np.arange(3)[:, None]) + chain.phase.values
        np.testing.assert_allclose(onsets[is_recorded], onset[i, :filled], atol=1e-8)
        for name in ("v_in", "v_out", "duration"):
            np.testing.assert_allclose(
                chain[name].values[is_recorded], run.impacts[name][i, :filled], atol=1e-7, err_msg=name
            )
        np.testing.assert_allclose(chain.u_strobe.values.ravel(), run.u[i], atol=1e-8)
        np.testing.assert_allclose(chain.v_strobe.values.ravel(), run.v[i], atol=1e-7)


@pytest.mark.parametrize(
    ("along", "values", "axes"),
    [
        ("omega", [3.0, 3.6], {"s": 0.2, "omega0": 400.0}),
        ("A", [1.0, 1.7], {"s": 0.2, "omega0": 100.0}),
        ("d", [0.2, 0.3], {"kappa": 40.0}),
    ],
)
def test_physical_displacement_and_velocity_continue_at_the_next_point(along, values, axes):
    ds = orbit_diagram(along=along, values=values, direction="up", periods=3, recorded_periods=3, **axes)
    first, second = ds.isel({along: 0}), ds.isel({along: 1})
    metres, speed = (first.A * (np.pi / first.omega) ** power for power in (2, 1))
    new_metres, new_speed = (second.A * (np.pi / second.omega) ** power for power in (2, 1))
    u0, v0 = first.u_strobe[-1] * metres / new_metres, first.v_strobe[-1] * speed / new_speed
    run = simulate_impacts(float(second.d), float(second.kappa), float(u0), float(v0), 3)
    np.testing.assert_allclose(second.u_strobe, run.u[0], atol=1e-9)
    np.testing.assert_allclose(second.v_strobe, run.v[0], atol=1e-9)


def test_start_outside_the_gap_of_rigid_walls_is_moved_inside():
    ds = orbit_diagram(
        along="d", values=[0.05, 0.1], u0=0.2, v0=0.3, wall="rigid", direction="up", periods=2, recorded_periods=2
    )
    np.testing.assert_allclose(ds.u_strobe[0], simulate_impacts(0.05, None, 0.49 * 0.05, 0.3, 2).u[0], atol=1e-10)


def test_rejected_candidate_orbit_does_not_alter_the_motion():
    """Just below the loss of symmetry Newton's method converges to the 1:1 orbit, but the motion leaves it later."""
    ds = orbit_diagram(along="d", values=[0.27, 0.262], r=0.5, wall="rigid", recorded_periods=1)
    assert ds.status.values.tolist() == [Status.OK, Status.SLOW]
    run = simulate_impacts(0.262, None, ds.u_strobe[0, -1], ds.v_strobe[0, -1], 400)
    assert float(ds.u_strobe[1, -1]) == pytest.approx(run.u[0, -1], abs=1e-7)


@pytest.mark.parametrize("periods", [pytest.param(100, marks=pytest.mark.long), 101])
def test_orbit_is_advanced_to_the_end_of_its_periods(periods):
    """On an orbit of period 2 the states after an odd and an even number of periods differ."""
    ds = orbit_diagram(
        along="d", values=[0.18], r=0.5, u0=0.03, v0=0.5, wall="rigid", periods=periods, recorded_periods=2
    )
    assert labels(ds) == ["2:4/2T"]
    np.testing.assert_allclose(ds.u_strobe[0], simulate_impacts(0.18, None, 0.03, 0.5, periods).u[0, -2:], atol=1e-9)
    assert abs(ds.u_strobe[0, 0] - ds.u_strobe[0, 1]) > 1e-3


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_next_point_starts_from_the_last_recorded_state(wall):
    """Orbits of periods 1 to 8 and chaos; the recording starts at another point of the orbit."""
    settings = DiagramSettings(periods=101, recorded_periods=3, wall=wall)
    planned = diagrams.plan("d", [0.3, 0.19, 0.18, 0.175, 0.16, 0.12], {"kappa": 400.0}, None, settings)
    ds = diagrams.run(planned)
    assert {1, 2} < set(ds.period.values.tolist())
    end = diagrams._summarise(planned.plan, diagrams._chain_table(planned), 8, 101, 3).handover
    in_flight = end.t[0] == 0
    assert in_flight.sum() >= 5
    np.testing.assert_allclose(end.u[0, in_flight], ds.u_strobe.values[in_flight, -1], atol=1e-9)
    np.testing.assert_allclose(end.v[0, in_flight], ds.v_strobe.values[in_flight, -1], atol=1e-9)


# --- the dataset ----------------------------------------------------------------------------------


def test_results_do_not_depend_on_the_order_of_values_or_on_other_chains():
    kappa, values = [40.0, 12.65], [0.13, 0.12, 0.125]
    both = orbit_diagram(along="d", values=values, kappa=kappa, direction="both", periods=30, recorded_periods=5)
    assert both.v_in.dims == ("direction", "kappa", "d", "impact")
    for direction in ("down", "up"):
        single = orbit_diagram(
            along="d", values=sorted(values), kappa=12.65, direction=direction, periods=30, recorded_periods=5
        )
        same = both.sel(direction=direction, kappa=12.65).sortby("d")
        assert np.array_equal(same.v_in[:, : single.sizes["impact"]], single.v_in, equal_nan=True)


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_power_of_the_orbit_equals_power_of_the_recorded_impacts(wall):
    """`P` comes from the converged orbit of the run, the impacts from a second simulation of it."""
    ds = orbit_diagram(
        along="d", values=[0.3, 0.2, 0.19], kappa=[40.0, 80.0], wall=wall, periods=200, recorded_periods=4
    )
    assert (ds.period == 1).all()
    np.testing.assert_allclose(ds.E.sum("impact") / (2 * 4), ds.P, rtol=1e-9)
    np.testing.assert_allclose(ds.E, vijax.harvested_energy(vijax.Harvester(), ds.depth.values), rtol=1e-12)
    if wall == "rigid":  # kappa scales the depths of a rigid wall and does not change its motion
        np.testing.assert_allclose(ds.depth.sel(kappa=40.0), 2 * ds.depth.sel(kappa=80.0), rtol=1e-12)
        assert np.array_equal(ds.v_in.sel(kappa=40.0), ds.v_in.sel(kappa=80.0), equal_nan=True)


def test_dataset_has_attributes_and_survives_save_and_load(tmp_path, rigid):
    assert rigid.attrs["along"] == "d"
    assert all(rigid[name].attrs.keys() >= {"units", "long_name"} for name in rigid.data_vars)
    assert "ok" in rigid.status.flag_meanings
    is_padding = rigid.impact >= rigid.filled
    assert (np.isnan(rigid.v_in) == is_padding).all()
    assert ((rigid.side * rigid.v_in > 0) | is_padding).all()
    assert rigid.sizes["strobe"] == 25
    vijax.save(rigid, tmp_path / "diagram.zarr")
    assert vijax.load(tmp_path / "diagram.zarr").identical(rigid)


def test_progress_is_reported():
    reports = []
    orbit_diagram(
        along="d", values=[0.3, 0.2], periods=1, recorded_periods=1, progress=lambda *state: reports.append(state)
    )
    assert reports[0] == (0, 2)
    assert reports[-1] == (2, 2)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"along": "u0"}, "along must be among d, kappa"),
        ({"along": "x"}, "along must be among d, kappa"),
        ({"d": 0.2}, "d must be specified once"),
        ({"s": 0.2}, "d and s give the same quantity"),
        ({"values": 0.2}, "values must be a 1-D array of d; got 0.2"),
        ({"values": [0.2, -0.1]}, "values must be positive .* at index 1; it is the free travel"),
        ({"periods": 0}, "periods must be a whole number of at least 1"),
        ({"recorded_periods": 30, "periods": 20}, "recorded_periods must be at most periods; got 30 of 20"),
        ({"direction": "left"}, 'direction must be "down" or "up" or "both"'),
        ({"wall": "hard"}, "wall must be"),
        ({"dtype": "float16"}, "dtype must be"),
        ({"r": 1.2}, r"r must lie in \(0, 1\]"),
    ],
)
def test_invalid_arguments_are_rejected(changed, message):
    with pytest.raises(ValueError, match=message):
        orbit_diagram(**{"along": "d", "values": [0.3, 0.2]} | changed)


def test_unknown_axis_is_named_in_the_error():
    with pytest.raises(TypeError, match="there is no axis 'x'"):
        orbit_diagram(along="d", values=[0.3, 0.2], x=1.0)
