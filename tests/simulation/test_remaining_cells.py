"""The remaining cells of an accelerator's tile are shared among the cores, and each result returns to its row."""

import jax
import numpy as np
import pytest

from vijax.model.device import Harvester
from vijax.simulation.cell.cell import Plan, Settings
from vijax.simulation.scheduler import remaining_cells

SETTINGS = Settings(np.ones(()), np.ones(()), Harvester(), None, np.ones(1), np.ones(1))


@pytest.fixture
def counts(monkeypatch):
    """Three cores that double their values; the list of the numbers of cells, one number per call."""
    counts_of_cells = []

    def double(table, count, settings):
        assert jax.default_device.value.platform == "cpu"
        assert isinstance(settings.periods, np.ndarray)
        assert table.shape[0] == remaining_cells._CELLS_PER_CORE
        assert not table[count:].any()
        counts_of_cells.append(int(count))
        return 2 * table[:, :2]

    monkeypatch.setattr(remaining_cells, "_compiled", lambda plan: double)
    monkeypatch.setattr(remaining_cells.tiles, "workers", lambda: 3)
    return counts_of_cells


@pytest.mark.parametrize(("cells", "expected"), [(0, [0] * 3), (1, [0, 0, 1]), (10, [3, 3, 4]), (1536, [512] * 3)])
def test_remaining_cells_are_shared_among_cores_and_returned_in_order(counts, cells, expected):
    rows = np.random.default_rng(3).uniform(1, 2, (cells, 5))
    results = remaining_cells.finish(Plan(), SETTINGS, rows)
    np.testing.assert_array_equal(results, 2 * rows[:, :2])
    assert sorted(counts) == expected


def test_prepare_compiles_by_a_call_without_a_cell(counts):
    remaining_cells.prepare(Plan(deep=True, work=True, energies=True), SETTINGS)
    assert counts == [0]


def test_only_an_accelerator_leaves_cells_to_the_cores(monkeypatch):
    monkeypatch.setattr(remaining_cells.tiles, "workers", lambda: 3)
    assert remaining_cells.max_remaining_cells() == 0
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert remaining_cells.max_remaining_cells() == 3 * remaining_cells._CELLS_PER_CORE

    def none(platform):
        raise RuntimeError(f"Unknown backend {platform}")

    monkeypatch.setattr(jax, "devices", none)
    assert remaining_cells.max_remaining_cells() == 0
