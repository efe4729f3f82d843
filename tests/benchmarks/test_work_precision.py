"""`benchmarks/work_precision.py` with the quick setting: rows, their errors, and the chart."""

import itertools
import math
import sys
from collections import defaultdict

import numpy as np
import pytest

from benchmarks import tables
from benchmarks import work_precision as tool
from benchmarks.charts import work_precision

EXACT = 1e-14  # the largest measured error is 2e-16
PER_STEP = 5.0  # least factor between the errors at two successive settings; tolerances differ by a factor of 100


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rows")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["work_precision.py", "--quick", "--rows", str(folder)])
        tool.main()
    return tables.read(folder / "work_precision_quick.csv")


def by_method(rows):
    groups = defaultdict(list)
    for row in rows:
        groups[row.method].append(row)
    return groups


@pytest.mark.long
def test_rows_have_a_time_and_an_error(rows):
    assert {"exact", "ode Tsit5", "numba RK4", "numba DP5 + events", "SciPy DOP853"} == set(by_method(rows))
    for row in rows:
        assert row.us > 0
        assert row.lost == 0
        assert 0 <= row.error <= row.worst < 0.1


@pytest.mark.long
def test_exact_is_the_most_accurate(rows):
    (exact,) = by_method(rows)["exact"]
    assert exact.worst < EXACT
    assert all(row.error > 100 * exact.error for row in rows if row is not exact)


@pytest.mark.long
def test_errors_fall_with_the_tolerance_and_with_the_step(rows):
    for method, settings in by_method(rows).items():
        for coarse, fine in itertools.pairwise(settings):
            assert fine.worst < coarse.worst / PER_STEP, (method, fine.setting)


def test_a_cell_without_a_number_is_a_failure():
    failed, reference = np.array([np.nan, 1.0, np.inf]), np.zeros(3)
    error = tool.deviation((failed, reference), (reference, reference))
    assert error.tolist() == [math.inf, 1.0, math.inf]
    assert tool.summary(error) == (math.inf, math.inf, 2)


def test_derivative_in_fifty_digits_agrees_with_finite_differences():
    cells, step = tool.settled(tool.MID), 1e-5
    up, down = (
        np.array(tool.follow(cells._replace(scene=tool.MID._replace(kappa=tool.MID.kappa + nudge))))
        for nudge in (step, -step)
    )
    expected = tool.truth(cells, by_kappa=True)
    assert (tool.deviation((up - down) / (2 * step), expected) < 1e-6 * np.hypot(*expected)).all()


@pytest.mark.long
def test_chart_has_a_panel_per_scene_and_a_legend_of_all_methods(rows, tmp_path):
    chaotic = [row._replace(scene="chaotic", measure="power", noise=1e-3) for row in rows]
    lost = [row._replace(scene="lost", error=math.inf) if row.method == "numba RK4" else row for row in rows]
    figure = work_precision([*rows, *chaotic, *lost], tmp_path / "chart.png")
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title() for axes in panels] == [rows[0].scene, "chaotic", "lost"]
    for axes in panels[:2]:
        assert len(axes.lines) >= len(by_method(rows))
    (legend,) = figure.legends
    assert set(by_method(rows)) <= {text.get_text() for text in legend.get_texts()}
    assert (tmp_path / "chart.png").stat().st_size > 0
    with pytest.raises(ValueError, match="plot must end in"):
        work_precision(rows, tmp_path / "chart.txt")
