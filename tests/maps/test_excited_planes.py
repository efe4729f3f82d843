"""Orbit diagrams, basins and labels under several harmonics, against the sine and against long trajectories."""

import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax import Harmonics, Noise, Waveform
from vijax.impact.forcing import forcing_of
from vijax.impact.taylor.driven import Driven
from vijax.model.forcing.waves import flight_motion, mean_velocity
from vijax.simulation.cell import chain

SINE = Harmonics([1.0, 0.0])
"""The sine, simulated by the general method for excitations."""
TWO = Harmonics([1.0, 0.4], [0.0, 0.5])
DIAGRAM = {"along": "d", "values": np.linspace(0.28, 0.16, 7), "r": 0.5, "periods": 200, "recorded_periods": 4}


@pytest.mark.long
def test_diagram_of_the_sine_agrees_with_the_general_method():
    reference, general = (vijax.orbit_diagram(**DIAGRAM, kappa=[40.0, 9.0], excitation=x) for x in (None, SINE))
    assert np.array_equal(reference["period"], general["period"])
    simple = (reference["period"] == 1).values
    assert simple.sum() > 8
    for name in ("v_in", "phase", "depth", "duration", "u_strobe", "v_strobe", "P", "filled", "period_number"):
        expected, actual = reference[name].values[simple], general[name].values[simple]
        width = min(expected.shape[-1], actual.shape[-1]) if expected.ndim > 1 else None
        np.testing.assert_allclose(expected[..., :width], actual[..., :width], rtol=0, atol=1e-9, err_msg=name)
    assert general.attrs["excitation"] == str(SINE)


@pytest.mark.long
def test_diagram_under_two_harmonics_agrees_with_trajectories():
    result = vijax.orbit_diagram(**DIAGRAM, kappa=40.0, excitation=TWO)
    assert (result["period"] == 1).sum() > 2
    for i in np.flatnonzero((result["period"] == 1).values):
        pair = vijax.impact_pair(float(result["d"][i]), 40.0, 0.5)
        point = result.isel(d=i)
        start = float(point["u_strobe"][0]), float(point["v_strobe"][0])
        path = vijax.trajectory(pair, *start, 3, excitation=TWO)
        np.testing.assert_allclose(path.states.u, start[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            path.impacts.v_in[: int(point["filled"]) // 4], point["v_in"][: int(point["filled"]) // 4]
        )


def test_ball_in_permanent_contact_reaches_its_steady_motion():
    """Gravity exceeds the forcing: the state at the end is the response of the membrane to all harmonics."""
    pair = vijax.impact_pair(0.2, 20.0, 0.3, np.array([2.0, -2.4]))
    start = -0.1 * np.sign(pair.gamma)
    path = vijax.trajectory(pair, start, 0.0, 12, excitation=TWO)
    steady = chain.resting(pair, jnp.zeros(2), Driven(forcing_of(TWO)))
    np.testing.assert_allclose(steady.u, path.states.u[:, -1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(steady.v, path.states.v[:, -1], rtol=0, atol=1e-11)


def test_closed_form_of_a_flight_without_impacts():
    """The closed-form flight agrees with a trajectory between distant walls, and `mean_velocity` with its drift."""
    pair, v0, t0 = vijax.impact_pair(1e3, 20.0, 0.5, np.array([0.0, 0.3])), 0.2, 0.7
    states = vijax.trajectory(pair, 0.0, v0, 3, t0, excitation=TWO).states
    waves = forcing_of(TWO).waves(jnp.asarray(t0))
    for k in range(3):
        displacement, v = flight_motion(waves, pair.gamma, jnp.full(2, v0), jnp.full(2, 2.0 * (k + 1) - t0))
        np.testing.assert_allclose(displacement, states.u[:, k], rtol=0, atol=1e-13)
        np.testing.assert_allclose(v, states.v[:, k], rtol=0, atol=1e-13)
    mean = float(mean_velocity(waves, jnp.asarray(v0)))
    assert mean == pytest.approx(float(states.u[0, 2] - states.u[0, 1]) / 2, abs=1e-13)


@pytest.mark.long
def test_labels_of_a_map_agree_with_long_trajectories():
    plane = {"d": np.linspace(0.12, 0.28, 5), "kappa": np.geomspace(6, 200, 5), "r": 0.5}
    result = vijax.sweep(**plane, excitation=TWO, outputs=["period", "impacts_left", "impacts_right", "P"])
    periodic = np.argwhere((result["period"] > 0).values)
    assert len(periodic) > 12
    pair = vijax.impact_pair(
        *(np.array([plane[n][j] for j in at]) for n, at in zip(("d", "kappa"), periodic.T, strict=True)), 0.5
    )
    start = np.minimum(0.05853, 0.49 * np.asarray(pair.d))
    path = vijax.trajectory(pair, start, -0.47898, 400, excitation=TWO)
    for row, (i, j) in enumerate(periodic):
        period, n = int(result["period"][i, j]), np.asarray(path.impacts.n[row])
        late = (n >= 400 - 24 * period) & (n < 400) & (np.asarray(path.impacts.side[row]) != 0)
        left = (np.asarray(path.impacts.side[row])[late] < 0).sum() / 24
        assert left == pytest.approx(float(result["impacts_left"][i, j]), abs=0.05)
        states = np.asarray(path.states.u[row])
        assert abs(states[-1] - states[-1 - period]) < 1e-4


@pytest.mark.long
def test_basins_under_two_harmonics():
    arguments = {"d": 0.2, "kappa": 3.0, "r": 0.5, "starts": 32}
    result = vijax.basin_fractions(**arguments, excitation=TWO)
    assert float(result["fraction"].sum()) == pytest.approx(1)
    sine, general = (vijax.basin_fractions(**arguments, excitation=x, merge_mirrors=True) for x in (None, SINE))
    assert list(sine["label"].values) == list(general["label"].values)
    np.testing.assert_allclose(sine["fraction"], general["fraction"])
    with pytest.raises(ValueError, match="merge_mirrors must be left out unless the excitation has odd harmonics"):
        vijax.basin_fractions(**arguments, excitation=TWO, merge_mirrors=True)
    assert Harmonics([1.0, 0.0, 0.2]).has_half_wave_symmetry


@pytest.mark.parametrize("excitation", [Waveform(np.ones(8), 8), SINE + Noise(0.1, 8)])
def test_attractor_search_requires_a_periodic_forcing(excitation):
    with pytest.raises(ValueError, match='until must be "window" with an excitation that does not repeat'):
        vijax.orbit_diagram(**DIAGRAM, kappa=40.0, excitation=excitation)
    with pytest.raises(ValueError, match='until must be "window" with an excitation that does not repeat'):
        vijax.basin_fractions(d=0.2, kappa=3.0, excitation=excitation)


def test_store_rejects_another_excitation(tmp_path):
    """A call with an excitation other than the excitation of the store is rejected, also for the sine."""
    from tests.helpers import no_cell_runs

    arguments = {"d": [0.2, 0.3], "kappa": 10.0, "until": "window", "periods": 5, "outputs": ["P"]}
    excitations = [None, SINE, SINE + Noise(0.1, 8), Waveform([0.0, 1.0, 0.5], 8.0)]
    with no_cell_runs():
        for i, excitation in enumerate(excitations):
            out = tmp_path / f"{i}.zarr"
            vijax.sweep(**arguments, excitation=excitation, out=out)
            vijax.sweep(**arguments, excitation=excitation, out=out)
            for other in excitations:
                if other is not excitation:
                    with pytest.raises(FileExistsError, match="where excitation is"):
                        vijax.sweep(**arguments, excitation=other, out=out)
