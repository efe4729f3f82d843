"""Combined faults of a store in random runs; `benchmarks/store_faults.py` makes more runs."""

import random
from collections import Counter
from contextlib import closing

import jax
import pytest

from benchmarks import store_faults
from benchmarks.disk_model import random_state
from benchmarks.store_faults import Kill, StoreMachine, files_of
from tests.helpers import stand_in
from vijax.simulation import simulate

RUNS, STEPS = 15, 6
TEARS = 100


@pytest.fixture(scope="module", autouse=True)
def engine():
    """Replace the engine by a stand-in; the storage does not depend on the values."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "summarise", stand_in)
        patch.setenv("VIJAX_TILE", "6")
        patch.setattr("vijax.maps.execution.dispatch.tile_devices", lambda: jax.devices()[:1])
        yield


@pytest.fixture(scope="module")
def stores(engine):
    return store_faults.undisturbed()


def test_a_store_survives_faults_in_combination(stores):
    steps = store_faults.run(stores, RUNS, STEPS)
    assert sum(count for step, count in steps.items() if step.startswith("finish")) >= RUNS


@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.parametrize("at", [1, 2, 4])
def test_file_names_that_a_killed_run_did_not_flush_are_flushed_by_the_next_run(stores, at, exchanges):
    """A power cut after the second run loses neither the store nor the names of its files."""
    machine = StoreMachine(stores, Counter())
    with closing(machine.stack):
        machine.choose_disk(exchanges)
        machine.begin_or_resume("other", None)
        machine.overwrite("one", Kill("flush", at))
        machine.resume(None)
        expected = {f"{machine.path.name}/{name}": content for name, content in files_of(machine.path).items()}
        for seed in range(TEARS):
            state = random_state(machine.recording, random.Random(seed))
            assert {name: state.get(name) for name in expected} == expected
