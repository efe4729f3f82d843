"""`benchmarks/compiler_options.py` counts different labels and compares differences of P with its bounds."""

import numpy as np
import pytest

from benchmarks import compiler_options

REFERENCE = {
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
    return compiler_options.compared("level", "kernels off", REFERENCE, REFERENCE | changes)


def test_equal_planes_are_within_the_bounds():
    result = row()
    assert (result.impacts, result.cells, result.labels, result.periodic, result.aperiodic) == (1700, 5, 0, 0.0, 0.0)
    assert result.within_bounds


@pytest.mark.parametrize(
    ("changes", "field", "value"),
    [
        ({"impacts_left": np.array([1, 2, 0, 1, 0])}, "labels", 2),
        ({"P": np.array([2.0, 4.0 + 8e-9, 3.0, 5.0, np.nan])}, "periodic", 2e-9),
        ({"P": np.array([2.0, 4.0, 3.4, 5.0, np.nan])}, "aperiodic", 2.0),
    ],
)
def test_difference_above_its_bound_is_counted(changes, field, value):
    result = row(**changes)
    assert getattr(result, field) == pytest.approx(value, rel=1e-6)
    assert not result.within_bounds


def test_cell_with_another_label_is_excluded_from_the_difference_of_p():
    result = row(period=np.array([1, 4, 0, 0, -1]), P=np.array([2.0, 8.0, 3.0, 5.0, np.nan]))
    assert (result.labels, result.periodic) == (1, 0.0)
    assert result.within_bounds


def test_variants_run_in_separate_environments(monkeypatch):
    environments = []

    def run(command, env, check):
        environments.append({name: env.get(name) for name in ("XLA_FLAGS", "VIJAX_KERNELS")})
        np.savez(command[-1], **REFERENCE)

    monkeypatch.setenv("XLA_FLAGS", "--of_the_tests=1")
    monkeypatch.setattr(compiler_options.subprocess, "run", run)
    rows = list(compiler_options.rows(["level"], 4))
    assert [row.variant for row in rows] == list(compiler_options.VARIANTS)
    assert environments == [
        {"XLA_FLAGS": None, "VIJAX_KERNELS": None},
        {"XLA_FLAGS": "--xla_backend_optimization_level=0", "VIJAX_KERNELS": None},
        {"XLA_FLAGS": None, "VIJAX_KERNELS": "0"},
    ]
