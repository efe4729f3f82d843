"""Charts: contents and labels of orbit diagrams; the tests of the benchmarks draw the other charts."""

import numpy as np
import pytest
import xarray as xr

from vijax.plots import orbit_diagrams, save

ALONG = {"units": "1", "symbol": "d"}


def diagram(kappa=(400.0, 40.0), ways=("down", "up")) -> xr.Dataset:
    """Return a diagram of artificial impacts; upward, the first kappa has another attractor at the last point."""
    d = np.array([0.3, 0.2, 0.1])
    speed = d[:, None] * np.array([1.0, -2.0, np.nan]) * np.ones((len(ways), len(kappa), 1, 1))
    speed[-1, 0, 2] *= 3
    point = speed[..., 0]
    dims = ("direction", "kappa", "d")
    coords = {
        "direction": ("direction", list(ways)),
        "kappa": ("kappa", list(kappa), {"units": "1", "symbol": r"\kappa"}),
        "d": ("d", d, ALONG),
        "r": ((), 0.5, {"units": "1", "symbol": "r"}),
        "s": ((), 0.2, {"units": "m", "symbol": "s"}),
    }
    dataset = xr.Dataset(
        {"v_in": ((*dims, "impact"), speed), "E": ((*dims, "impact"), speed**2), "P": (dims, point)},
        coords=coords,
        attrs={"along": "d", "direction": "both" if len(ways) > 1 else ways[0], "wall": "soft"},
    )
    return dataset if len(ways) > 1 else dataset.isel(direction=0)


def words(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def points(line) -> set[tuple[float, float]]:
    return {(round(float(x), 9), round(float(y), 9)) for x, y in line.get_xydata()}


def test_panel_per_direction_with_the_other_direction_behind(tmp_path):
    ds = diagram()
    figure = orbit_diagrams.orbit_diagram(ds)
    save(figure, tmp_path / "diagram.png")
    assert (tmp_path / "diagram.png").stat().st_size > 0
    down, up = figure.axes
    assert "falling" in down.get_title(loc="left")
    assert "rising" in up.get_title(loc="left")
    assert words(figure) == [r"$\kappa$ = 400", r"$\kappa$ = 40", "the other direction"]
    assert figure.get_suptitle() == "soft walls, $r$ = 0.5, $s$ = 0.2 m"
    for axes, way, other in ((down, "down", "up"), (up, "up", "down")):
        grey, coloured = axes.get_lines()[:2], axes.get_lines()[2:]
        assert len({line.get_color() for line in coloured}) == 2
        for lines, direction in ((coloured, way), (grey, other)):
            for line, values in zip(lines, ds.sel(direction=direction).v_in.values, strict=True):
                expected = np.broadcast_to(ds.d.values[:, None], values.shape)[:, :2], values[:, :2]
                assert points(line) == {
                    (round(x, 9), round(y, 9)) for x, y in zip(*(part.ravel() for part in expected), strict=True)
                }


def test_single_direction_and_value_needs_no_legend(tmp_path):
    figure = orbit_diagrams.orbit_diagram(diagram(kappa=(40.0,), ways=("up",)), quantity="P")
    assert len(figure.axes) == 1
    assert not figure.legends
    assert figure.axes[0].get_xlabel() == "$d$"
    assert "J per half period" in figure.axes[0].get_ylabel()


def test_energies_are_drawn_over_decades_and_speeds_are_not():
    assert orbit_diagrams.orbit_diagram(diagram(), quantity="E").axes[0].get_yscale() == "log"
    assert orbit_diagrams.orbit_diagram(diagram(), quantity="v_in").axes[0].get_yscale() == "linear"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: orbit_diagrams.orbit_diagram(diagram(), "speed"), "quantity must be among v_in"),
        (lambda path: orbit_diagrams.orbit_diagram(diagram(kappa=range(1, 20))), "at most 10 values of kappa"),
        (lambda path: save(orbit_diagrams.orbit_diagram(diagram()), path.with_suffix(".txt")), "plot must end in"),
        (
            lambda path: orbit_diagrams.check_layout("d", {"direction": 2, "d": 9, "r": 2, "kappa": 3}),
            "besides d; got r, kappa",
        ),
    ],
)
def test_invalid_charts_raise(tmp_path, call, message):
    with pytest.raises(ValueError, match=message):
        call(tmp_path / "diagram.png")
    assert not list(tmp_path.iterdir())
