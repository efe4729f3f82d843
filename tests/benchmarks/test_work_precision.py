"""The work-precision tool: its quick setting gives rows, its errors behave, its chart draws them."""

import itertools
import math
import sys
from collections import defaultdict

import numpy as np
import pytest

from benchmarks import tables
from benchmarks import work_precision as tool
from benchmarks.charts import work_precision

EXACT = 1e-14  # worst measured: 2e-16
PER_STEP = 5.0  # least gain of a hundredth of the tolerance


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rows")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["work_precision.py", "--quick", "--rows", str(folder)])
        tool.main()
    return tables.read(folder / "work_precision_quick.csv")


def by_method(rows):
    found = defaultdict(list)
    for row in rows:
        found[row.method].append(row)
    return found


@pytest.mark.long
def test_every_row_has_a_time_and_an_error(rows):
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
    nothing, something = np.array([np.nan, 1.0, np.inf]), np.zeros(3)
    error = tool.deviation((nothing, something), (something, something))
    assert error.tolist() == [math.inf, 1.0, math.inf]
    assert tool.summary(error) == (math.inf, math.inf, 2)


def test_derivative_in_fifty_digits_is_that_of_nearby_runs():
    cells, step = tool.settled(tool.MID), 1e-5
    up, down = (
        np.array(tool.follow(cells._replace(scene=tool.MID._replace(kappa=tool.MID.kappa + nudge))))
        for nudge in (step, -step)
    )
    true = tool.truth(cells, by_kappa=True)
    assert (tool.deviation((up - down) / (2 * step), true) < 1e-6 * np.hypot(*true)).all()


@pytest.mark.long
def test_the_chart_has_a_panel_a_scene_and_names_every_line(rows, tmp_path):
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
