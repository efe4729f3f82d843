"""`benchmarks/compiler_options.py` counts labels that differ and measures differences of P against its bounds."""

import numpy as np
import pytest

from benchmarks import compiler_options

KNOWN = {
    "period": np.array([1, 2, 0, 0, -1]),
    "impacts_left": np.array([1, 3, 0, 0, 0]),
    "impacts_right": np.array([1, 2, 0, 0, 0]),
    "status": np.array([0, 0, 0, 0, 5]),
    "P": np.array([2.0, 4.0, 3.0, 5.0, np.nan]),
    "P_stderr": np.array([0.0, 0.0, 0.1, 0.1, np.nan]),
    "periods_run": np.array([100, 200, 400, 400, 400]),
    "impacts_per_period": np.array([2.0, 2.5, 1.5, 1.0, np.nan]),
}


def row(**changes):
    return compiler_options.compared("level", "kernels off", KNOWN, KNOWN | changes)


def test_equal_planes_are_within_the_bounds():
    found = row()
    assert (found.impacts, found.cells, found.labels, found.periodic, found.aperiodic) == (1700, 5, 0, 0.0, 0.0)
    assert found.within_bounds


@pytest.mark.parametrize(
    ("changes", "field", "value"),
    [
        ({"impacts_left": np.array([1, 2, 0, 1, 0])}, "labels", 2),
        ({"P": np.array([2.0, 4.0 + 8e-9, 3.0, 5.0, np.nan])}, "periodic", 2e-9),
        ({"P": np.array([2.0, 4.0, 3.4, 5.0, np.nan])}, "aperiodic", 2.0),
    ],
)
def test_a_difference_beyond_its_bound_is_counted(changes, field, value):
    found = row(**changes)
    assert getattr(found, field) == pytest.approx(value, rel=1e-6)
    assert not found.within_bounds


def test_a_cell_whose_label_differs_counts_in_no_difference_of_p():
    found = row(period=np.array([1, 4, 0, 0, -1]), P=np.array([2.0, 8.0, 3.0, 5.0, np.nan]))
    assert (found.labels, found.periodic) == (1, 0.0)
    assert found.within_bounds


def test_each_variant_has_an_environment_of_its_own(monkeypatch):
    started = []

    def run(command, env, check):
        started.append({name: env.get(name) for name in ("XLA_FLAGS", "VIJAX_KERNELS")})
        np.savez(command[-1], **KNOWN)

    monkeypatch.setenv("XLA_FLAGS", "--of_the_tests=1")
    monkeypatch.setattr(compiler_options.subprocess, "run", run)
    rows = list(compiler_options.rows(["level"], 4))
    assert [row.variant for row in rows] == list(compiler_options.VARIANTS)
    assert started == [
        {"XLA_FLAGS": None, "VIJAX_KERNELS": None},
        {"XLA_FLAGS": "--xla_backend_optimization_level=0", "VIJAX_KERNELS": None},
        {"XLA_FLAGS": None, "VIJAX_KERNELS": "0"},
    ]
