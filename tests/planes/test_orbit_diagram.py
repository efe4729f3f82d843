"""Orbit diagrams: published sweeps, and every point against the ball followed impact by impact."""

import numpy as np
import pytest

import vijax
from vijax.batch.impact_log import record
from vijax.model.label import label
from vijax.model.records import State, Status
from vijax.planes import orbit_diagram as diagrams
from vijax.planes.orbit_diagram import orbit_diagram
from vijax.planes.sweep_settings import DiagramSettings


def labels(ds) -> list[str]:
    """n:m/pT of every point of a single sweep, mirror images as one."""
    return label(ds.period, ds.impacts_left, ds.impacts_right, ds.status, merge_mirrors=True).tolist()


def at(ds, low, high) -> set[str]:
    """Labels between two values of d, both included."""
    return set(labels(ds.isel(d=(ds.d.values > low - 1e-9) & (ds.d.values < high + 1e-9))))


# --- published sweeps -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rigid():
    """Fig. 3 of the paper and back; claims H1, H3, H5 and H6."""
    values = np.round(np.arange(0.3, 0.149, -0.002), 3)
    return orbit_diagram(along="d", values=values, r=0.5, wall="rigid", direction="both")


def test_falling_d_leaves_period_one_where_published(rigid):
    down = rigid.sel(direction="down")
    assert at(down, 0.188, 0.25) == {"1:1"}
    assert at(down, 0.178, 0.186) == {"2:4/2T"}
    assert at(down, 0.150, 0.168) == {"2:3/2T"}


@pytest.mark.long
def test_rising_d_stays_on_the_other_branch(rigid):
    up = rigid.sel(direction="up")
    assert at(up, 0.188, 0.200) == {"1:2"}
    assert at(up, 0.202, 0.25) == {"1:1"}


@pytest.mark.long
def test_rising_omega_changes_orbit_where_published():
    """Start of Fig. 12's period-1 range, one device with soft walls; claim F12a."""
    values = np.round(np.arange(3.02, 3.2, 0.03), 3)
    ds = orbit_diagram(along="omega", values=values, s=0.2, omega0=400.0, direction="up")
    expected = ["1:2" if omega < 3.12 else "1:1" for omega in values]
    assert labels(ds) == expected


# --- what is handed on ----------------------------------------------------------------------------


def followed(d, kappa, u0, v0, periods):
    """One run of some balls from phase 0, impact by impact (`test_record.py` holds it against `trajectory`)."""
    d, u0, v0, zero = np.broadcast_arrays(*map(np.atleast_1d, (d, u0, v0, 0.0)))
    pair = vijax.impact_pair(d, kappa, np.full(d.shape, 0.5))
    whole = np.zeros(d.shape, np.int32)
    return record(pair, State(u0, v0, zero, whole, whole), periods, np.ones(d.shape, bool))


@pytest.mark.parametrize("wall", [pytest.param("soft", marks=pytest.mark.long), "rigid"])
def test_a_chain_of_equal_points_is_one_long_run(wall):
    """Onsets, speeds and states of three points of 4 periods, against one run of 12."""
    kappa = np.array([4.0, 12.65, 40.0, 400.0])
    ds = orbit_diagram(
        along="d", values=[0.12] * 3, kappa=kappa, r=0.5, direction="up", periods=4, recorded_periods=4, wall=wall
    )
    run = followed(np.full(4, 0.12), kappa if wall == "soft" else None, 0.05853, -0.47898, 12)
    when = 2 * run.impacts["n"] + run.impacts["t"]
    exits = when + run.impacts["duration"]
    spanning = [((when < end) & (exits > end)).any() for end in (8, 16)]
    assert any(spanning) == (wall == "soft")
    for i in range(kappa.size):
        one, filled = ds.isel(kappa=i), run.filled[i]
        assert one.filled.sum() == filled
        real = np.isfinite(one.phase.values)
        found = 2 * (one.period_number.values + 4 * np.arange(3)[:, None]) + one.phase.values
        np.testing.assert_allclose(found[real], when[i, :filled], atol=1e-8)
        for name in ("v_in", "v_out", "duration"):
            np.testing.assert_allclose(one[name].values[real], run.impacts[name][i, :filled], atol=1e-7, err_msg=name)
        np.testing.assert_allclose(one.u_strobe.values.ravel(), run.u[i], atol=1e-8)
        np.testing.assert_allclose(one.v_strobe.values.ravel(), run.v[i], atol=1e-7)


@pytest.mark.parametrize(
    ("along", "values", "axes"),
    [
        ("omega", [3.0, 3.6], {"s": 0.2, "omega0": 400.0}),
        ("A", [1.0, 1.7], {"s": 0.2, "omega0": 100.0}),
        ("d", [0.2, 0.3], {"kappa": 40.0}),
    ],
)
def test_physical_displacement_and_velocity_are_carried(along, values, axes):
    ds = orbit_diagram(along=along, values=values, direction="up", periods=3, recorded_periods=3, **axes)
    first, second = ds.isel({along: 0}), ds.isel({along: 1})
    metres, speed = (first.A * (np.pi / first.omega) ** power for power in (2, 1))
    new_metres, new_speed = (second.A * (np.pi / second.omega) ** power for power in (2, 1))
    u0, v0 = first.u_strobe[-1] * metres / new_metres, first.v_strobe[-1] * speed / new_speed
    run = followed(float(second.d), float(second.kappa), float(u0), float(v0), 3)
    np.testing.assert_allclose(second.u_strobe, run.u[0], atol=1e-9)
    np.testing.assert_allclose(second.v_strobe, run.v[0], atol=1e-9)


def test_a_rigid_start_outside_the_gap_is_put_back():
    ds = orbit_diagram(
        along="d", values=[0.05, 0.1], u0=0.2, v0=0.3, wall="rigid", direction="up", periods=2, recorded_periods=2
    )
    np.testing.assert_allclose(ds.u_strobe[0], followed(0.05, None, 0.49 * 0.05, 0.3, 2).u[0], atol=1e-10)


def test_a_round_that_comes_to_nothing_leaves_no_trace():
    """Just under its loss of symmetry the 1:1 orbit draws Newton to itself, and lets the ball go a little later."""
    ds = orbit_diagram(along="d", values=[0.27, 0.262], r=0.5, wall="rigid", recorded_periods=1)
    assert ds.status.values.tolist() == [Status.OK, Status.SLOW]
    run = followed(0.262, None, ds.u_strobe[0, -1], ds.v_strobe[0, -1], 400)
    assert float(ds.u_strobe[1, -1]) == pytest.approx(run.u[0, -1], abs=1e-7)


@pytest.mark.parametrize("periods", [pytest.param(100, marks=pytest.mark.long), 101])
def test_an_orbit_is_taken_to_the_end_of_its_periods(periods):
    """Of a period-2 orbit the state after an odd number of periods is another than after an even one."""
    ds = orbit_diagram(
        along="d", values=[0.18], r=0.5, u0=0.03, v0=0.5, wall="rigid", periods=periods, recorded_periods=2
    )
    assert labels(ds) == ["2:4/2T"]
    np.testing.assert_allclose(ds.u_strobe[0], followed(0.18, None, 0.03, 0.5, periods).u[0, -2:], atol=1e-9)
    assert abs(ds.u_strobe[0, 0] - ds.u_strobe[0, 1]) > 1e-3


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_the_last_state_recorded_is_handed_on(wall):
    """Of orbits of periods 1 to 8 and of chaos; the record is flown from elsewhere on them."""
    settings = DiagramSettings(periods=101, recorded_periods=3, wall=wall)
    asked = diagrams.plan("d", [0.3, 0.19, 0.18, 0.175, 0.16, 0.12], {"kappa": 400.0}, None, settings)
    ds = diagrams.run(asked)
    assert {1, 2} < set(ds.period.values.tolist())
    end = diagrams._follow(asked.planned, diagrams._table(asked), 8, 101, 3).handover
    aloft = end.t[0] == 0
    assert aloft.sum() >= 5
    np.testing.assert_allclose(end.u[0, aloft], ds.u_strobe.values[aloft, -1], atol=1e-9)
    np.testing.assert_allclose(end.v[0, aloft], ds.v_strobe.values[aloft, -1], atol=1e-9)


# --- the dataset ----------------------------------------------------------------------------------


def test_order_of_values_and_company_do_not_matter():
    kappa, values = [40.0, 12.65], [0.13, 0.12, 0.125]
    both = orbit_diagram(along="d", values=values, kappa=kappa, direction="both", periods=30, recorded_periods=5)
    assert both.v_in.dims == ("direction", "kappa", "d", "impact")
    for way in ("down", "up"):
        alone = orbit_diagram(
            along="d", values=sorted(values), kappa=12.65, direction=way, periods=30, recorded_periods=5
        )
        same = both.sel(direction=way, kappa=12.65).sortby("d")
        assert np.array_equal(same.v_in[:, : alone.sizes["impact"]], alone.v_in, equal_nan=True)


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_power_along_the_orbit_is_that_of_the_recorded_impacts(wall):
    """One comes from the polished orbit within the run, the other from flying it again."""
    ds = orbit_diagram(
        along="d", values=[0.3, 0.2, 0.19], kappa=[40.0, 80.0], wall=wall, periods=200, recorded_periods=4
    )
    assert (ds.period == 1).all()
    np.testing.assert_allclose(ds.E.sum("impact") / (2 * 4), ds.P, rtol=1e-9)
    np.testing.assert_allclose(ds.E, vijax.harvested_energy(vijax.Harvester(), ds.depth.values), rtol=1e-12)
    if wall == "rigid":  # its depths are lent from kappa, its motion is the same
        np.testing.assert_allclose(ds.depth.sel(kappa=40.0), 2 * ds.depth.sel(kappa=80.0), rtol=1e-12)
        assert np.array_equal(ds.v_in.sel(kappa=40.0), ds.v_in.sel(kappa=80.0), equal_nan=True)


def test_a_dataset_explains_itself_and_comes_back(tmp_path, rigid):
    assert rigid.attrs["along"] == "d"
    assert all(rigid[name].attrs.keys() >= {"units", "long_name"} for name in rigid.data_vars)
    assert "ok" in rigid.status.flag_meanings
    beyond = rigid.impact >= rigid.filled
    assert (np.isnan(rigid.v_in) == beyond).all()
    assert ((rigid.side * rigid.v_in > 0) | beyond).all()
    assert rigid.sizes["strobe"] == 25
    vijax.save(rigid, tmp_path / "diagram.zarr")
    assert vijax.load(tmp_path / "diagram.zarr").identical(rigid)


def test_progress_is_told():
    told = []
    orbit_diagram(
        along="d", values=[0.3, 0.2], periods=1, recorded_periods=1, progress=lambda *state: told.append(state)
    )
    assert told[0] == (0, 2)
    assert told[-1] == (2, 2)


@pytest.mark.parametrize(
    ("changed", "say"),
    [
        ({"along": "u0"}, "along must be among d, kappa"),
        ({"along": "x"}, "along must be among d, kappa"),
        ({"d": 0.2}, "d must not be given twice"),
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
def test_the_door(changed, say):
    with pytest.raises(ValueError, match=say):
        orbit_diagram(**{"along": "d", "values": [0.3, 0.2]} | changed)


def test_an_axis_that_is_none_is_named():
    with pytest.raises(TypeError, match="there is no axis 'x'"):
        orbit_diagram(along="d", values=[0.3, 0.2], x=1.0)
