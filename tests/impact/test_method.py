"""Choice of the method: validation, maps by each method, custom methods, membranes without a closed form."""

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.integrate import solve_ivp

import vijax
from tests.helpers import Cubic, Plain
from vijax import Harvester, HuntCrossley, sweep
from vijax.impact.method import MAX_CONTACT_PERIODS, ImpactOutcome, Method
from vijax.impact.method_choice import METHOD_OPTIONS, choose_method, method_attributes
from vijax.impact.ode.ode import Ode
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status
from vijax.model.walls.membrane import Linear
from vijax.simulation.simulate import Scale, summarise

PLANE = {"d": np.linspace(0.08, 0.3, 6), "kappa": np.geomspace(4, 300, 6), "r": 0.5, "u0": 0.0, "v0": 0.4}

# --- validation -------------------------------------------------------------------------------------------------------


def test_defaults():
    assert choose_method("exact", {"solver": None, "membrane": Linear()}) is None
    method = choose_method("ode", {})
    assert (method.solver, method.rtol, method.atol, method.dt) == ("Tsit5", 1e-8, 1e-10, None)
    assert choose_method("ode", {}, dtype="float32").rtol > 1e-6
    assert choose_method("rk4", {}).steps == 1000
    assert set(METHOD_OPTIONS) == {"exact", "ode", "rk4"}


def test_method_attributes_contain_all_settings():
    method = choose_method("ode", {"solver": "Dopri8", "rtol": 1e-10, "atol": 1e-12, "membrane": HuntCrossley(0.5)})
    expected = {
        "solver": "Dopri8",
        "rtol": 1e-10,
        "atol": 1e-12,
        "membrane": "hunt-crossley with chi 0.5, exponent 1.5",
    }
    assert method_attributes(method) == expected
    assert method_attributes(choose_method("rk4", {"steps": 200})) == {"steps": 200, "membrane": "linear"}
    assert method_attributes(None) == {}


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"chi": -0.1}, "chi must be one finite number of at least 0; got -0.1"),
        ({"chi": np.nan}, "chi must"),
        ({"chi": [0.1, 0.2]}, "chi must"),
        ({"chi": "much"}, "chi must"),
        ({"chi": 0.5, "exponent": 0.5}, "exponent must be one finite number of at least 1"),
        ({"chi": 0.5, "exponent": np.inf}, "exponent must"),
    ],
)
def test_errors_name_invalid_membrane_arguments(numbers, message):
    with pytest.raises(ValueError, match=message):
        HuntCrossley(**numbers)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "euler"}, "method must be"),
        ({"method": "ode", "solver": "Euler"}, "solver must be among"),
        ({"steps": 100}, "steps must be left out"),
        ({"membrane": HuntCrossley(0.5)}, "membrane must be linear for method"),
        ({"method": "ode", "membrane": HuntCrossley(0.5)}, "r must be None"),
        ({"method": "ode", "pair": ImpactPair(0.2, 40.0, None, 0.0)}, "r must be None"),
        ({"pair": ImpactPair(0.2, 40.0, None, 0.0)}, "r must be None"),
        ({"method": "ode", "pair": ImpactPair(0.2, None, 0.5, 0.0)}, 'wall must be "soft"'),
    ],
)
def test_errors_of_trajectory_name_the_invalid_argument(arguments, message):
    call = {"pair": ImpactPair(0.2, 40.0, 0.5, 0.0), "u0": 0.0, "v0": 0.3, "periods": 4} | arguments
    with pytest.raises(ValueError, match=message):
        vijax.trajectory(**call)


# --- maps -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exact():
    return sweep(**PLANE, periods=200)


@pytest.mark.long
def test_attractors_by_time_steps_equal_those_of_the_exact_method(exact):
    stepped = sweep(**PLANE, periods=200, method="ode", solver="Dopri8", rtol=1e-10, atol=1e-12)
    assert set(stepped) == set(exact)
    periodic = (exact["period"] > 0) & (exact["status"] == 0)
    assert int(periodic.sum()) > 25
    for name in ("period", "impacts_left", "impacts_right", "status"):
        assert bool((stepped[name] == exact[name]).where(periodic, True).all()), name
    for name in ("P", "energy_ratio", "max_penetration", "restitution", "contact_time"):
        wrong = abs(stepped[name] / exact[name] - 1).where(periodic, 0.0)
        assert float(wrong.max()) < 1e-6, name
    assert stepped.attrs["solver"] == "Dopri8"


@pytest.mark.long
def test_windows_by_time_steps(exact):
    window = {"until": "window", "periods": 4, "outputs": ["impacts_per_period", "max_impact_speed"]}
    true = sweep(**PLANE, **window)
    # The samples of a fixed-step method miss or double a few impacts at the stiffest walls.
    for options, impacts, tolerance in (({"method": "ode"}, 0, 1e-6), ({"method": "rk4", "steps": 800}, 0.1, 0.3)):
        stepped = sweep(**PLANE, **window, **options)
        assert float(abs(stepped["impacts_per_period"] - true["impacts_per_period"]).mean()) <= impacts
        assert float(abs(stepped["max_impact_speed"] / true["max_impact_speed"] - 1).max()) < tolerance


@pytest.mark.long
def test_a_cell_does_not_depend_on_other_cells():
    window = {"until": "window", "periods": 5, "outputs": ["max_impact_speed"], "method": "ode"}
    many = sweep(**PLANE, **window)["max_impact_speed"].values
    single = sweep(**(PLANE | {"d": PLANE["d"][2], "kappa": PLANE["kappa"][3]}), **window)["max_impact_speed"].values
    assert many[2, 3] == single


def test_unstable_steps_are_reported():
    # kappa h = 4 exceeds the stability limit of the scheme.
    blown = sweep(d=0.1, kappa=400.0, r=0.5, method="rk4", steps=200, until="window", periods=4, outputs=["status"])
    assert int(blown["status"]) == vijax.Status.NONFINITE


# --- a custom method --------------------------------------------------------------------------------------------------


class Sample(eqx.Module):
    """The carry of a leapfrog: the last sample, and the start times of its contact and its flight."""

    u: Array
    v: Array
    k: Array
    n: Array
    mode: Array
    onset_t: Array
    onset_n: Array
    v_in: Array
    depth: Array
    flight_start: Array


def time(n, t):
    return 2.0 * n.astype(t.dtype) + t


class Leapfrog(Method[Sample]):
    """Half a kick, a drift, half a kick; the sign of a sample decides about contact. All starts are at phase 0."""

    steps: float

    def start(self, pair, state, *, deep, tangent):
        """Return the carry of a start; this method computes no greatest depths and no tangent maps."""
        zero = 0 * state.u
        return Sample(
            state.u, state.v, zero, state.n, state.mode, state.t, state.n, state.v, zero, time(state.n, state.t)
        )

    def push(self, pair, wall, m, k):
        """Return the acceleration at a sample."""
        side = jnp.where(m.u < 0, -1.0, 1.0)
        w = side * m.u - 0.5 * pair.d
        forcing = jnp.cos(2 * jnp.pi * k / self.steps) - pair.gamma
        return forcing + jnp.where(w > 0, side * wall(w, side * m.v), 0.0)

    def step(self, pair, wall, m, *, recorded=False):
        """Return the next sample, its impact, and True if a contact ends."""
        h = 2 / self.steps
        middle = m.v + 0.5 * h * self.push(pair, wall, m, m.k)
        new = replace(m, u=m.u + h * middle, v=middle)
        new = replace(new, v=middle + 0.5 * h * self.push(pair, wall, new, m.k + 1))
        over = m.k + 1 >= self.steps
        k, n = jnp.where(over, 0.0, m.k + 1), m.n + over.astype(m.n.dtype)
        w, t = jnp.abs(new.u) - 0.5 * pair.d, k * h
        mode = jnp.where(w > 0, jnp.sign(new.u), 0.0).astype(m.mode.dtype)
        onset, exits = (mode != 0) & (m.mode == 0), (mode == 0) & (m.mode != 0)
        now, onset_time = time(n, t), time(m.onset_n, m.onset_t)
        impact = Impact(m.onset_n, m.onset_t, m.mode, m.v_in, new.v, m.depth, now - onset_time, 0 * t)
        outcome = ImpactOutcome(impact, onset_time - m.flight_start, State(new.u, new.v, t, n, mode), None)
        new = replace(
            new,
            k=k,
            n=n,
            mode=mode,
            onset_t=jnp.where(onset, t, m.onset_t),
            onset_n=jnp.where(onset, n, m.onset_n),
            v_in=jnp.where(onset, new.v, m.v_in),
            depth=jnp.where(onset, w, jnp.maximum(m.depth, w)),
            flight_start=jnp.where(exits, now, m.flight_start),
        )
        return new, outcome, exits

    def ball(self, pair, m):
        """Return the ball at the last sample."""
        return State(m.u, m.v, 2 * m.k / self.steps, m.n, m.mode)

    def most_steps(self, pair, periods, max_impacts):
        """Return the number of samples in the simulated periods."""
        return int(self.steps) * (periods + MAX_CONTACT_PERIODS)


LEAPFROG = Leapfrog(4000.0)


def test_a_trajectory_by_a_custom_method():
    pair = impact_pair(0.2, 20.0, 0.5)
    exact, custom = (vijax.trajectory(pair, 0.0, 0.4, 2, method=method) for method in ("exact", LEAPFROG))
    np.testing.assert_allclose(custom.states.u, exact.states.u, atol=1e-3)  # largest measured: 6e-4
    assert np.array_equal(custom.impacts.side, exact.impacts.side)
    np.testing.assert_allclose(custom.impacts.duration, exact.impacts.duration, atol=2 / LEAPFROG.steps)


class FewSteps(Leapfrog):
    """A leapfrog that stops long before its last period."""

    def most_steps(self, pair, periods, max_impacts):
        """Return the number of samples in one period, plus one."""
        return int(self.steps) + 1


def test_a_run_stops_after_its_maximum_number_of_steps():
    pair, method = impact_pair(0.2, 20.0, 0.5), FewSteps(1000.0)
    starts = np.linspace(0.3, 0.4, 3)
    for runs in (
        vijax.trajectory(pair, 0.0, starts, 6, method=method),
        jax.vmap(lambda v: vijax.trajectory(pair, 0.0, v, 6, method=method))(starts),
    ):
        assert (np.asarray(runs.status) == Status.EVENT_BUDGET).all()
        np.testing.assert_array_equal(np.isfinite(runs.states.u), [[True] + [False] * 5] * 3)


@pytest.mark.long
def test_a_plane_by_a_custom_method():
    d = jnp.asarray([0.1, 0.2, 0.3])
    unity = jnp.ones_like(d)
    pair, scale = ImpactPair(d, 20 * unity, 0.5 * unity, 0 * unity), Scale(unity, unity, jnp.ones(1), jnp.ones(1))
    settings = {"periods": 2, "until": "window", "outputs": frozenset({"deepest"}), "method": LEAPFROG}
    summary = summarise(pair, 0 * unity, 0.4 * unity, scale, Harvester(), **settings)
    impacts = vijax.trajectory(pair, 0.0, 0.4, 2).impacts
    np.testing.assert_array_equal(summary.impacts_per_period, (impacts.side != 0).sum(axis=1) / 2)
    for name, true in (
        ("fastest", np.nanmax(np.abs(impacts.v_in), axis=1)),
        ("deepest", np.nanmax(impacts.depth, axis=1)),
        ("contact_time", np.nanmean(impacts.duration, axis=1)),
    ):
        np.testing.assert_allclose(getattr(summary, name), true, rtol=1e-2, err_msg=name)
    assert method_attributes(LEAPFROG) == {"steps": 4000.0, "membrane": "linear"}


# --- Hunt and Crossley ------------------------------------------------------------------------------------------------


def contact(law, kappa, gamma, t, v, count=20000):
    """Integrate a contact from phase t at speed v by RK4 with a secant end; return exit time, speed, depth and work."""
    wall = law.bind(ImpactPair(0.2, jnp.asarray(kappa), None, gamma))
    square, chi, power = (float(x) for x in (wall.square, wall.chi, wall.exponent))

    def slope(s, y):
        spring = square * max(y[0], 0.0) ** power
        push = np.cos(np.pi * s) - gamma - spring * (1 + chi * y[1])
        return np.array([y[1], push, chi * spring * y[1] ** 2])  # the last: power of the damper

    reach = ((power + 1) * v**2 / (2 * square)) ** (1 / (power + 1))  # of an undamped contact
    h = 4 * reach / v / count
    y, deepest = np.array([0.0, v, 0.0]), 0.0
    for k in range(10 * count):
        s = t + k * h
        a = slope(s, y)
        b = slope(s + h / 2, y + h / 2 * a)
        c = slope(s + h / 2, y + h / 2 * b)
        after = y + h / 6 * (a + 2 * b + 2 * c + slope(s + h, y + h * c))
        deepest = max(deepest, after[0])
        if after[0] <= 0:
            part = y[0] / (y[0] - after[0])
            return (k + part) * h, -(y + part * (after - y))[1], deepest, after[2]
        y = after
    raise AssertionError("no exit")


def test_a_free_contact_has_the_restitution_of_its_law():
    # v dv = -kappa^2 w^n (1 + chi v) dw on the way in and out: chi v - ln(1 + chi v) is the same at both ends.
    law = HuntCrossley(1.2, exponent=1.7)
    for v in (0.05, 0.5):
        _, out, _, work = contact(law, 3e7, 0.0, 0.5, v, count=4000)
        ends = [law.chi * x - np.log1p(law.chi * x) for x in (v, -out)]
        assert abs(ends[0] / ends[1] - 1) < 1e-4
        assert abs(work / (0.5 * (v**2 - out**2)) - 1) < 1e-4


def test_contacts_of_a_membrane_without_closed_form():
    law = HuntCrossley(0.8)
    pair = impact_pair([0.2, 0.15], [40.0, 150.0], 0.5, [0.0, 0.05])
    pair = ImpactPair(pair.d, pair.kappa, None, pair.gamma)
    ran = vijax.trajectory(pair, 0.02, 0.3, 4, method=Ode("Dopri8", 1e-10, 1e-12, law=law))
    for lane in range(2):
        for k in (0, 3):
            hit = {
                name: float(getattr(ran.impacts, name)[lane, k])
                for name in ("t", "v_in", "v_out", "depth", "duration", "work")
            }
            gamma, side = float(pair.gamma[lane]), int(ran.impacts.side[lane, k])
            # On the left wall the forcing is the forcing of the right wall half a period later, and gravity is
            # reversed.
            shift = 0.0 if side > 0 else 1.0
            true = contact(law, float(pair.kappa[lane]), side * gamma, hit["t"] + shift, abs(hit["v_in"]))
            got = (hit["duration"], abs(hit["v_out"]), hit["depth"], hit["work"])
            assert np.allclose(got, true, rtol=2e-6), (got, true)


@pytest.mark.long
def test_hunt_crossley_maps():
    axes = {"d": [0.2, 0.25, 0.3], "kappa": [60.0, 200.0]}
    plane = sweep(**axes, method="ode", membrane=HuntCrossley(0.8))
    assert int((plane["status"] == 0).sum()) >= 4
    assert np.isnan(plane["r"]).all()
    restitution = plane["restitution"]
    assert float(restitution.min()) > 0.3
    assert float(restitution.max()) < 1
    assert float(restitution.max() - restitution.min()) > 0.01  # restitution is a result: slower impacts lose less
    assert "hunt-crossley" in plane.attrs["membrane"]


# --- a custom membrane law --------------------------------------------------------------------------------------------


class Elastic(vijax.MembraneLaw):
    """A membrane without loss, independent of r."""

    restitution: ClassVar[bool] = False

    def acceleration(self, pair, w, z):
        """Return the acceleration by a spring."""
        return -(pair.kappa**2) * w


class Series(vijax.MembraneLaw):
    """A membrane with a name and any number of coefficients."""

    name: str = eqx.field(static=True)
    odd: Array

    def acceleration(self, pair, w, z):
        """Return the acceleration by a sum of odd powers."""
        powers = w ** jnp.arange(1.0, 2 * self.odd.size, 2)
        return -(pair.kappa**2 * (self.odd * powers).sum() + pair.mu * z)


def test_a_law_may_have_arrays_and_names_as_fields():
    pair, series = impact_pair([0.2, 0.25], 40.0, 0.5), Series("measured", jnp.asarray([1.0, 500.0]))
    paths = [vijax.trajectory(pair, 0.02, 0.3, 3, method="ode", membrane=law) for law in (Cubic(500.0), series)]
    np.testing.assert_allclose(paths[1].states.u, paths[0].states.u, rtol=1e-9)
    assert str(series) == "Series with name measured, odd [1.0, 500.0]"


@pytest.mark.parametrize(
    "options",
    [pytest.param({"method": "ode"}, marks=pytest.mark.long), {"method": "rk4", "steps": 100}],
    ids=["ode", "rk4"],
)
def test_a_custom_linear_law_equals_the_linear_membrane(options):
    pair = impact_pair([0.2, 0.25], [40.0, 100.0], 0.5, [0.0, 0.1])
    plain, custom = (vijax.trajectory(pair, 0.02, 0.3, 4, membrane=law, **options) for law in (None, Plain()))
    for expected, actual in zip(jax.tree.leaves(plain), jax.tree.leaves(custom), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-12)


def test_rk4_puts_no_law_into_a_kernel_that_may_call_a_library():
    assert choose_method("rk4", {}).arithmetic
    assert choose_method("rk4", {"membrane": HuntCrossley(0.5)}).arithmetic
    assert not choose_method("rk4", {"membrane": Plain()}).arithmetic


@pytest.mark.long
def test_a_map_with_a_custom_law_names_the_law():
    axes = {"d": [0.2, 0.25], "kappa": [40.0, 100.0], "r": 0.5, "periods": 60, "method": "ode"}
    plain, custom = sweep(**axes), sweep(**axes, membrane=Plain())
    assert (plain.period > 0).all()
    np.testing.assert_array_equal(custom.period, plain.period)
    np.testing.assert_allclose(custom.P, plain.P, rtol=1e-12)
    assert (plain.attrs["membrane"], custom.attrs["membrane"]) == ("linear", "Plain")
    assert method_attributes(choose_method("ode", {"membrane": Cubic(500.0)}))["membrane"] == "Cubic with beta 500"


def test_a_contact_of_a_custom_law_agrees_with_scipy():
    pair, law = impact_pair(0.2, 40.0, 0.5), Cubic(500.0)
    ran = vijax.trajectory(pair, 0.02, 0.3, 4, method="ode", membrane=law, rtol=1e-11, atol=1e-13)
    hit = {name: float(getattr(ran.impacts, name)[0]) for name in ("t", "side", "v_in", "v_out", "depth", "duration")}

    def slope(t, y):
        push = hit["side"] * np.cos(np.pi * t) - 1600 * (y[0] + 500 * y[0] ** 3) - float(pair.mu) * y[1]
        return y[1], push

    def out(t, y):
        return y[0] if t > hit["t"] else 1.0

    def crest(t, y):
        return y[1]

    out.terminal, out.direction = True, -1
    start = (0.0, hit["side"] * hit["v_in"])
    true = solve_ivp(slope, (hit["t"], hit["t"] + 1), start, "DOP853", events=(out, crest), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(true.t[-1] - hit["t"], hit["duration"], rtol=1e-8)
    np.testing.assert_allclose(hit["side"] * true.y[1, -1], hit["v_out"], rtol=1e-8)
    np.testing.assert_allclose(true.y_events[1][0][0], hit["depth"], rtol=1e-8)


def test_a_motion_has_derivatives_by_the_parameters_of_a_law():
    def end(beta):
        law = Cubic(beta)
        ran = vijax.trajectory(impact_pair(0.2, 40.0, 0.5), 0.02, 0.3, 3, method="ode", membrane=law, rtol=1e-11)
        return ran.states.u[-1]

    slope = jax.grad(end)(500.0)
    np.testing.assert_allclose(slope, (end(505.0) - end(495.0)) / 10, rtol=1e-5)


@pytest.mark.long
def test_a_law_without_restitution_requires_that_r_is_none():
    pair = ImpactPair(0.2, 40.0, None, 0.0)
    ran = vijax.trajectory(pair, 0.02, 0.3, 4, method="ode", membrane=Elastic(), rtol=1e-11, atol=1e-13)
    hits = int(ran.filled)
    assert hits > 4
    np.testing.assert_allclose(ran.impacts.work[:hits], 0, atol=1e-9)
    plane = sweep(d=0.2, kappa=40.0, method="ode", membrane=Elastic(), until="window", periods=5)
    assert np.isnan(plane.r)
    with pytest.raises(ValueError, match="r must be left out with a membrane"):
        sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Elastic())


def test_a_law_that_does_not_push_a_ball_out_is_rejected():
    for force, message in (
        (lambda w: 1.0 * w, r"below 0, which pushes the ball out, at w = 1e-06, w' = 0; got 1e-06 of Wrong"),
        (lambda w: jnp.nan * w, "acceleration must be 0 at w = 0, w' = 0; got nan"),
        (lambda w: jnp.where(w < 0.01, -w, 0.0), "below 0, which pushes the ball out, at w = 0.01"),
        (lambda w: -1.0 - w, "acceleration must be 0 at w = 0, w' = 0; got -1"),
        (lambda w: -jnp.stack([w, w]), r"acceleration must be 0 at w = 0, w' = 0; got \[-?0.0"),
    ):

        class Wrong(vijax.MembraneLaw):
            def acceleration(self, pair, w, z, force=force):
                return force(w)

        with pytest.raises(ValueError, match=message):
            sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Wrong())


@pytest.mark.long
def test_a_plane_by_an_implicit_solver():
    """The linear systems of an implicit solver call LAPACK, and a kernel cannot call a library."""
    settings = {
        "d": 0.12,
        "kappa": 40.0,
        "until": "window",
        "periods": 3,
        "method": "ode",
        "outputs": ["impacts_per_period"],
    }
    implicit, explicit = sweep(solver="Kvaerno3", **settings), sweep(solver="Tsit5", **settings)
    assert int(implicit.status) == Status.OK
    assert float(implicit.impacts_per_period) == float(explicit.impacts_per_period)
