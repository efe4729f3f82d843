"""Rows on disk with their provenance, statistics of the errors of cells, and page fragments from rows."""

import math

import numpy as np
import pytest

from benchmarks import charts, tables, tails
from docs import measured


def test_rows_are_read_as_written_with_their_provenance(tmp_path):
    file = tmp_path / "rows.csv"
    tables.write(file, ["name", "setting", "us"], [("a", "1e-4", 0.1), ("b", "fine", math.nan)])
    first, second = tables.read(file)
    assert (first.name, first.setting, first.us, second.setting) == ("a", "1e-4", 0.1, "fine")
    assert math.isnan(second.us)
    assert all(part in first.made_by for part in ("vijax ", " at ", "JAX ", " cores"))
    assert tables.read(tmp_path / "none.csv") == []


def test_rows_remain_after_an_interrupt(tmp_path):
    def ended():
        yield ("a",)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tables.write(tmp_path / "rows.csv", ["name"], ended())
    assert [row.name for row in tables.read(tmp_path / "rows.csv")] == ["a"]


def test_files_of_rows_record_their_provenance():
    files = sorted(tables.ROWS.glob("*.csv"))
    assert len(files) > 7
    for file in files:
        assert "JAX" in measured.texts()[f"made_by_{file.stem}"]


def test_statistics_separate_typical_cells_from_outliers():
    error = np.concatenate([np.full(985, 1e-9), np.full(10, 0.2), np.full(5, np.inf)])
    row = tails.row("a", "1", 1.0, error)
    assert (row.cells, row.lost, row.other) == (1000, 5, 15)
    assert (row.median, row.quantile, row.worst) == (1e-9, 0.2, math.inf)


def make_row(method, setting, us, quantile, other=0):
    return tails.Row(method, setting, us, 100, 0, other, quantile / 10, quantile, 10 * quantile)


ROWS = [
    make_row("one rounding", "", math.nan, 1e-15),
    make_row("exact", "float64", 0.1, 1e-14),
    make_row("ode Tsit5", "1e-4", 3.0, 1e-4),
    make_row("ode Tsit5", "1e-8", 9.0, 1e-8),
    make_row("rk4", "250", 5.0, 0.3, other=12),
]


def test_table_names_the_cheapest_setting_within_an_error():
    lines = [line.strip("| ").split(" | ") for line in measured.reach(ROWS).splitlines()]
    assert lines[0] == ["method", "1e-3", "1e-6", "1e-9"]
    assert lines[2:] == [
        ["exact", *["0.1 us (float64)"] * 3],
        ["ode Tsit5", "3 us (1e-4)", "9 us (1e-8)", "not reached"],
        ["rk4", *["not reached"] * 3],
    ]
    assert "| rk4 | 250 steps | 12 % | 0 |" in measured.other_motions(ROWS)


def test_chart_shows_the_share_of_failed_cells(tmp_path):
    figure = charts.tails(ROWS, tmp_path / "tails.png")
    panel_texts = {
        axes.get_title(): [text.get_text() for text in axes.texts] for axes in figure.axes if axes.get_visible()
    }
    assert panel_texts == {"exact": [], "ode Tsit5": [], "rk4": ["12 %"]}
    rows = [tails.LabelRow("exact", "float64", 40.0, 100, 0, 0), tails.LabelRow("rk4", "250", 9.0, 100, 3, 20)]
    (axes,) = charts.labels(rows, tmp_path / "labels.png").axes
    assert [line.get_ydata()[0] for line in axes.lines[:4]] == [0, 0, 3, 23]
