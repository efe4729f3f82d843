"""The last cells of an accelerator's tile are shared among the cores beside it, and each gets its own row back."""

import jax
import numpy as np
import pytest

from vijax.batch import stragglers
from vijax.batch.cell import Plan, Settings
from vijax.model.device import Harvester

SETTINGS = Settings(np.ones(()), np.ones(()), Harvester(), None, np.ones(1), np.ones(1))


@pytest.fixture
def shares(monkeypatch):
    """Three cores that double what they are given; the numbers of cells that each was given."""
    given = []

    def double(table, count, settings):
        assert jax.default_device.value.platform == "cpu"
        assert isinstance(settings.periods, np.ndarray)
        assert table.shape[0] == stragglers._EACH
        assert not table[count:].any()
        given.append(int(count))
        return 2 * table[:, :2]

    monkeypatch.setattr(stragglers, "_compiled", lambda plan: double)
    monkeypatch.setattr(stragglers.tiles, "workers", lambda: 3)
    return given


@pytest.mark.parametrize(("cells", "expected"), [(0, [0] * 3), (1, [0, 0, 1]), (10, [3, 3, 4]), (1536, [512] * 3)])
def test_every_core_has_its_share_and_rows_come_back_in_order(shares, cells, expected):
    left = np.random.default_rng(3).uniform(1, 2, (cells, 5))
    found = stragglers.finish(Plan(), SETTINGS, left)
    np.testing.assert_array_equal(found, 2 * left[:, :2])
    assert sorted(shares) == expected


def test_what_is_needed_is_compiled_by_a_share_without_a_cell(shares):
    stragglers.prepare(Plan(deep=True, work=True, energies=True), SETTINGS)
    assert shares == [0]


def test_an_accelerator_leaves_cells_to_every_core_beside_it_and_cores_to_nobody(monkeypatch):
    monkeypatch.setattr(stragglers.tiles, "workers", lambda: 3)
    assert stragglers.most() == 0
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert stragglers.most() == 3 * stragglers._EACH

    def none(platform):
        raise RuntimeError(f"Unknown backend {platform}")

    monkeypatch.setattr(jax, "devices", none)
    assert stragglers.most() == 0
