"""Methods by name: the door, maps by every method, membranes without a closed form."""

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
from vijax.batch.simulate import Scale, summarise
from vijax.engine.method import HELD, ImpactOutcome, Method
from vijax.engine.method_choice import OPTIONS, choose, record
from vijax.engine.ode import Ode
from vijax.model.membrane import Linear
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status

PLANE = {"d": np.linspace(0.08, 0.3, 6), "kappa": np.geomspace(4, 300, 6), "r": 0.5, "u0": 0.0, "v0": 0.4}

# --- the door ---------------------------------------------------------------------------------------------------------


def test_defaults():
    assert choose("exact", {"solver": None, "membrane": Linear()}) is None
    method = choose("ode", {})
    assert (method.solver, method.rtol, method.atol, method.dt) == ("Tsit5", 1e-8, 1e-10, None)
    assert choose("ode", {}, dtype="float32").rtol > 1e-6
    assert choose("rk4", {}).steps == 1000
    assert set(OPTIONS) == {"exact", "ode", "rk4"}


def test_record_tells_every_number():
    method = choose("ode", {"solver": "Dopri8", "rtol": 1e-10, "atol": 1e-12, "membrane": HuntCrossley(0.5)})
    told = {"solver": "Dopri8", "rtol": 1e-10, "atol": 1e-12, "membrane": "hunt-crossley with chi 0.5, exponent 1.5"}
    assert record(method) == told
    assert record(choose("rk4", {"steps": 200})) == {"steps": 200, "membrane": "linear"}
    assert record(None) == {}


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ({"chi": -0.1}, "chi must be one finite number of at least 0; got -0.1"),
        ({"chi": np.nan}, "chi must"),
        ({"chi": [0.1, 0.2]}, "chi must"),
        ({"chi": "much"}, "chi must"),
        ({"chi": 0.5, "exponent": 0.5}, "exponent must be one finite number of at least 1"),
        ({"chi": 0.5, "exponent": np.inf}, "exponent must"),
    ],
)
def test_bad_membranes_are_named(numbers, says):
    with pytest.raises(ValueError, match=says):
        HuntCrossley(**numbers)


@pytest.mark.parametrize(
    ("arguments", "says"),
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
def test_trajectory_names_bad_input(arguments, says):
    given = {"pair": ImpactPair(0.2, 40.0, 0.5, 0.0), "u0": 0.0, "v0": 0.3, "periods": 4} | arguments
    with pytest.raises(ValueError, match=says):
        vijax.trajectory(**given)


# --- maps -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exact():
    return sweep(**PLANE, periods=200)


@pytest.mark.long
def test_attractors_by_steps_are_those_of_the_exact_engine(exact):
    found = sweep(**PLANE, periods=200, method="ode", solver="Dopri8", rtol=1e-10, atol=1e-12)
    assert set(found) == set(exact)
    periodic = (exact["period"] > 0) & (exact["status"] == 0)
    assert int(periodic.sum()) > 25
    for name in ("period", "impacts_left", "impacts_right", "status"):
        assert bool((found[name] == exact[name]).where(periodic, True).all()), name
    for name in ("P", "energy_ratio", "max_penetration", "restitution", "contact_time"):
        wrong = abs(found[name] / exact[name] - 1).where(periodic, 0.0)
        assert float(wrong.max()) < 1e-6, name
    assert found.attrs["solver"] == "Dopri8"


@pytest.mark.long
def test_windows_by_steps(exact):
    window = {"until": "window", "periods": 4, "outputs": ["impacts_per_period", "max_impact_speed"]}
    true = sweep(**PLANE, **window)
    # Samples miss or double an impact here and there, at the stiffest walls.
    for options, impacts, tolerance in (({"method": "ode"}, 0, 1e-6), ({"method": "rk4", "steps": 800}, 0.1, 0.3)):
        found = sweep(**PLANE, **window, **options)
        assert float(abs(found["impacts_per_period"] - true["impacts_per_period"]).mean()) <= impacts
        assert float(abs(found["max_impact_speed"] / true["max_impact_speed"] - 1).max()) < tolerance


@pytest.mark.long
def test_a_cell_does_not_depend_on_its_company():
    window = {"until": "window", "periods": 5, "outputs": ["max_impact_speed"], "method": "ode"}
    many = sweep(**PLANE, **window)["max_impact_speed"].values
    one = sweep(**(PLANE | {"d": PLANE["d"][2], "kappa": PLANE["kappa"][3]}), **window)["max_impact_speed"].values
    assert many[2, 3] == one


def test_unstable_steps_are_said():
    # kappa h = 4 is beyond the stability limit of the scheme.
    blown = sweep(d=0.1, kappa=400.0, r=0.5, method="rk4", steps=200, until="window", periods=4, outputs=["status"])
    assert int(blown["status"]) == vijax.Status.NONFINITE


# --- a method of one's own --------------------------------------------------------------------------------------------


class Sample(eqx.Module):
    """The carry of a leapfrog: the last sample, and when its contact and its flight began."""

    u: Array
    v: Array
    k: Array
    n: Array
    mode: Array
    onset_t: Array
    onset_n: Array
    v_in: Array
    depth: Array
    left: Array


def time(n, t):
    return 2.0 * n.astype(t.dtype) + t


class Leapfrog(Method[Sample]):
    """Half a kick, a drift, half a kick; the contact decided by the sign of a sample. All starts are at phase 0."""

    steps: float

    def start(self, pair, state, *, deep, tangent):
        """The carry of a start; of greatest depths and tangent maps it knows none."""
        zero = 0 * state.u
        return Sample(
            state.u, state.v, zero, state.n, state.mode, state.t, state.n, state.v, zero, time(state.n, state.t)
        )

    def push(self, pair, wall, m, k):
        """The acceleration at a sample."""
        side = jnp.where(m.u < 0, -1.0, 1.0)
        w = side * m.u - 0.5 * pair.d
        forcing = jnp.cos(2 * jnp.pi * k / self.steps) - pair.gamma
        return forcing + jnp.where(w > 0, side * wall(w, side * m.v), 0.0)

    def step(self, pair, wall, m, *, recorded=False):
        """The next sample."""
        h = 2 / self.steps
        middle = m.v + 0.5 * h * self.push(pair, wall, m, m.k)
        new = replace(m, u=m.u + h * middle, v=middle)
        new = replace(new, v=middle + 0.5 * h * self.push(pair, wall, new, m.k + 1))
        over = m.k + 1 >= self.steps
        k, n = jnp.where(over, 0.0, m.k + 1), m.n + over.astype(m.n.dtype)
        w, t = jnp.abs(new.u) - 0.5 * pair.d, k * h
        mode = jnp.where(w > 0, jnp.sign(new.u), 0.0).astype(m.mode.dtype)
        onset, exits = (mode != 0) & (m.mode == 0), (mode == 0) & (m.mode != 0)
        now, begun = time(n, t), time(m.onset_n, m.onset_t)
        impact = Impact(m.onset_n, m.onset_t, m.mode, m.v_in, new.v, m.depth, now - begun, 0 * t)
        outcome = ImpactOutcome(impact, begun - m.left, State(new.u, new.v, t, n, mode), None)
        new = replace(
            new,
            k=k,
            n=n,
            mode=mode,
            onset_t=jnp.where(onset, t, m.onset_t),
            onset_n=jnp.where(onset, n, m.onset_n),
            v_in=jnp.where(onset, new.v, m.v_in),
            depth=jnp.where(onset, w, jnp.maximum(m.depth, w)),
            left=jnp.where(exits, now, m.left),
        )
        return new, outcome, exits

    def ball(self, pair, m):
        """The last sample."""
        return State(m.u, m.v, 2 * m.k / self.steps, m.n, m.mode)

    def most_steps(self, pair, periods, max_impacts):
        """As many as there are samples."""
        return int(self.steps) * (periods + HELD)


LEAPFROG = Leapfrog(4000.0)


def test_a_trajectory_by_a_method_of_ones_own():
    pair = impact_pair(0.2, 20.0, 0.5)
    exact, found = (vijax.trajectory(pair, 0.0, 0.4, 2, method=method) for method in ("exact", LEAPFROG))
    np.testing.assert_allclose(found.states.u, exact.states.u, atol=1e-3)  # worst measured: 6e-4
    assert np.array_equal(found.impacts.side, exact.impacts.side)
    np.testing.assert_allclose(found.impacts.duration, exact.impacts.duration, atol=2 / LEAPFROG.steps)


class Impatient(Leapfrog):
    """Stopped long before its last period."""

    def most_steps(self, pair, periods, max_impacts):
        """As many as a period has, and a little more."""
        return int(self.steps) + 1


def test_a_run_is_stopped_after_so_many_steps():
    pair, method = impact_pair(0.2, 20.0, 0.5), Impatient(1000.0)
    starts = np.linspace(0.3, 0.4, 3)
    for runs in (
        vijax.trajectory(pair, 0.0, starts, 6, method=method),
        jax.vmap(lambda v: vijax.trajectory(pair, 0.0, v, 6, method=method))(starts),
    ):
        assert (np.asarray(runs.status) == Status.EVENT_BUDGET).all()
        np.testing.assert_array_equal(np.isfinite(runs.states.u), [[True] + [False] * 5] * 3)


@pytest.mark.long
def test_a_plane_by_a_method_of_ones_own():
    d = jnp.asarray([0.1, 0.2, 0.3])
    one = jnp.ones_like(d)
    pair, scale = ImpactPair(d, 20 * one, 0.5 * one, 0 * one), Scale(one, one, jnp.ones(1), jnp.ones(1))
    told = {"periods": 2, "until": "window", "outputs": frozenset({"deepest"}), "method": LEAPFROG}
    found = summarise(pair, 0 * one, 0.4 * one, scale, Harvester(), **told)
    impacts = vijax.trajectory(pair, 0.0, 0.4, 2).impacts
    np.testing.assert_array_equal(found.impacts_per_period, (impacts.side != 0).sum(axis=1) / 2)
    for name, true in (
        ("fastest", np.nanmax(np.abs(impacts.v_in), axis=1)),
        ("deepest", np.nanmax(impacts.depth, axis=1)),
        ("contact_time", np.nanmean(impacts.duration, axis=1)),
    ):
        np.testing.assert_allclose(getattr(found, name), true, rtol=1e-2, err_msg=name)
    assert record(LEAPFROG) == {"steps": 4000.0, "membrane": "linear"}


# --- Hunt and Crossley ------------------------------------------------------------------------------------------------


def contact(law, kappa, gamma, t, v, count=20000):
    """A contact from phase t at speed v, in classical steps that end by the secant: exit time, speed, depth, work."""
    wall = law.wall(ImpactPair(0.2, jnp.asarray(kappa), None, gamma))
    square, chi, power = (float(x) for x in (wall.square, wall.chi, wall.exponent))

    def slope(s, y):
        spring = square * max(y[0], 0.0) ** power
        push = np.cos(np.pi * s) - gamma - spring * (1 + chi * y[1])
        return np.array([y[1], push, chi * spring * y[1] ** 2])  # the last: what the damper takes

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
            # On the left wall the forcing is that of the right one half a period later, with gravity reversed.
            shift = 0.0 if side > 0 else 1.0
            true = contact(law, float(pair.kappa[lane]), side * gamma, hit["t"] + shift, abs(hit["v_in"]))
            got = (hit["duration"], abs(hit["v_out"]), hit["depth"], hit["work"])
            assert np.allclose(got, true, rtol=2e-6), (got, true)


@pytest.mark.long
def test_hunt_crossley_maps():
    axes = {"d": [0.2, 0.25, 0.3], "kappa": [60.0, 200.0]}
    found = sweep(**axes, method="ode", membrane=HuntCrossley(0.8))
    assert int((found["status"] == 0).sum()) >= 4
    assert np.isnan(found["r"]).all()
    restitution = found["restitution"]
    assert float(restitution.min()) > 0.3
    assert float(restitution.max()) < 1
    assert float(restitution.max() - restitution.min()) > 0.01  # it is a result: slower impacts lose less
    assert "hunt-crossley" in found.attrs["membrane"]


# --- a law of one's own -----------------------------------------------------------------------------------------------


class Elastic(vijax.MembraneLaw):
    """One that loses nothing, whatever r is."""

    restitution: ClassVar[bool] = False

    def acceleration(self, pair, w, z):
        """A spring."""
        return -(pair.kappa**2) * w


class Series(vijax.MembraneLaw):
    """One with a name, and as many coefficients as are given."""

    name: str = eqx.field(static=True)
    odd: Array

    def acceleration(self, pair, w, z):
        """A sum of odd powers."""
        powers = w ** jnp.arange(1.0, 2 * self.odd.size, 2)
        return -(pair.kappa**2 * (self.odd * powers).sum() + pair.mu * z)


def test_a_law_holds_arrays_and_names():
    pair, series = impact_pair([0.2, 0.25], 40.0, 0.5), Series("measured", jnp.asarray([1.0, 500.0]))
    flown = [vijax.trajectory(pair, 0.02, 0.3, 3, method="ode", membrane=law) for law in (Cubic(500.0), series)]
    np.testing.assert_allclose(flown[1].states.u, flown[0].states.u, rtol=1e-9)
    assert str(series) == "Series with name measured, odd [1.0, 500.0]"


@pytest.mark.parametrize(
    "options",
    [pytest.param({"method": "ode"}, marks=pytest.mark.long), {"method": "rk4", "steps": 100}],
    ids=["ode", "rk4"],
)
def test_the_linear_law_by_hand_is_the_linear_membrane(options):
    pair = impact_pair([0.2, 0.25], [40.0, 100.0], 0.5, [0.0, 0.1])
    plain, own = (vijax.trajectory(pair, 0.02, 0.3, 4, membrane=law, **options) for law in (None, Plain()))
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(own), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-10, atol=1e-12)


def test_rk4_puts_no_law_into_a_kernel_that_may_call_a_library():
    assert choose("rk4", {}).arithmetic
    assert choose("rk4", {"membrane": HuntCrossley(0.5)}).arithmetic
    assert not choose("rk4", {"membrane": Plain()}).arithmetic


@pytest.mark.long
def test_a_map_is_made_with_a_law_of_ones_own_and_names_it():
    axes = {"d": [0.2, 0.25], "kappa": [40.0, 100.0], "r": 0.5, "periods": 60, "method": "ode"}
    plain, own = sweep(**axes), sweep(**axes, membrane=Plain())
    assert (plain.period > 0).all()
    np.testing.assert_array_equal(own.period, plain.period)
    np.testing.assert_allclose(own.P, plain.P, rtol=1e-12)
    assert (plain.attrs["membrane"], own.attrs["membrane"]) == ("linear", "Plain")
    assert record(choose("ode", {"membrane": Cubic(500.0)}))["membrane"] == "Cubic with beta 500"


def test_a_contact_of_ones_own_law_is_that_of_another_solver():
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


def test_a_motion_has_derivatives_in_the_numbers_of_a_law():
    def end(beta):
        law = Cubic(beta)
        ran = vijax.trajectory(impact_pair(0.2, 40.0, 0.5), 0.02, 0.3, 3, method="ode", membrane=law, rtol=1e-11)
        return ran.states.u[-1]

    slope = jax.grad(end)(500.0)
    np.testing.assert_allclose(slope, (end(505.0) - end(495.0)) / 10, rtol=1e-5)


@pytest.mark.long
def test_a_law_without_restitution_is_given_none():
    pair = ImpactPair(0.2, 40.0, None, 0.0)
    ran = vijax.trajectory(pair, 0.02, 0.3, 4, method="ode", membrane=Elastic(), rtol=1e-11, atol=1e-13)
    hits = int(ran.filled)
    assert hits > 4
    np.testing.assert_allclose(ran.impacts.work[:hits], 0, atol=1e-9)
    found = sweep(d=0.2, kappa=40.0, method="ode", membrane=Elastic(), until="window", periods=5)
    assert np.isnan(found.r)
    with pytest.raises(ValueError, match="r must be left out with a membrane"):
        sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Elastic())


def test_a_law_that_does_not_push_a_ball_out_is_refused():
    for force, says in (
        (lambda w: 1.0 * w, r"below 0, which pushes the ball out, at w = 1e-06, w' = 0; got 1e-06 of Wrong"),
        (lambda w: jnp.nan * w, "acceleration must be 0 at w = 0, w' = 0; got nan"),
        (lambda w: jnp.where(w < 0.01, -w, 0.0), "below 0, which pushes the ball out, at w = 0.01"),
        (lambda w: -1.0 - w, "acceleration must be 0 at w = 0, w' = 0; got -1"),
        (lambda w: -jnp.stack([w, w]), r"acceleration must be 0 at w = 0, w' = 0; got \[-?0.0"),
    ):

        class Wrong(vijax.MembraneLaw):
            def acceleration(self, pair, w, z, force=force):
                return force(w)

        with pytest.raises(ValueError, match=says):
            sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Wrong())


@pytest.mark.long
def test_a_plane_by_an_implicit_solver():
    """Its linear systems are LAPACK's, which no kernel may call."""
    told = {
        "d": 0.12,
        "kappa": 40.0,
        "until": "window",
        "periods": 3,
        "method": "ode",
        "outputs": ["impacts_per_period"],
    }
    implicit, explicit = sweep(solver="Kvaerno3", **told), sweep(solver="Tsit5", **told)
    assert int(implicit.status) == Status.OK
    assert float(implicit.impacts_per_period) == float(explicit.impacts_per_period)
