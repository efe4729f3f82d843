"""Pictures of artificial results equal the stored pictures, except for small differences of font builds.

After an intended change, `python tests/plots/test_pictures.py` draws the stored pictures again; inspect them.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread, imsave

from vijax import plots
from vijax.model.records import Status
from vijax.plots.style import STYLE

STORED = Path(__file__).parents[1] / "data" / "pictures"
DOTS = 40  # dots per inch
MIN_DIFFERENCE = 32  # levels of 255 by which a pixel must differ to count
# Largest share of different pixels. Another colour of a line of dots changes a share of 0.006; limits, a title or a
# mark change 0.07 and more.
MAX_SHARE = 0.002
D, KAPPA = np.linspace(0.05, 0.3, 12), np.geomspace(3, 400, 16)


def coordinate(name: str, symbol: str, values) -> tuple:
    return name, np.asarray(values), {"symbol": symbol, "units": "1"}


def plane() -> xr.Dataset:
    """Return a map: power with a ridge, inadmissible at large d; 1:1, stripes of 2:1/2T, chaos, undecided cells."""
    d, kappa = np.meshgrid(np.linspace(0, 1, D.size), np.linspace(0, 1, KAPPA.size), indexing="ij")
    period = np.select([d + kappa < 0.3, kappa > 0.8, d > 0.7], [-1, 0, 2], 1)
    dims = ("d", "kappa")
    return xr.Dataset(
        {
            "P": (dims, 1e-6 * np.exp(-20 * (d - kappa) ** 2)),
            "admissible": (dims, d < 0.85),
            "period": (dims, period),
            "impacts_left": (dims, np.where(period > 0, period, -1)),
            "impacts_right": (dims, np.where(period > 0, 1, -1)),
            "lyapunov": (dims, np.where(period == 0, kappa, -0.5)),
            "status": (dims, np.where(period < 0, int(Status.SLOW), 0)),
        },
        {
            "d": coordinate("d", "d", D),
            "kappa": coordinate("kappa", r"\kappa", KAPPA),
            "gamma": ((), 0.0, {"symbol": r"\gamma", "units": "1"}),
        },
        {"wall": "soft", "periods": 400},
    )


def starts() -> xr.Dataset:
    """Return two attractors with interleaved basins."""
    u, v = np.linspace(-0.1, 0.1, 20), np.linspace(-0.6, 0.6, 24)
    basin = (np.sin(40 * u[:, None] + 9 * v) > 0).astype(int)
    table = {"label": ["1:2/2T", "1:1"], "P": [4e-3, 1e-6], "starts": [240, 240], "fraction": [0.5, 0.5]}
    table["periods_run"] = [50.0, 40.0]
    place = {"u0": coordinate("u0", "u_0", u), "v0": coordinate("v0", "v_0", v)}
    place["gamma"] = ((), 0.0, {"symbol": r"\gamma", "units": "1"})
    variables = {name: ("attractor", np.array(column)) for name, column in table.items()}
    return xr.Dataset(variables | {"basin": (("u0", "v0"), basin), "attractors": 2}, place, {"wall": "soft"})


def cascade() -> xr.Dataset:
    """Return an orbit diagram with the logistic map in place of impact speeds, downward and upward."""
    a = np.linspace(0.1, 0.3, 60)
    x = np.full(a.size, 0.3)
    speeds = [x := (3 + (a - 0.1) * 5) * x * (1 - x) for _ in range(220)][-20:]
    v_in = np.stack(speeds, axis=-1) * np.array([1.0, -1.0])[:, None, None]
    dims = ("direction", "d")
    return xr.Dataset(
        {
            "v_in": ((*dims, "impact"), v_in),
            "E": ((*dims, "impact"), v_in**2),
            "P": (dims, (v_in**2).mean(axis=2)),
        },
        {
            "direction": ["down", "up"],
            "d": coordinate("d", "d", a),
            "r": ((), 0.5, {"units": "1", "symbol": "r"}),
            "s": ((), 0.2, {"units": "m", "symbol": "s"}),
        },
        {"along": "d", "direction": "both", "wall": "soft"},
    )


PICTURES = {
    "power_map": lambda: plots.power_map(plane()),
    "label_map": lambda: plots.label_map(plane()),
    "basins": lambda: plots.basins(starts()),
    "orbit_diagram": lambda: plots.orbit_diagram(cascade()),
}


def pixels(figure: Figure) -> np.ndarray:
    with mpl.rc_context(STYLE):
        figure.set_dpi(DOTS)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


@pytest.mark.parametrize("name", PICTURES)
def test_picture_equals_the_stored_picture(name, tmp_path):
    drawn = pixels(PICTURES[name]())
    stored = np.round(255 * imread(STORED / f"{name}.png")[..., :3])
    assert drawn.shape == stored.shape
    differs = (np.abs(drawn - stored) > MIN_DIFFERENCE).any(axis=-1)
    imsave(tmp_path / "drawn.png", drawn)
    assert differs.mean() < MAX_SHARE, f"look at {tmp_path}/drawn.png"


if __name__ == "__main__":
    for name, draw in PICTURES.items():
        imsave(STORED / f"{name}.png", np.ascontiguousarray(pixels(draw())))
