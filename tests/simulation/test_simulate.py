"""Simulation of cells from start to summary: attractors of the reference plane, averages, statuses, symmetries."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax import trajectory
from vijax.maps.sweep import sweep
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.simulation import simulate

DATA = Path(__file__).parents[1] / "data"
PLANE = json.loads((DATA / "plane_cells.json").read_text())["cells"]
ORBITS = json.loads((DATA / "gradients.json").read_text())["orbits"]
DEVICE = Harvester()
TILE = 1024  # the smallest tile of a plane, so that its programs are reused here
VARIANTS = np.array([1.0, 0.5])
ALONE = VARIANTS[:1]
HERE = jax.devices()[0]  # specified as planes do; otherwise JAX compiles the same program once more
ALL = frozenset({"P", "energy_ratio", "deepest", "lyapunov"})
START = (0.05853, -0.47898)
PAIR, MOTION = ("d", "kappa", "r", "gamma"), ("u0", "v0")


def cell(d, kappa=None, r=0.5, gamma=0.0, u0=None, v0=START[1]):
    return dict(d=d, kappa=kappa, r=r, gamma=gamma, u0=min(START[0], 0.49 * d) if u0 is None else u0, v0=v0)


def summarise(
    cells, periods=400, *, dtype="float64", length=1.0, outputs=ALL, variants=VARIANTS, order=None, **settings
):
    """Return the summary of cells as NumPy arrays, padded to the tile and computed in the specified order."""
    index = np.resize(np.arange(len(cells)) if order is None else order, TILE)

    def column(name):
        return jnp.asarray(np.array([cells[i][name] for i in index], dtype))

    rigid = cells[0]["kappa"] is None
    factor = jnp.asarray(variants.astype(dtype))
    summary = simulate.summarise(
        ImpactPair(column("d"), None if rigid else column("kappa"), column("r"), column("gamma")),
        column("u0"),
        column("v0"),
        simulate.Scale(jnp.full(TILE, length, dtype), jnp.full(TILE, length, dtype), factor, factor),
        DEVICE,
        periods=periods,
        outputs=outputs,
        count=len(cells),
        on=HERE,
        **settings,
    )
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(cells)], summary)


# --- the reference plane ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plane():
    return summarise(PLANE)


PERIODIC = np.array([cell["p"] > 0 for cell in PLANE])


def reference_values(name):
    return np.array([cell.get(name, 0) for cell in PLANE])  # an aperiodic cell has no counts


def test_periodic_cells_have_the_reference_period_counts_and_power(plane):
    assert not np.any(PERIODIC & (plane.period <= 0)), "a periodic cell was called aperiodic, or is undecided"
    periodic = PERIODIC
    assert np.sum(plane.status[periodic] != Status.OK) <= 1, "one cell is slow to converge"
    assert np.all(np.isin(plane.status[periodic], (Status.OK, Status.CONVERGING)))
    counts = [(cell["p"], cell.get("left"), cell.get("right")) for cell in PLANE]
    assert [(i, *counts[i]) for i in np.flatnonzero(periodic)] == [
        (i, plane.period[i], plane.impacts_left[i], plane.impacts_right[i]) for i in np.flatnonzero(periodic)
    ]
    # The reference is a simulation; it has 7 digits for the slow cell.
    error = np.abs(plane.P[:, 0] / reference_values("P_J") - 1)
    assert np.all(error[periodic] < np.where(plane.status[periodic] == Status.OK, 1e-9, 2e-7))
    assert np.all(plane.P_stderr[periodic] == 0)


def test_orbits_have_the_reference_impact_speeds(plane):
    periodic = np.flatnonzero(PERIODIC)
    fastest = [np.max(np.abs(PLANE[i]["impact_velocities"])) for i in periodic]
    number = [len(PLANE[i]["impact_velocities"]) / PLANE[i]["p"] for i in periodic]
    error = np.abs(plane.fastest[periodic] / fastest - 1)
    assert np.all(error < np.where(plane.status[periodic] == Status.OK, 1e-9, 5e-6))
    np.testing.assert_allclose(plane.impacts_per_period[periodic], number, rtol=1e-12)


# Attractors after 20,000 periods near pitchforks, flips and folds of the default map: d, kappa, label, P.
CREEPING = [
    (0.250587084148728, 114.10653837567223, (1, 1, 1), 2.4991626464094018e-05),
    (0.2589041095890411, 288.8515052612388, (1, 1, 1), 2.9087026003962114e-06),
    (0.10528375733855186, 17.977972596496514, (1, 2, 1), 0.0010050879020658489),
    (0.05684931506849315, 41.752192215870146, (1, 2, 2), 6.981420865886072e-05),
    (0.14246575342465753, 32.24056743462479, (2, 4, 2), 0.00034256965984922147),
    (0.13463796477495107, 243.12161058938304, (8, 14, 8), 2.3007413405909074e-06),
]


@pytest.mark.long
def test_a_slowly_converging_cell_has_the_label_of_its_limit():
    summary = summarise([cell(d, kappa, u0=0.0, v0=0.4) for d, kappa, *_ in CREEPING], 400, variants=ALONE)
    assert np.all(summary.status == Status.CONVERGING)
    labels = zip(summary.period, summary.impacts_left, summary.impacts_right, strict=True)
    assert list(labels) == [label for *_, label, _ in CREEPING]
    np.testing.assert_allclose(summary.P[:, 0], [P for *_, P in CREEPING], rtol=1e-9)
    assert np.all(summary.lyapunov < 0)


def test_a_slow_motion_near_an_unrelated_orbit_does_not_get_its_label():
    """Newton's method converges to an orbit of tiny impacts, but the ever slower ball never reaches that orbit."""
    summary = summarise([cell(0.20362035225048924, 3.0874251189801387, u0=0.0, v0=0.4)], 400, variants=ALONE)
    assert summary.period[0] <= 0


def test_a_cell_at_its_bifurcation_is_undecided():
    """The pitchfork of the 1:1 orbit, from its branch over d: the multiplier is 1 to the eighth digit."""
    summary = summarise([cell(0.24876858576293404, 100.0, v0=0.4)], 400, variants=ALONE)
    assert (summary.status[0], summary.period[0]) == (Status.SLOW, -1)
    assert summary.periods_run[0] >= 400


def test_power_of_aperiodic_cells_agrees_with_the_reference_within_errors(plane):
    chaos = ~PERIODIC
    assert np.all(plane.period[chaos] == 0)
    assert np.all(plane.status[chaos] == Status.OK)
    # The window of the reference is four times as long, so its error is half as large.
    error = plane.P_stderr[chaos, 0] * math.hypot(1, math.sqrt(300 / 1600))
    z = np.abs(plane.P[chaos, 0] - reference_values("P_J")[chaos]) / error
    assert z.max() <= 4
    assert np.median(z) <= 1.2


@pytest.mark.long
def test_longer_windows_have_smaller_errors(plane):
    aperiodic = [PLANE[i] for i in np.flatnonzero(~PERIODIC)]
    longer = summarise(aperiodic, periods=2000)
    short, long = plane.P_stderr[~PERIODIC, 0], longer.P_stderr[:, 0]
    assert np.all(long < 0.03 * longer.P[:, 0])
    # Factor 5 in length: sqrt(5) if the batches are long against the memory of the chaos; 12 periods are sometimes
    # short.
    assert 1.5 < np.median(short / long) < 5
    exponents = np.array([cell["lyapunov_per_period"] for cell in aperiodic])
    np.testing.assert_allclose(longer.lyapunov, exponents, rtol=0.1, atol=0.03)


def wide_cells(count):
    """Return level cells with wide gaps, where slow flights last hundreds of periods."""
    draw = np.random.default_rng(3)
    d, kappa, r = (
        np.exp(draw.uniform(0, np.log(10), count)),
        np.exp(draw.uniform(2.5, 6, count)),
        draw.uniform(0.3, 0.9, count),
    )
    return [cell(*row, u0=0.0, v0=0.7) for row in zip(d, kappa, r, strict=True)]


@pytest.fixture(scope="module")
def wide():
    return summarise(wide_cells(240), 400, variants=ALONE)


def test_a_cell_with_few_impacts_continues_like_a_longer_run(wide):
    """The run continues for up to 16 times the periods until 200 impacts; the status reports fewer than 100."""
    for periods in (1600, 6400):
        continued = np.flatnonzero(wide.periods_run == periods)
        assert continued.size > 20
        longer = summarise([wide_cells(240)[i] for i in continued], periods, variants=ALONE)
        same = longer.periods_run == periods
        assert same.sum() > 20
        for name in ("P", "P_stderr", "lyapunov", "impacts_per_period"):
            np.testing.assert_array_equal(getattr(wide, name)[continued[same]], getattr(longer, name)[same])
    hits = 0.75 * wide.periods_run * wide.impacts_per_period
    chaos = wide.period == 0
    assert (hits[chaos & (wide.periods_run < 6400)] > 199).all()
    np.testing.assert_array_equal((wide.status == Status.FEW_IMPACTS)[chaos], hits[chaos] < 99.5)


@pytest.mark.long
def test_standard_errors_are_correct_for_long_flights(wide):
    far = summarise(wide_cells(240), 25_600, variants=ALONE)
    both = (wide.period == 0) & (wide.status == Status.OK) & (far.period == 0)
    z = (wide.P - far.P)[both, 0] / np.hypot(wide.P_stderr, far.P_stderr)[both, 0]
    assert z.size > 150
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3
    assert np.mean(np.abs(z) > 3) < 0.03


def test_the_error_of_a_window_includes_flights_longer_than_observed():
    """Expected errors from batch means and flights of `trajectory`, before chaos separates the motions."""
    d, kappa, r, transient, periods = 0.776, 30.7, 0.3, 4, 48
    settings = {"until": "window", "transient": transient, "outputs": WINDOWED, "variants": ALONE}
    summary = summarise([cell(d, kappa, r, u0=0.0, v0=0.7)], periods, **settings)
    impacts = trajectory(ImpactPair(d, kappa, r, 0.0), 0.0, 0.7, transient + periods).impacts
    impacts = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(impacts.side) != 0], impacts)
    onset, contact_duration, depth = 2 * impacts.n + impacts.t, impacts.duration, impacts.depth
    flights = np.diff(onset - np.append(0, contact_duration.cumsum()[:-1]), prepend=0.0)
    flights = np.append(flights[onset >= 2 * transient], 2 * (transient + periods) - onset[-1] - contact_duration[-1])
    energies = np.asarray(harvested_energy(DEVICE, depth))[onset >= 2 * transient]
    batch = ((onset[onset >= 2 * transient] / 2 - transient) / 2).astype(int)
    means = np.bincount(batch, energies, 24) / 4
    longest, window = flights.max(), 2 * periods
    assert flights.size * longest**2 > 12 * (flights**2).sum()
    unobserved = 0.5 * (flights**2).sum() * np.sqrt(window / longest) / window**2
    expected = np.hypot(means.std(ddof=1) / np.sqrt(24), means.mean() * np.sqrt(unobserved))
    assert summary.P_stderr[0, 0] == pytest.approx(expected, rel=1e-6)


def test_a_cells_result_does_not_depend_on_its_place_in_the_batch(plane):
    order = np.random.default_rng(3).permutation(len(PLANE))
    shuffled = summarise(PLANE, order=order)
    computed = [name for name in simulate.Summary.__dataclass_fields__ if getattr(plane, name) is not None]
    assert len(computed) > 15
    for name in computed:
        there, here = getattr(shuffled, name), getattr(plane, name)[order]
        assert np.array_equal(there, here, equal_nan=True), name


@pytest.mark.long
def test_halved_units_and_a_variant_of_half_are_the_same(plane):
    half = summarise(PLANE, length=0.5)
    for name in ("P", "P_stderr", "energy_ratio"):
        assert np.array_equal(getattr(half, name)[:, 0], getattr(plane, name)[:, 1]), name
    assert np.array_equal(half.deepest, plane.deepest, equal_nan=True)


def test_means_per_side_combine_to_the_mean_of_both_sides(plane):
    count = plane.impacts_left + plane.impacts_right
    both = plane.impacts_left * plane.restitution_left + plane.impacts_right * plane.restitution_right
    on_both_sides = (plane.period > 0) & (plane.impacts_left > 0) & (plane.impacts_right > 0)
    np.testing.assert_allclose(plane.restitution[on_both_sides], both[on_both_sides] / count[on_both_sides], rtol=1e-12)
    np.testing.assert_allclose(plane.contact_fraction, plane.contact_time * plane.impacts_per_period / 2, rtol=1e-12)


# --- tangent ---------------------------------------------------------------------------------------------------------


def orbit_cell(orbit):
    u0, v0 = orbit["strobe"]
    return cell(orbit["d"], orbit["kappa"], orbit["r"], orbit["gamma"], u0, v0)


def largest_exponent(orbit):
    """Return the log of the modulus of the largest multiplier per period of a 1:1 orbit."""
    return max(math.log(math.hypot(*multiplier)) for multiplier in orbit["multipliers_strobe"])


def test_exponent_and_power_of_the_50_digit_orbits():
    level = [orbit for orbit in ORBITS if orbit["gamma"] == 0]
    summary = summarise([orbit_cell(orbit) for orbit in level])
    assert np.all(summary.period == 1)
    np.testing.assert_allclose(summary.lyapunov, [largest_exponent(orbit) for orbit in level], rtol=0, atol=1e-8)
    np.testing.assert_allclose(summary.P[:, 0], [float(orbit["P_J"]) for orbit in level], rtol=1e-11)
    np.testing.assert_allclose(summary.deepest, [max(map(float, orbit["dmax"])) for orbit in level], rtol=1e-11)


def test_exponent_of_a_rigid_orbit_with_complex_multipliers():
    # det = r^(2 n) over a period: the two complex multipliers have the modulus r^n.
    summary = summarise([cell(0.5)], variants=ALONE)
    assert (summary.period[0], summary.impacts_left[0], summary.impacts_right[0]) == (1, 1, 1)
    assert summary.lyapunov[0] == pytest.approx(2 * math.log(0.5), abs=1e-9)


# --- windows ---------------------------------------------------------------------------------------------------------

WINDOW = dict(transient=10, periods=40)
WINDOWED = frozenset({"P", "deepest"})
FEW = PLANE[:24]


@pytest.fixture(scope="module")
def recorded():
    """Impacts of 24 cells over the transient and the window, and of their mirrored starts half a period later."""
    sign = np.repeat([1.0, -1.0], len(FEW))
    d, kappa, r, gamma, u0, v0 = (np.tile([cell[name] for cell in FEW], 2) for name in PAIR + MOTION)
    pair = ImpactPair(*(jnp.asarray(x) for x in (d, kappa, r, gamma)))
    periods = WINDOW["transient"] + WINDOW["periods"]
    t0 = jnp.asarray(0.5 * (1 - sign))
    path = trajectory(pair, jnp.asarray(sign * u0), jnp.asarray(sign * v0), periods, t0, max_impacts=350)
    assert np.all(np.asarray(path.status) == Status.OK)
    return jax.tree.map(np.asarray, path)


def test_window_counts_the_impacts_with_their_onset_in_it(recorded):
    summary = summarise(FEW, until="window", outputs=WINDOWED, variants=ALONE, **WINDOW)
    for i in range(len(FEW)):
        hit = jax.tree.map(lambda leaf, i=i: leaf[i], recorded.impacts)
        inside = (hit.side != 0) & (hit.n >= WINDOW["transient"])
        joules = np.asarray(harvested_energy(DEVICE, jnp.asarray(hit.depth[inside]))).sum()
        if not FEW[i]["p"]:
            continue  # chaos amplifies the different rounding of the two methods
        assert summary.impacts_per_period[i] == inside.sum() / WINDOW["periods"]
        np.testing.assert_allclose(summary.contact_fraction[i], hit.duration[inside].sum() / 80, rtol=1e-7)
        np.testing.assert_allclose(summary.fastest[i], np.abs(hit.v_in[inside]).max(), rtol=1e-7)
        np.testing.assert_allclose(summary.deepest[i], hit.depth[inside].max(), rtol=1e-7)
        np.testing.assert_allclose(summary.P[i, 0], joules / 80, rtol=1e-7)
    assert np.all(summary.periods_run == 50)
    assert np.all(summary.period == -1)


@pytest.mark.long
def test_power_does_not_depend_on_the_energy_ratio_output(plane):
    alone = summarise(PLANE, outputs={"P"}, variants=ALONE)
    assert alone.energy_ratio is None
    assert plane.energy_ratio.max() > 0
    np.testing.assert_allclose(alone.P[PERIODIC, 0], plane.P[PERIODIC, 0], rtol=1e-11)


@pytest.mark.long
def test_a_mirrored_start_half_a_period_later_ends_on_the_mirrored_attractor(plane, recorded):
    regular = [i for i, reference in enumerate(FEW) if reference["p"] and reference["converged_after"] < 50]
    state = recorded.states
    row = [len(FEW) + i for i in regular]  # mirrored starts, at phase 0 of the next period
    starts = [FEW[i] | {"u0": state.u[j, 0], "v0": state.v[j, 0]} for i, j in zip(regular, row, strict=True)]
    mirrored = summarise(starts)
    assert np.array_equal(mirrored.period, plane.period[regular])
    assert np.array_equal(mirrored.impacts_left, plane.impacts_right[regular])
    assert np.array_equal(mirrored.impacts_right, plane.impacts_left[regular])
    np.testing.assert_allclose(mirrored.P, plane.P[regular], rtol=1e-10)
    np.testing.assert_allclose(mirrored.restitution_left, plane.restitution_right[regular], rtol=1e-9)


# --- how cells end ---------------------------------------------------------------------------------------------------


def test_motion_that_fits_between_the_walls_has_no_impact():
    # u = -cos(pi t)/pi^2, the centred orbit of the neutral family, and a neighbour of it.
    ball = dict(v0=0.0, u0=-1 / math.pi**2)
    summary = summarise([cell(0.3, 12.65, **ball), cell(0.21, 400.0, **ball), cell(0.3, 4.0, u0=-0.1, v0=0.0)])
    assert np.all(summary.status == Status.NO_IMPACT)
    for name in ("P", "P_stderr", "energy_ratio", "deepest", "fastest", "impacts_per_period", "contact_fraction"):
        assert np.all(getattr(summary, name) == 0), name
    assert np.all(summary.impacts_left == 0)
    assert np.all(np.isnan(summary.restitution))
    assert np.all(np.isnan(summary.lyapunov))


@pytest.mark.parametrize("kappa", [40.0, pytest.param(None, marks=pytest.mark.long)])
def test_gravity_above_the_forcing_ends_in_permanent_contact(kappa):
    summary = summarise([cell(0.3, kappa, gamma=gamma, u0=0.0, v0=0.1) for gamma in (-2.0, 2.0)], 60, variants=ALONE)
    assert np.all(summary.status == Status.PERMANENT_CONTACT)
    assert np.all(summary.P == 0)
    assert np.all(summary.contact_fraction == 1)
    assert np.all(summary.impacts_per_period == 0)


def test_chatter_on_rigid_walls_ends_in_sticking():
    summary = summarise([cell(0.02), cell(0.01), cell(0.3)], variants=ALONE)
    assert list(summary.status) == [Status.STICKING, Status.STICKING, Status.OK]
    assert np.array_equal(summary.period, [1, 1, 1])
    assert np.array_equal(summary.impacts_left, summary.impacts_right)
    assert np.all(summary.contact_fraction[:2] > 0.2)
    assert np.all(summary.lyapunov[:2] == -np.inf)  # a stuck ball loses all information about its start


def test_more_impacts_than_the_budget_end_a_cell_alone():
    # An elastic wall conserves the speed: 2 |v|/d = 4000 impacts a period.
    summary = summarise([cell(0.005, r=1.0, u0=0.0, v0=10.0), cell(0.3)], 30, variants=ALONE)
    assert list(summary.status) == [Status.EVENT_BUDGET, Status.OK]
    assert np.all(np.isnan(summary.P[0]))
    assert summary.period[0] == -1
    assert np.all(summary.P[1] > 0)


def test_a_start_inside_a_soft_wall_is_a_contact_without_onset():
    inside, outside = cell(0.2, 12.65, u0=0.11, v0=-0.1), cell(0.2, 12.65)
    summary = summarise([inside, outside])
    np.testing.assert_allclose(summary.P[0], summary.P[1], rtol=1e-10)


# --- other programs --------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_window_has_a_lyapunov_exponent():
    orbit = next(orbit for orbit in ORBITS if orbit["gamma"] == 0)
    window = summarise([orbit_cell(orbit)], 200, until="window", outputs={"lyapunov"}, variants=ALONE)
    assert window.lyapunov[0] == pytest.approx(largest_exponent(orbit), abs=0.05)


def test_inclined_cells_agree_with_the_50_digit_orbit_and_reach_attractors():
    orbit = next(orbit for orbit in ORBITS if orbit["gamma"] != 0)
    cells = [orbit_cell(orbit), cell(0.3, 12.65, gamma=0.1), cell(0.2, 400.0, gamma=0.1)]
    summary = summarise(cells, 60, variants=ALONE)
    assert np.all(summary.status == Status.OK)
    assert np.all(summary.period == 1)
    assert summary.lyapunov[0] == pytest.approx(largest_exponent(orbit), abs=1e-8)
    np.testing.assert_allclose(summary.P[0, 0], float(orbit["P_J"]), rtol=1e-11)


@pytest.mark.long
def test_a_near_recurrence_without_an_orbit_does_not_prolong_a_run():
    """Repeated rounds failed and restarted the window each time: 7,678 periods instead of 400."""
    counts = ["period", "impacts_left", "impacts_right"]
    plane = sweep(d=0.05, kappa=65.9459038750667, gamma=0.1, outputs=[*counts, "periods_run", "status"])
    assert int(plane.status) == Status.CONVERGING
    assert (int(plane.period), int(plane.impacts_left), int(plane.impacts_right)) == (24, 90, 48)
    assert plane.periods_run < 1000


@pytest.mark.long
def test_periods_in_single_precision_are_the_same():
    # A seventh of these cells once had twice their period, because the decay near a flip was taken as an orbit.
    axes = {"d": np.linspace(0.05, 0.3, 36), "kappa": np.geomspace(3, 400, 36), "r": 0.5, "gamma": 0.1}
    double, single = (sweep(**axes, outputs=["period"], dtype=kind).period.values for kind in ("float64", "float32"))
    periodic = double > 0
    assert periodic.sum() > 900
    assert (single != double)[periodic].mean() < 0.01


@pytest.mark.long
def test_a_long_period_persists_for_thousands_of_periods():
    # Chaotic motions pass these orbits, which attract from a tiny neighbourhood only; Newton's method may converge to
    # them.
    for d, kappa, r in (
        (0.42213485860502636, 2.8083176198774358, 0.3414784028305109),
        (0.13992353802728440, 118.61016650019532, 0.6504155346023393),
    ):
        plane = sweep(d=d, kappa=kappa, r=r, outputs=["period", "max_impact_speed", "status"])
        if (period := int(plane.period)) > 8:
            axes = {"d": d, "kappa": kappa, "r": r, "outputs": ["max_impact_speed"]}
            later = sweep(**axes, until="window", transient=5000, periods=period)
            # The slow orbit has the multiplier exp(-8e-5) per period: the motion is then within 1.5e-6 of it.
            near = 1e-6 if int(plane.status) == Status.OK else 3e-6
            assert float(later.max_impact_speed) == pytest.approx(float(plane.max_impact_speed), rel=near)
