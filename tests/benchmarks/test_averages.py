"""`benchmarks/averages.py`: stored rows, printed statistics and chart."""

import numpy as np
import pytest

from benchmarks import averages, charts, tables

ROWS = [
    averages.Row("cells", "0", "ensemble", "kappa", 4096, -2.01, 0.02, -2.0, 0.01, "smooth"),
    averages.Row("cells", "1", "ensemble", "kappa", 4096, -2.10, 0.02, -2.0, 0.01, "window"),
    averages.Row("growth", "orbit", "automatic differentiation", "kappa", 1, -2.5, 0.0, -2.0, 0.0, ""),
    averages.Row("growth", "orbit", "automatic differentiation", "kappa", 2, -2.25, 0.0, -2.0, 0.0, ""),
    averages.Row("growth", "orbit", "ensemble", "kappa", 16, -2.1, 0.1, -2.0, 0.0, "smooth"),
    averages.Row("edge", "chaos to orbits", "ensemble", "kappa", 27.0, -2.6, 0.1, -2.5, 0.0, "smooth"),
    averages.Row("crisis", "chaos grows", "ensemble", "depth", 35.2, 7.6e-3, 0.0, 7.6e-3, 0.0, "smooth"),
    averages.Row("crisis", "chaos grows", "ensemble", "depth", 35.3, 8.36e-3, 0.0, 8.36e-3, 0.0, "smooth"),
    averages.Row("crisis", "chaos grows", "ensemble", "P", 35.2, 3e-5, 1e-9, 3e-5, 0.0, "smooth"),
    averages.Row("missed", "99.5 % of the starts", "ensemble", "P", 32, 1.01, 1e-6, 1.0, 0.0, "smooth"),
]


def test_repeated_part_does_not_change_the_rows_of_other_parts(tmp_path, monkeypatch):
    file = tmp_path / "averages.csv"
    tables.write(file, averages.Row._fields, ROWS)
    file.write_text(file.read_text().replace("JAX ", "JAX of another year "))
    fresh = ROWS[-1]._replace(value=1.02)
    monkeypatch.setitem(averages.PARTS, "missed", lambda count: iter([fresh]))
    monkeypatch.setattr("sys.argv", ["averages.py", "--only", "missed", "--rows", str(tmp_path)])
    averages.main()
    rows = tables.read(file)
    assert [averages.Row(*row[:-1]) for row in rows] == [*ROWS[:-1], fresh]
    assert ["another year" in row.made_by for row in rows] == [True] * (len(ROWS) - 1) + [False]


def test_printed_statistics_count_both_errors_and_the_kinds_of_cells(capsys):
    averages.printed(ROWS)
    printed = dict(line.rsplit("  ", 1) for line in capsys.readouterr().out.splitlines())
    printed = {name.strip(): value.strip() for name, value in printed.items()}
    assert printed["dP/dkappa, 1 chaotic cells, smooth: within 2 standard errors"] == "100.0%"
    assert printed["dP/dkappa, 2 chaotic cells, all: within 2 standard errors"] == "50.0%"
    assert printed["dP/dkappa, 2 chaotic cells, all: relative error above 1 % in"] == "50.0%"


def test_parts_have_panels(tmp_path):
    figure = charts.averages(ROWS, tmp_path / "chart.png")
    growth, cells, edge, crisis, missed = figure.axes
    np.testing.assert_allclose(growth.lines[0].get_xydata(), [[1, 0.5], [2, 0.25]])
    np.testing.assert_allclose(cells.lines[0].get_xydata(), [[np.hypot(0.02, 0.01) / 2, 0.005]])
    np.testing.assert_allclose(edge.lines[0].get_xydata(), [[27.0, -2.5]])
    np.testing.assert_allclose(crisis.lines[0].get_xydata(), [[35.2, 1.0], [35.3, 1.1]])
    np.testing.assert_allclose(missed.lines[0].get_xydata(), [[32, 0.01]])
    with pytest.raises(ValueError, match="txt"):
        charts.averages(ROWS, tmp_path / "chart.txt")
