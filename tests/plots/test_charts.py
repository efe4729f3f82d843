"""Charts: what an orbit diagram shows and says; those of the benchmarks are drawn in their own tests."""

import numpy as np
import pytest
import xarray as xr

from vijax.plots import orbit_diagrams, save

ALONG = {"units": "1", "symbol": "d"}


def drawn(kappa=(400.0, 40.0), ways=("down", "up")) -> xr.Dataset:
    """A diagram of made-up impacts; going up the first kappa has another attractor at the last point."""
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
    found = xr.Dataset(
        {"v_in": ((*dims, "impact"), speed), "E": ((*dims, "impact"), speed**2), "P": (dims, point)},
        coords=coords,
        attrs={"along": "d", "direction": "both" if len(ways) > 1 else ways[0], "wall": "soft"},
    )
    return found if len(ways) > 1 else found.isel(direction=0)


def words(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def points(line) -> set[tuple[float, float]]:
    return {(round(float(x), 9), round(float(y), 9)) for x, y in line.get_xydata()}


def test_each_direction_has_its_panel_and_the_other_one_behind_it(tmp_path):
    ds = drawn()
    figure = orbit_diagrams.orbit_diagram(ds)
    save(figure, tmp_path / "diagram.png")
    assert (tmp_path / "diagram.png").stat().st_size > 0
    down, up = figure.axes
    assert "falling" in down.get_title(loc="left")
    assert "rising" in up.get_title(loc="left")
    assert words(figure) == [r"$\kappa$ = 400", r"$\kappa$ = 40", "the other direction"]
    assert figure.get_suptitle() == "soft walls, $r$ = 0.5, $s$ = 0.2 m"
    for axes, way, other in ((down, "down", "up"), (up, "up", "down")):
        grey, own = axes.get_lines()[:2], axes.get_lines()[2:]
        assert len({line.get_color() for line in own}) == 2
        for lines, shown in ((own, way), (grey, other)):
            for line, values in zip(lines, ds.sel(direction=shown).v_in.values, strict=True):
                expected = np.broadcast_to(ds.d.values[:, None], values.shape)[:, :2], values[:, :2]
                assert points(line) == {
                    (round(x, 9), round(y, 9)) for x, y in zip(*(part.ravel() for part in expected), strict=True)
                }


def test_one_direction_of_one_value_needs_no_legend(tmp_path):
    figure = orbit_diagrams.orbit_diagram(drawn(kappa=(40.0,), ways=("up",)), quantity="P")
    assert len(figure.axes) == 1
    assert not figure.legends
    assert figure.axes[0].get_xlabel() == "$d$"
    assert "J per half period" in figure.axes[0].get_ylabel()


def test_energies_are_drawn_over_decades_and_speeds_are_not():
    assert orbit_diagrams.orbit_diagram(drawn(), quantity="E").axes[0].get_yscale() == "log"
    assert orbit_diagrams.orbit_diagram(drawn(), quantity="v_in").axes[0].get_yscale() == "linear"


@pytest.mark.parametrize(
    ("call", "say"),
    [
        (lambda path: orbit_diagrams.orbit_diagram(drawn(), "speed"), "quantity must be among v_in"),
        (lambda path: orbit_diagrams.orbit_diagram(drawn(kappa=range(1, 20))), "at most 10 values of kappa"),
        (lambda path: save(orbit_diagrams.orbit_diagram(drawn()), path.with_suffix(".txt")), "plot must end in"),
        (
            lambda path: orbit_diagrams.check_layout("d", {"direction": 2, "d": 9, "r": 2, "kappa": 3}),
            "besides d; got r, kappa",
        ),
    ],
)
def test_what_cannot_be_drawn_is_said(tmp_path, call, say):
    with pytest.raises(ValueError, match=say):
        call(tmp_path / "diagram.png")
    assert not list(tmp_path.iterdir())
