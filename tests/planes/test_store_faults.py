"""Faults of a store in combination: random runs, of which `benchmarks/store_faults.py` makes more."""

import jax
import pytest

from benchmarks import store_faults
from tests.helpers import stand_in
from vijax.batch import simulate

RUNS, STEPS = 20, 8


@pytest.fixture(autouse=True)
def engine(monkeypatch):
    """A stand-in for the engine: what a store does with arrays does not depend on how they are computed."""
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", "6")
    monkeypatch.setattr("vijax.planes.dispatch.places", lambda: jax.devices()[:1])


def test_a_store_survives_faults_in_combination():
    store_faults.run(RUNS, STEPS)
