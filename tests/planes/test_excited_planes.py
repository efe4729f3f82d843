"""Orbit diagrams, basins and labels under several harmonics: those of the sine by the same way, and long motions."""

import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax import Harmonics, Noise, Waveform
from vijax.batch import chain
from vijax.engine.driven import Driven
from vijax.engine.forcing import forcing
from vijax.model.waves import drift, mean_velocity

SINE = Harmonics([1.0, 0.0])
"""The sine, by the method of all other excitations."""
TWO = Harmonics([1.0, 0.4], [0.0, 0.5])
ALONG = {"along": "d", "values": np.linspace(0.28, 0.16, 7), "r": 0.5, "periods": 200, "recorded_periods": 4}


@pytest.mark.long
def test_a_diagram_of_the_sine_by_the_method_of_all_others():
    one, other = (vijax.orbit_diagram(**ALONG, kappa=[40.0, 9.0], excitation=x) for x in (None, SINE))
    assert np.array_equal(one["period"], other["period"])
    simple = (one["period"] == 1).values
    assert simple.sum() > 8
    for name in ("v_in", "phase", "depth", "duration", "u_strobe", "v_strobe", "P", "filled", "period_number"):
        ours, theirs = one[name].values[simple], other[name].values[simple]
        width = min(ours.shape[-1], theirs.shape[-1]) if ours.ndim > 1 else None
        np.testing.assert_allclose(ours[..., :width], theirs[..., :width], rtol=0, atol=1e-9, err_msg=name)
    assert other.attrs["excitation"] == str(SINE)


@pytest.mark.long
def test_a_diagram_under_two_harmonics_is_where_long_motions_end():
    found = vijax.orbit_diagram(**ALONG, kappa=40.0, excitation=TWO)
    assert (found["period"] == 1).sum() > 2
    for i in np.flatnonzero((found["period"] == 1).values):
        pair = vijax.impact_pair(float(found["d"][i]), 40.0, 0.5)
        last = found.isel(d=i)
        start = float(last["u_strobe"][0]), float(last["v_strobe"][0])
        path = vijax.trajectory(pair, *start, 3, excitation=TWO)
        np.testing.assert_allclose(path.states.u, start[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            path.impacts.v_in[: int(last["filled"]) // 4], last["v_in"][: int(last["filled"]) // 4]
        )


def test_a_ball_held_for_ever_comes_to_its_steady_motion():
    """Gravity above the forcing: what is handed on is the response of the membrane to every harmonic."""
    pair = vijax.impact_pair(0.2, 20.0, 0.3, np.array([2.0, -2.4]))
    start = -0.1 * np.sign(pair.gamma)
    path = vijax.trajectory(pair, start, 0.0, 12, excitation=TWO)
    held = chain.resting(pair, jnp.zeros(2), Driven(forcing(TWO)))
    np.testing.assert_allclose(held.u, path.states.u[:, -1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(held.v, path.states.v[:, -1], rtol=0, atol=1e-11)


def test_a_flight_that_meets_no_wall():
    """Where a round closes, or a diagram hands a ball on, it drifts: as it flies between walls that are far away."""
    pair, v0, t0 = vijax.impact_pair(1e3, 20.0, 0.5, np.array([0.0, 0.3])), 0.2, 0.7
    states = vijax.trajectory(pair, 0.0, v0, 3, t0, excitation=TWO).states
    ahead = forcing(TWO).waves(jnp.asarray(t0))
    for k in range(3):
        rise, v = drift(ahead, pair.gamma, jnp.full(2, v0), jnp.full(2, 2.0 * (k + 1) - t0))
        np.testing.assert_allclose(rise, states.u[:, k], rtol=0, atol=1e-13)
        np.testing.assert_allclose(v, states.v[:, k], rtol=0, atol=1e-13)
    mean = float(mean_velocity(ahead, jnp.asarray(v0)))
    assert mean == pytest.approx(float(states.u[0, 2] - states.u[0, 1]) / 2, abs=1e-13)


@pytest.mark.long
def test_labels_of_a_map_are_those_of_long_motions():
    plane = {"d": np.linspace(0.12, 0.28, 5), "kappa": np.geomspace(6, 200, 5), "r": 0.5}
    found = vijax.sweep(**plane, excitation=TWO, outputs=["period", "impacts_left", "impacts_right", "P"])
    known = np.argwhere((found["period"] > 0).values)
    assert len(known) > 12
    pair = vijax.impact_pair(
        *(np.array([plane[n][j] for j in at]) for n, at in zip(("d", "kappa"), known.T, strict=True)), 0.5
    )
    start = np.minimum(0.05853, 0.49 * np.asarray(pair.d))
    path = vijax.trajectory(pair, start, -0.47898, 400, excitation=TWO)
    for row, (i, j) in enumerate(known):
        period, n = int(found["period"][i, j]), np.asarray(path.impacts.n[row])
        late = (n >= 400 - 24 * period) & (n < 400) & (np.asarray(path.impacts.side[row]) != 0)
        left = (np.asarray(path.impacts.side[row])[late] < 0).sum() / 24
        assert left == pytest.approx(float(found["impacts_left"][i, j]), abs=0.05)
        states = np.asarray(path.states.u[row])
        assert abs(states[-1] - states[-1 - period]) < 1e-4


@pytest.mark.long
def test_basins_under_two_harmonics():
    told = {"d": 0.2, "kappa": 3.0, "r": 0.5, "starts": 32}
    found = vijax.basin_fractions(**told, excitation=TWO)
    assert float(found["fraction"].sum()) == pytest.approx(1)
    sine, same = (vijax.basin_fractions(**told, excitation=x, merge_mirrors=True) for x in (None, SINE))
    assert list(sine["label"].values) == list(same["label"].values)
    np.testing.assert_allclose(sine["fraction"], same["fraction"])
    with pytest.raises(ValueError, match="merge_mirrors must be left out unless the excitation has odd harmonics"):
        vijax.basin_fractions(**told, excitation=TWO, merge_mirrors=True)
    assert Harmonics([1.0, 0.0, 0.2]).mirrored


@pytest.mark.parametrize("excitation", [Waveform(np.ones(8), 8), SINE + Noise(0.1, 8)])
def test_attractors_want_a_forcing_that_repeats(excitation):
    with pytest.raises(ValueError, match='until must be "window" with an excitation that does not repeat'):
        vijax.orbit_diagram(**ALONG, kappa=40.0, excitation=excitation)
    with pytest.raises(ValueError, match='until must be "window" with an excitation that does not repeat'):
        vijax.basin_fractions(d=0.2, kappa=3.0, excitation=excitation)


def test_a_store_is_of_one_excitation(tmp_path):
    """Whatever excitation a store was made with, a call with another one is refused, the sine too."""
    from tests.helpers import no_cell_runs

    told = {"d": [0.2, 0.3], "kappa": 10.0, "until": "window", "periods": 5, "outputs": ["P"]}
    every = [None, SINE, SINE + Noise(0.1, 8), Waveform([0.0, 1.0, 0.5], 8.0)]
    with no_cell_runs():
        for i, one in enumerate(every):
            out = tmp_path / f"{i}.zarr"
            vijax.sweep(**told, excitation=one, out=out)
            vijax.sweep(**told, excitation=one, out=out)
            for other in every:
                if other is not one:
                    with pytest.raises(FileExistsError, match="where excitation is"):
                        vijax.sweep(**told, excitation=other, out=out)
