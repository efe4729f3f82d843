"""Pictures of designs from artificial diagrams and reports: the optimum, its tolerance band, unphysical ranges."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgba

from vijax.design.robustness.tolerance import Tolerance
from vijax.design.robustness.tolerance_plane import NearestPoint, TolerancePlane
from vijax.plots import designs, save

GREEN = to_rgba(designs._STAR["color"])


def diagram(along="omega0", bounds=(20.0, 60.0)) -> xr.Dataset:
    """Return a diagram: P is 1 uJ, at the fourth point 9 uJ and inadmissible, and upward 0 at the last point."""
    x = np.linspace(*bounds, 9)
    power = np.full((2, 9), 1e-6)
    power[:, 3], power[1, 8] = 9e-6, 0.0
    good = np.ones((2, 9), bool)
    good[:, 3], good[0, 8] = False, False
    dims = ("direction", along)
    coords = {along: (along, x, {"units": "1", "symbol": along}), "direction": ["down", "up"], "r": 0.5}
    return xr.Dataset({"P": (dims, power), "admissible": (dims, good)}, coords, {"along": along})


def report(**changed):
    best = {
        "values": {"omega0": 50.0},
        "pair": {"d": 0.2, "kappa": 5.0, "r": 0.5, "gamma": 0.0},
        "device": {"omega0": 50.0, "m_b": 0.0035},
        "omega0": 50.0,
        "P": 1e-6,
        "label": "1:1",
        "active": [],
        "stopped": "maximum",
        "path": [[58.0], [52.0], [50.0]],
        "path_objective": [0.5e-6, 0.9e-6, 1e-6],
    }
    edges = {"below": {"kind": "fold", "omega0": 45.0}, "above": {"kind": "none", "omega0": 75.0}}
    highest = {"along": "omega0", "value": 35.0, "P": 9e-6, "admissible": False, "max_penetration": 0.02}
    contents = {"best": best, "tune": ["omega0"], "objective": "P", "surroundings": edges, "highest": highest}
    contents["parameter_ranges"] = []
    return contents | {"tolerances": [{"name": "omega0", "spread": 0.05, "kind": "uniform"}], "spread": None} | changed


def words(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def line(axes, label):
    (match,) = [artist for artist in axes.get_lines() if str(artist.get_label()).startswith(label)]
    return match


def span(axes, label):
    (match,) = [artist for artist in axes.patches if artist.get_label() == label]
    return pytest.approx((match.get_x(), match.get_x() + match.get_width()))


def test_optimum_band_edge_and_ascent_agree_with_the_report(tmp_path):
    figure = designs.design(diagram(), report())
    save(figure, tmp_path / "design.png")
    assert (tmp_path / "design.png").stat().st_size > 0
    for axes in figure.axes:
        np.testing.assert_allclose(line(axes, "optimum").get_xydata(), [[50, 1e-6]])
        np.testing.assert_allclose(line(axes, "ascent").get_xdata(), [58, 52, 50])
        assert set(line(axes, "fold").get_xdata()) == {45.0}
        assert span(axes, "tolerance") == (47.5, 52.5)
    assert figure.axes[1].get_xlim() == pytest.approx(designs.close_view("omega0", 50.0))


def test_range_of_the_motion_and_chaotic_averages_are_drawn():
    side = {"percent": 4.0, "persists": False, "label": "aperiodic", "P": 1e-6, "admissible": True}
    parameter_ranges = [{"name": "omega0", "below": side, "above": side | {"percent": 10.0, "persists": True}}]
    chaos = diagram()
    chaos["P_stderr"] = 0.01 * chaos["P"]
    # The motion is chaotic at the sixth point and, downward only, at the inadmissible last point.
    chaos["period"] = chaos["P"].astype(int) * 0 + 1
    chaos["period"][:, 5], chaos["period"][0, 8] = 0, 0
    upper, _ = designs.design(chaos, report(parameter_ranges=parameter_ranges)).axes
    assert span(upper, "range of this motion") == (48.0, 55.0)
    np.testing.assert_allclose(line(upper, "average of chaos").get_xdata(), [45.0, 45.0])
    assert "range of this motion" not in words(designs.design(diagram(), report()))


def test_unconstrained_maximum_is_marked_and_its_range_hatched():
    figure = designs.design(diagram(), report())
    naive = line(figure.axes[0], "unconstrained maximum of $P$")
    np.testing.assert_allclose(naive.get_xydata(), [[35, 9e-6]])
    assert "9 $\\mu$J, 20 mm deep" in naive.get_label()
    assert span(figure.axes[0], "inadmissible") == (32.5, 37.5)
    # The last point is hatched, too: its admissible motion yields no power.
    hatched = [patch for patch in figure.axes[0].patches if patch.get_hatch()]
    assert [patch.get_x() for patch in hatched] == pytest.approx([32.5, 57.5])


def test_no_unphysical_point_is_drawn_if_the_optimum_is_the_highest():
    highest = report()["highest"] | {"P": 0.5e-6}
    assert not [word for word in words(designs.design(diagram(), report(highest=highest))) if "alone" in word]


def test_edge_and_band_in_k_are_those_of_the_squared_frequency():
    best = report()["best"] | {"values": {"k": 8.75}, "path": [[9.0], [8.75]], "path_objective": [0.9e-6, 1e-6]}
    axes = designs.design(diagram("k", (5.0, 12.0)), report(best=best, tune=["k"])).axes[0]
    assert span(axes, "tolerance") == (8.75 * 0.95**2, 8.75 * 1.05**2)
    np.testing.assert_allclose(line(axes, "fold").get_xdata(), 8.75 * 0.9**2)


def test_without_an_optimum_the_curves_remain():
    figure = designs.design(diagram(), report(best=None))
    assert len(figure.axes) == 1
    assert "optimum" not in " ".join(words(figure))


def test_design_map_is_coloured_by_active_limits(tmp_path):
    worst = {"spread": {"worst": 0.2e-6}}
    reports = [report(**worst), report(best=None), report(**worst), report(**worst)]
    reports[0]["best"]["active"] = ["penetration limit at the right wall"]
    reports[3]["best"]["stopped"] = "stalled"
    map_report = {"over": {"name": "d", "values": [0.1, 0.2, 0.3, 0.4]}, "designs": reports}
    figure = designs.design_map(map_report)
    save(figure, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 0
    upper, lower = figure.axes
    assert words(figure) == [
        "penetration limit",
        "a kink, or all evaluations spent",
        "no active limit",
        "worst within the tolerances",
    ]
    assert [artist.get_xydata().tolist() for artist in upper.get_lines() if artist.get_xdata().size] == [
        [[0.1, 50]],
        [[0.4, 50]],
        [[0.3, 50]],
    ]
    interior = line(lower, "no active limit")
    assert interior.get_xydata().tolist() == [[0.3, 1e-6]]
    assert to_rgba(interior.get_color()) == GREEN


def test_unsupported_file_type_raises(tmp_path):
    with pytest.raises(ValueError, match="plot must end in"):
        save(designs.design(diagram(), report()), tmp_path / "picture.txt")
    assert not list(tmp_path.iterdir())


def test_the_plane_of_two_tolerances_shows_the_optimum_in_its_box(tmp_path):
    both = (Tolerance("omega0", 0.05), Tolerance("s", 0.02))
    within = {"omega0": (40.0, 60.0), "s": (0.004, 0.008)}
    near = NearestPoint("fold", (46.0, 0.0061), (-8.0, 1.7), 1.6)
    figure = designs.design(diagram(), report(), TolerancePlane(both, (50.0, 0.006), within, [], near, None))
    axes = figure.axes[2]
    assert (axes.get_xlim(), axes.get_ylim()) == (within["omega0"], within["s"])
    (box,) = axes.patches
    assert box.get_bbox().bounds == pytest.approx((47.5, 0.00588, 5.0, 0.00024))
    places = [tuple(float(x) for coordinates in line.get_data() for x in np.ravel(coordinates)) for line in axes.lines]
    assert places == [near.values, (50.0, 0.006)]
    assert "nearest bifurcation, limit" in words(figure)
    save(figure, tmp_path / "design.png")
