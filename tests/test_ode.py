"""The stepping engines through the same cases as the exact one: accuracy, orders, events, gradients, maps, membranes."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import reference_trajectories

import vijax
from vijax import ode
from vijax.membrane import Linear
from vijax.method import Ode, Rk4
from vijax.model import ImpactPair, State, Status, impact_pair, membrane_pair

LANES, PERIODS, ROOM = 8, 6, 48  # the one shape in which trajectories are compiled
FIELDS = ("t", "v_in", "v_out", "depth", "duration", "work")
FINE = Ode("Dopri8", 1e-10, 1e-12, Linear())
# Largest error of the first 8 impacts of the reference trajectories, about ten times what was measured.
METHODS = {
    "exact": (None, 1e-12),
    "Dopri8": (FINE, 2e-10),
    "Tsit5": (Ode("Tsit5", 1e-8, 1e-10, Linear()), 2e-6),
    "Kvaerno5": (Ode("Kvaerno5", 1e-8, 1e-10, Linear()), 1e-5),
}


def follow(cases, method, t0=0.0):
    """Trajectories of (d, kappa, r, gamma, u0, v0), padded to one shape."""
    table = np.array([[np.nan if x is None else x for x in case] for case in cases], float)
    table = np.resize(table, (LANES, 6))
    d, kappa, r, gamma, u, v = table.T
    pair = impact_pair(d, kappa, r, gamma)
    if np.isnan(r).any():
        pair = ImpactPair(pair.d, pair.kappa, None, pair.gamma)
    ran = vijax.trajectory(pair, u, v, PERIODS, t0, max_impacts=ROOM, method="exact" if method is None else method)
    return jax.tree.map(lambda x: np.asarray(x)[: len(cases)], ran)


def time(impacts):
    return 2 * impacts.n + impacts.t


@pytest.mark.parametrize("name", METHODS)
def test_first_impacts_of_the_reference_trajectories(name):
    method, tolerance = METHODS[name]
    soft = [case for case in reference_trajectories() if "tc" in case["impacts"][0]]
    cases = [[*(case["case"][key] for key in ("d", "kappa", "r", "gamma")), case["u0"], case["v0"]] for case in soft]
    ran = follow([[float(x) for x in case] for case in cases], method)
    for lane, case in enumerate(soft):
        true = np.array([[float(hit[key]) for key in ("t", "vin", "vout", "tc", "dmax")] for hit in case["impacts"][:8]])
        hits = jax.tree.map(lambda x, lane=lane: x[lane, : len(true)], ran.impacts)
        got = np.stack([time(hits), hits.v_in, hits.v_out, hits.duration, hits.depth], axis=1)
        assert np.abs(got - true).max() < tolerance, case["case"]


REGULAR = [(0.2, 4.0, 0.5, 0.0, 0.02, 0.3), (0.3, 8.0, 0.5, 0.05, 0.02, 0.3), (0.25, 12.0, 0.3, 0.0, 0.02, 0.3)]
# Steps per period over which the error falls from the coarse to well above rounding.
LADDERS = {"Bosh3": (64, 96, 144, 216), "Tsit5": (40, 60, 90, 135), "Dopri8": (20, 25, 32, 40), "Kvaerno5": (48, 72, 108)}
ORDERS = {"Bosh3": 3, "Tsit5": 5, "Dopri8": 8, "Kvaerno5": 5}


def errors(method):
    """Mean errors of the impacts against the exact engine's, one a lane and field."""
    exact, ran = follow(REGULAR, None), follow(REGULAR, method)
    assert np.array_equal(ran.impacts.side, exact.impacts.side)
    return np.mean([np.nanmean(np.abs(getattr(ran.impacts, x) - getattr(exact.impacts, x))) for x in ("t", "v_in", "v_out")])


def slope(steps, sizes):
    return -np.polyfit(np.log(steps), np.log(sizes), 1)[0]


@pytest.mark.parametrize("solver", LADDERS)
def test_located_events_keep_the_order_of_the_solver(solver):
    sizes = [errors(Ode(solver, 1e-11, 1e-11, Linear(), dt=2.0 / steps)) for steps in LADDERS[solver]]
    assert slope(LADDERS[solver], sizes) > ORDERS[solver] - 0.3, sizes


def test_samples_without_events_are_of_first_order():
    steps = (200, 400, 800, 1600, 3200)
    assert abs(slope(steps, [errors(Rk4(count, Linear())) for count in steps]) - 1) < 0.3
