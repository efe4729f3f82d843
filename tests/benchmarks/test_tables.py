"""Rows on disk with what made them, errors of many cells in a few numbers, and the pieces of pages made of them."""

import math

import numpy as np
import pytest

from benchmarks import charts, tables, tails
from docs import measured


def test_rows_are_read_as_they_were_written_with_what_made_them(tmp_path):
    file = tmp_path / "rows.csv"
    tables.write(file, ["name", "setting", "us"], [("a", "1e-4", 0.1), ("b", "fine", math.nan)])
    first, second = tables.read(file)
    assert (first.name, first.setting, first.us, second.setting) == ("a", "1e-4", 0.1, "fine")
    assert math.isnan(second.us)
    assert all(said in first.made_by for said in ("vijax ", " at ", "JAX ", " cores"))
    assert tables.read(tmp_path / "none.csv") == []


def test_rows_stay_when_a_run_is_ended(tmp_path):
    def ended():
        yield ("a",)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tables.write(tmp_path / "rows.csv", ["name"], ended())
    assert [row.name for row in tables.read(tmp_path / "rows.csv")] == ["a"]


def test_every_file_of_rows_says_what_made_it():
    files = sorted(tables.ROWS.glob("*.csv"))
    assert len(files) > 7
    for file in files:
        assert "JAX" in measured.texts()[f"made_by_{file.stem}"]


def test_what_most_cells_keep_is_not_what_the_last_ones_do():
    error = np.concatenate([np.full(985, 1e-9), np.full(10, 0.2), np.full(5, np.inf)])
    row = tails.row("a", "1", 1.0, error)
    assert (row.cells, row.lost, row.other) == (1000, 5, 15)
    assert (row.median, row.most, row.worst) == (1e-9, 0.2, math.inf)


def one(method, setting, us, most, other=0):
    return tails.Row(method, setting, us, 100, 0, other, most / 10, most, 10 * most)


ROWS = [
    one("one rounding", "", math.nan, 1e-15),
    one("exact", "float64", 0.1, 1e-14),
    one("ode Tsit5", "1e-4", 3.0, 1e-4),
    one("ode Tsit5", "1e-8", 9.0, 1e-8),
    one("rk4", "250", 5.0, 0.3, other=12),
]


def test_the_cheapest_setting_that_keeps_an_error_is_named():
    lines = [line.strip("| ").split(" | ") for line in measured.reach(ROWS).splitlines()]
    assert lines[0] == ["method", "1e-3", "1e-6", "1e-9"]
    assert lines[2:] == [
        ["exact", *["0.1 us (float64)"] * 3],
        ["ode Tsit5", "3 us (1e-4)", "9 us (1e-8)", "not reached"],
        ["rk4", *["not reached"] * 3],
    ]
    assert "| rk4 | 250 steps | 12 % | 0 |" in measured.other_motions(ROWS)


def test_methods_that_fail_are_drawn_with_the_share_of_cells_that_fail(tmp_path):
    figure = charts.tails(ROWS, tmp_path / "tails.png")
    shown = {axes.get_title(): [text.get_text() for text in axes.texts] for axes in figure.axes if axes.get_visible()}
    assert shown == {"exact": [], "ode Tsit5": [], "rk4": ["12 %"]}
    rows = [tails.LabelRow("exact", "float64", 40.0, 100, 0, 0), tails.LabelRow("rk4", "250", 9.0, 100, 3, 20)]
    (axes,) = charts.labels(rows, tmp_path / "labels.png").axes
    assert [line.get_ydata()[0] for line in axes.lines[:4]] == [0, 0, 3, 23]
