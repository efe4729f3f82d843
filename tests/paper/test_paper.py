"""Claims of the paper that are fast to check, with the corrected values of `tests/data/claims.json`."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax import impact_pair, sweep
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.simulation import simulate

CLAIMS = {c["id"]: c for c in json.loads((Path(__file__).parents[1] / "data" / "claims.json").read_text())}
TABLE_2 = Harvester()
STARTS = [(u, v) for u in (-0.04, 0.0, 0.04) for v in (-0.6, -0.47898, -0.3, 0.3, 0.5)]
# The smallest tile of a map; with the device passed as maps pass it, the tests use the compiled programs of maps.
TILE = 1024


def attractors(gaps, kappa=None, r=0.5):
    """Return, for each gap, the labels and powers of the attractors of all starts, with mirror images merged."""
    d, index = np.repeat(gaps, len(STARTS)), np.tile(np.arange(len(STARTS)), len(gaps))
    u0, v0 = np.array(STARTS)[index].T
    count = d.size

    def column(x):
        return jnp.asarray(np.resize(np.broadcast_to(x, count), TILE) * 1.0)

    unity = jnp.ones(TILE)
    # The simulated depth at a rigid wall is the depth at kappa = 1.
    unit = unity if kappa is not None else unity / (TABLE_2.omega0 * math.pi / TABLE_2.omega)
    summary = simulate.summarise(
        ImpactPair(column(d), None if kappa is None else column(kappa), column(r), column(0.0)),
        column(u0),
        column(v0),
        simulate.Scale(unit, unity, jnp.ones(1), jnp.ones(1)),
        TABLE_2,
        outputs=frozenset({"P"}),
        count=count,
        on=jax.devices()[0],
    )
    summary = jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(len(gaps), len(STARTS), -1), summary)
    return [row(summary, i) for i in range(len(gaps))]


def row(summary, i):
    """Return the labels n:m/pT of the starts at a gap, the smaller count first, and their powers."""
    names = []
    for j in range(len(STARTS)):
        low, high = sorted((int(summary.impacts_left[i, j, 0]), int(summary.impacts_right[i, j, 0])))
        p = int(summary.period[i, j, 0])
        names.append("slow" if summary.status[i, j, 0] == Status.SLOW else f"{low}:{high}/{p}T")
    return np.array(names), summary.P[i, :, 0]


RIGID = [0.16, 0.18, 0.182, 0.186, 0.19, 0.2, 0.21, 0.25, 0.28, 0.3]


@pytest.fixture(scope="module")
def rigid():
    return dict(zip(RIGID, attractors(np.array(RIGID)), strict=True))


def test_t2_damping_of_table_2():
    reference = CLAIMS["T2-mu"]
    assert float(TABLE_2.pair().mu) == pytest.approx(reference["oracle_accurate"], rel=1e-10)
    assert float(impact_pair(d=0.3, kappa=400, r=0.5).mu) == pytest.approx(reference["paper"], abs=5e-3)


@pytest.mark.parametrize("d", [0.21, 0.25, 0.28, 0.3])
def test_h1_one_to_one_is_the_attractor_of_wide_rigid_gaps(rigid, d):
    assert set(rigid[d][0]) == {"1:1/1T"}


@pytest.mark.parametrize("d", [0.19, 0.2])
def test_h5_one_to_two_coexists_with_one_to_one(rigid, d):
    assert set(rigid[d][0]) == {"1:1/1T", "1:2/1T"}


@pytest.mark.parametrize("d", [0.18, 0.182, 0.186])
def test_h3_two_to_four_in_two_periods_below_the_flip(rigid, d):
    assert set(rigid[d][0]) == {"2:4/2T"}


def test_h6_two_to_three_in_two_periods(rigid):
    assert set(rigid[0.16][0]) == {"2:3/2T"}


def test_e1_microjoules_and_not_the_printed_millijoules(rigid):
    power = {d: labels_power[1][labels_power[0] == "1:1/1T"] for d, labels_power in rigid.items()}
    assert power[0.3] == pytest.approx(1.68e-6, rel=5e-3)
    assert power[0.2] == pytest.approx(1.18e-6, rel=5e-3)
    assert power[0.19] == pytest.approx(1.13e-6, rel=1e-2)


def test_p1_power_of_one_to_one_grows_with_the_gap(rigid):
    means = [rigid[d][1][rigid[d][0] == "1:1/1T"].mean() for d in (0.19, 0.2, 0.21, 0.25, 0.28, 0.3)]
    assert np.all(np.diff(means) > 0)


@pytest.fixture(scope="module")
def soft():
    return dict(zip([0.11, 0.12, 0.2, 0.3], attractors(np.array([0.11, 0.12, 0.2, 0.3]), kappa=12.65), strict=True))


@pytest.mark.long
def test_f8_one_to_one_for_gaps_from_0_106_at_kappa_12_65(soft):
    assert all(set(labels) == {"1:1/1T"} for labels, _ in soft.values())


@pytest.mark.long
def test_e1_soft_walls_near_the_rigid_limit_give_the_same_energy():
    ((labels, power),) = attractors(np.array([0.3]), kappa=400.0)
    assert set(labels) == {"1:1/1T"}
    assert power == pytest.approx(1.699e-6, rel=1e-3)


@pytest.mark.long
def test_f11b_asymmetric_one_to_one():
    ds = sweep(d=0.12, kappa=np.array([10.5, 12.65]), outputs=("period", "restitution_left", "restitution_right"))
    difference = np.abs(ds.restitution_left - ds.restitution_right).values
    assert list(ds.period.values) == [1, 1]
    assert difference[0] < 1e-9
    assert difference[1] > 1e-2
