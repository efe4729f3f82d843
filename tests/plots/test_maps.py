"""Pictures of maps: layout, scales, marks, and the labels of cells without a reliable result."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import LogNorm, to_rgba
from matplotlib.legend import Legend

from vijax.maps.compare import CheapestModel, LabelAgreement
from vijax.maps.map_dataset import best
from vijax.model.records import Status
from vijax.plots import cells, kind_maps, number_maps, save
from vijax.plots.style import layout

SYMBOLS = {
    "d": ("d", "1"),
    "kappa": (r"\kappa", "1"),
    "A": ("A", "m s-2"),
    "r": ("r", "1"),
    "omega0": (r"\omega_0", "rad s-1"),
}


def drawn_map(**axes) -> xr.Dataset:
    """Return a map over the axes with inadmissible, aperiodic, undecided and no-impact cells."""
    coords = {}
    for name, values in axes.items():
        symbol, units = SYMBOLS[name]
        coords[name] = (name, np.asarray(values), {"symbol": symbol, "units": units})
    shape = [len(values) for values in axes.values()]
    cell = np.arange(np.prod(shape)).reshape(shape)
    periodic = cell[tuple(slice(None) if name in ("d", "kappa", "omega0") else 0 for name in axes)]
    dims = [name for name in axes if name in ("d", "kappa", "omega0")]
    return xr.Dataset(
        {
            "P": (list(axes), np.where(cell == 0, 0.0, 1e-6 * (1 + cell))),
            "admissible": (list(axes), cell < 0.75 * cell.size),
            "period": (dims, np.array([1, 1, 2, 0, 0, -1])[periodic % 6]),
        },
        coords=coords | {"gamma": ((), 0.1, {"symbol": r"\gamma", "units": "1"})},
        attrs={"wall": "soft"},
    )


D, KAPPA = np.linspace(0.05, 0.3, 6), np.geomspace(3, 400, 8)


def words(figure) -> str:
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    titles = [axes.get_title() for axes in figure.axes]
    labels = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())]
    return "\n".join([*legends, *titles, *labels, figure.get_suptitle()])


@pytest.mark.parametrize(
    ("sizes", "panels"),
    [
        ({"d": 5}, (1, 1)),
        ({"d": 5, "kappa": 4}, (1, 1)),
        ({"d": 5, "r": 1, "kappa": 4}, (1, 1)),
        ({"d": 5, "kappa": 4, "r": 2}, (1, 2)),
        ({"d": 5, "kappa": 4, "r": 7}, (3, 3)),
        ({"d": 5, "kappa": 4, "r": 2, "A": 5}, (5, 2)),
    ],
)
def test_layout(sizes, panels):
    assert layout(sizes) == panels


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({}, "single cell"),
        ({"d": 1, "r": 1}, "single cell"),
        ({"r": 3, "d": 3, "kappa": 64}, "at most 36 panels; got 64 values of kappa"),
        ({"d": 2, "kappa": 2, "r": 2, "A": 2, "omega": 2}, "at most 4 axes"),
    ],
)
def test_invalid_layouts_raise(sizes, message):
    with pytest.raises(ValueError, match=message):
        layout(sizes)


def test_power_map_has_legend_axes_and_title(tmp_path):
    file = tmp_path / "map.png"
    figure = number_maps.power_map(drawn_map(d=D, kappa=KAPPA))
    save(figure, file)
    assert file.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]
    text = words(figure)
    for part in (
        "inadmissible",
        "period 1",
        "aperiodic",
        "undecided",
        "no impact",
        "largest admissible",
        "$d$",
        r"$\kappa$",
    ):
        assert part in text, part
    assert r"soft walls, $\gamma$ = 0.1" in text
    axes, bar = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    assert "[J per half period]" in bar.get_ylabel()


def test_cells_of_a_window_are_not_marked_undecided():
    window = drawn_map(d=D, kappa=KAPPA).assign_attrs(until="window")
    assert "undecided" not in words(number_maps.power_map(window))


def test_legend_omits_absent_kinds_of_cells():
    dataset = drawn_map(d=D, kappa=KAPPA)
    dataset["period"][:] = 1
    dataset["admissible"][:] = True
    dataset["P"][:] = 1e-6
    text = words(number_maps.power_map(dataset))
    assert not [part for part in ("inadmissible", "aperiodic", "undecided", "no impact") if part in text]


def test_colours_are_logarithmic_and_span_the_admissible_cells():
    dataset = drawn_map(d=D, kappa=KAPPA)
    mesh = number_maps.power_map(dataset).axes[0].collections[0]
    assert isinstance(mesh.norm, LogNorm)
    assert mesh.norm.vmax == pytest.approx(float(dataset["P"].where(dataset["admissible"]).max()))


def test_star_stands_on_the_largest_admissible_cell():
    dataset = drawn_map(d=D, kappa=KAPPA)
    peak = best(dataset)
    assert float(peak) == pytest.approx(36e-6)
    star = next(line for line in number_maps.power_map(dataset).axes[0].lines if line.get_marker() == "*")
    assert (star.get_xdata()[0], star.get_ydata()[0]) == (float(peak["d"]), float(peak["kappa"]))


def test_best_is_none_without_an_admissible_cell():
    dataset = drawn_map(d=D, kappa=KAPPA)
    dataset["admissible"][:] = False
    assert best(dataset) is None
    assert "largest" not in words(number_maps.power_map(dataset))


def test_hatch_border_and_dots_lie_on_their_cells():
    dataset = drawn_map(d=D, kappa=KAPPA)
    axes = number_maps.power_map(dataset).axes[0]
    aperiodic = dataset["period"].stack(cell=["d", "kappa"])
    aperiodic = aperiodic[(aperiodic == 0).values]
    dots = next(line for line in axes.lines if line.get_marker() == ".")
    drawn = sorted(zip(dots.get_xdata(), dots.get_ydata(), strict=True))
    assert drawn == sorted(zip(aperiodic["d"].values, aperiodic["kappa"].values, strict=True))
    veil = next(piece for piece in axes.collections if getattr(piece, "hatches", None))
    for i, j in np.ndindex(6, 8):
        inside = any(path.contains_point((D[i], KAPPA[j])) for path in veil.get_paths())
        assert inside == (not bool(dataset["admissible"][i, j])), (i, j)


def drawn_comparison(**axes) -> xr.Dataset:
    """Return a comparison: labels differ at small d, rigid suffices at large kappa, and a cell is undecided."""
    dataset = drawn_map(**axes).drop_vars(["P", "admissible", "period"])
    row, column = np.indices([len(values) for values in axes.values()])
    cheapest = np.where(column > 4, CheapestModel.RIGID, CheapestModel.SOFT)
    cheapest[5, 2] = CheapestModel.UNDECIDED
    dataset["relative_difference"] = (list(axes), 10.0 ** (1 - column))
    dataset["relative_difference"][0, 0] = np.inf
    dataset["label"] = (list(axes), np.where(row < 2, LabelAgreement.DIFFERS, LabelAgreement.AGREES))
    dataset["cheapest_model"] = (list(axes), cheapest, {"tolerance": 0.005})
    return dataset


def test_difference_map_has_legend_and_scale(tmp_path):
    dataset = drawn_comparison(d=D, kappa=KAPPA)
    figure = number_maps.difference_map(dataset)
    save(figure, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    text = words(figure)
    for part in ("other labels", "rigid is enough within 0.5 %", "undecided", "P_\\mathrm{soft}"):
        assert part in text, part
    assert "failed" not in text
    mesh = figure.axes[0].collections[0]
    assert not np.ma.getmaskarray(mesh.get_array()).any()  # an infinite difference is not missing
    norm = mesh.norm
    assert (type(norm), norm.vmin, norm.vmax) == (LogNorm, 1e-4, 1.0)
    text = words(number_maps.difference_map(dataset.drop_vars("cheapest_model")))
    assert not [part for part in ("enough", "undecided") if part in text]


def test_outlines_of_different_labels_and_of_sufficient_rigid_walls():
    axes = number_maps.difference_map(drawn_comparison(d=D, kappa=KAPPA)).axes[0]
    labels, enough = (piece.get_segments() for piece in axes.collections[1:3])
    assert {round(x, 12) for segment in labels for x, _ in segment} == {0.125}
    assert {round(y, 9) for segment in enough for _, y in segment} == {round(np.sqrt(KAPPA[4] * KAPPA[5]), 9)}
    (cross,) = axes.lines
    assert (cross.get_xdata().tolist(), cross.get_ydata().tolist()) == ([D[5]], [KAPPA[2]])


def test_a_difference_over_one_axis_is_a_curve():
    dataset = drawn_comparison(d=D, kappa=KAPPA)
    dataset["relative_difference"][0, 7] = np.nan
    figure = number_maps.difference_map(dataset.isel(d=[0]))
    (axes,) = figure.axes
    np.testing.assert_array_equal(axes.lines[0].get_ydata()[[0, 7]], [np.nan, np.nan])
    edges = [line.get_xdata()[0] for line in axes.lines[1:] if line.get_color() == "red"]
    assert edges == pytest.approx([np.sqrt(KAPPA[4] * KAPPA[5])])
    assert "no difference, or failed" in words(figure)


def test_borders_separate_a_mask_from_other_cells():
    mask = np.array([[True, False, False], [True, True, False]])
    segments = cells.borders(np.arange(4.0), np.arange(3.0), mask)
    assert sorted(sorted(segment) for segment in segments) == [
        [(1.0, 0.0), (1.0, 1.0)],
        [(1.0, 1.0), (2.0, 1.0)],
        [(2.0, 1.0), (2.0, 2.0)],
    ]


def test_fine_maps_are_marked_by_blocks():
    size = 2 * cells.MAX_SYMBOLS_PER_SIDE
    mask = np.zeros((size, size), bool)
    mask[:2, :2] = True
    mask[100, 100] = True
    places = np.arange(size)
    most = cells.marked_places(mask, places, places, most=True)
    anywhere = cells.marked_places(mask, places, places, most=False)
    assert (most[0].tolist(), most[1].tolist()) == ([1], [1])
    assert len(anywhere[0]) == 2


def test_panels_show_the_further_axes_in_order():
    dataset = drawn_map(d=D, kappa=KAPPA, A=[1.0, 2.0], r=[0.3, 0.5, 0.8])
    figure = number_maps.power_map(dataset)
    titles = [axes.get_title() for axes in figure.axes[:6]]
    assert titles[1] == "$A$ = 2 m s$^{-2}$, $r$ = 0.3"
    assert titles[2] == "$A$ = 1 m s$^{-2}$, $r$ = 0.5"
    for axes in figure.axes[:6]:
        amplitude, r = (float(part.split("=")[1].split()[0]) for part in axes.get_title().split(","))
        power = dataset["P"].sel(A=amplitude, r=r).transpose("kappa", "d").values
        np.testing.assert_array_equal(np.ma.filled(axes.collections[0].get_array(), 0.0), power)


def test_unsorted_values_are_drawn_sorted():
    dataset = drawn_map(d=D, kappa=KAPPA)
    mixed = dataset.isel(d=[3, 0, 5, 1, 4, 2])
    want, got = (number_maps.power_map(item).axes[0].collections[0].get_array() for item in (dataset, mixed))
    np.testing.assert_array_equal(np.ma.filled(got, 0.0), np.ma.filled(want, 0.0))


def test_one_axis_is_a_curve():
    figure = number_maps.power_map(drawn_map(omega0=np.linspace(20, 400, 30)))
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_yscale()) == (r"$\omega_0$ [rad s$^{-1}$]", "log")
    assert isinstance(figure.legends[0], Legend)


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [(20, 200, ["20", "50", "100", "200"]), (30, 50, ["30", "35", "40", "45", "50"])],
)
def test_logarithmic_axes_of_few_decades_have_separate_plain_labels(low, high, labels):
    figure = number_maps.power_map(drawn_map(omega0=np.geomspace(low, high, 12), d=D))
    figure.draw_without_rendering()
    axis = figure.axes[0].xaxis
    first, last = axis.get_view_interval()
    places = zip(axis.get_majorticklocs(), axis.get_majorticklabels(), strict=True)
    drawn_labels = [text.get_text() for at, text in places if first <= at <= last]
    assert drawn_labels == labels
    assert not axis.get_minorticklocs().size


def test_a_map_without_energy_is_drawn():
    dataset = drawn_map(d=D, kappa=KAPPA)
    dataset["P"][:] = 0.0
    assert "no impact" in words(number_maps.power_map(dataset))


def test_missing_variables_and_unsupported_file_types_raise(tmp_path):
    with pytest.raises(ValueError, match="without admissible"):
        number_maps.power_map(drawn_map(d=D, kappa=KAPPA).drop_vars("admissible"))
    with pytest.raises(ValueError, match=r"plot must end in \.png"):
        save(number_maps.power_map(drawn_map(d=D, kappa=KAPPA)), tmp_path / "map.doc")


# --- maps of kinds ----------------------------------------------------------------------------------------------------


def coords(**axes):
    coordinates = {name: (name, np.asarray(values), {"symbol": name, "units": "1"}) for name, values in axes.items()}
    return coordinates | {"gamma": ((), 0.0, {"symbol": r"\gamma", "units": "1"})}


def labelled_map(gamma=0.0) -> xr.Dataset:
    """Return a map: half 1:1, then 2:1/2T with its mirror image, a label per cell, undecided, no impact, chaos."""
    period = np.ones((20, 10), int)
    left = np.ones_like(period)
    period[10:12], left[10:12], period[12:14] = 2, 2, 2
    right = np.where(np.arange(20)[:, None] // 2 == 6, 2, 1) + 0 * left
    left[14:16] = 3 + np.arange(20).reshape(2, 10)
    period[16:18], left[16:18], right[16:18] = -1, -1, -1
    period[18:], left[18:], right[18:] = 0, -1, -1
    dims = ("d", "kappa")
    exponent = np.where(period == 0, np.linspace(0.1, 0.9, 10), -0.5)
    status = np.where(period < 0, int(Status.SLOW), 0)
    status[17] = Status.NO_IMPACT
    period[17], left[17], right[17] = 1, 0, 0
    values = {"period": period, "impacts_left": left, "impacts_right": right, "status": status, "lyapunov": exponent}
    place = coords(d=np.linspace(0.1, 0.3, 20), kappa=np.geomspace(3, 30, 10))
    dataset = xr.Dataset(
        {name: (dims, value) for name, value in values.items()}, place, {"wall": "soft", "periods": 400}
    )
    dataset["gamma"] = dataset["gamma"] + gamma
    return dataset


def legend(figure) -> dict[str, tuple]:
    """Return the colour of each legend entry by its text."""
    (box,) = figure.legends or [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    texts = (text.get_text() for text in box.get_texts())
    return dict(zip(texts, (patch.get_facecolor() for patch in box.get_patches()), strict=True))


def test_label_map_names_the_commonest_labels_and_the_simulated_periods():
    dataset = labelled_map()
    figure = kind_maps.label_map(dataset)
    entries = legend(figure)
    rare = {f"0.5 % 1:{n}" for n in range(3, 23)}
    assert list(entries)[:2] == ["50 % 1:1", "20 % 1:2/2T"]  # mirror images are merged
    assert len(rare & set(entries)) == 10
    assert {"5 % 10 other labels", "10 % aperiodic within 400 periods", "5 % undecided", "5 % no impact"} < set(entries)
    assert len(set(entries.values())) == len(entries) == 16
    mesh, shades = figure.axes[0].collections
    colours = mesh.cmap(mesh.norm(mesh.get_array()))
    for cell, text in (((0, 0), "50 % 1:1"), ((9, 13), "20 % 1:2/2T"), ((5, 16), "5 % undecided")):
        assert tuple(colours[cell]) == entries[text], text
    drawn = shades.get_array()
    np.testing.assert_allclose(drawn[:, 18], dataset["lyapunov"][18])
    assert drawn.mask[:, :18].all()
    assert "Lyapunov exponent per forcing period" in [axes.get_xlabel() for axes in figure.axes]


def test_label_map_separates_mirror_images_under_gravity(tmp_path):
    figure = kind_maps.label_map(labelled_map(gamma=0.1).drop_vars("lyapunov"))
    save(figure, tmp_path / "map.png")
    assert {"10 % 2:1/2T", "10 % 1:2/2T"} < set(legend(figure))
    assert len(figure.axes) == 1
    assert (tmp_path / "map.png").stat().st_size


def basin_table(**further) -> xr.Dataset:
    table = {
        "label": ["1:2/2T", "aperiodic", "1:1", ""],
        "P": [4e-3, 2e-6, 1e-6, np.nan],
        "starts": [40, 30, 10, 0],
        "fraction": [0.5, 0.375, 0.125, 0.0],
        "periods_run": [50.0, 300.0, 40.0, np.nan],
    }
    basin = np.repeat([0, 0, 0, 0, 1, 1, 1, 2], 10).reshape(8, 10)
    variables = {name: ("attractor", np.array(column)) for name, column in table.items()}
    place = coords(u0=np.linspace(-0.1, 0.1, 8), v0=np.linspace(-0.6, 0.6, 10))
    return xr.Dataset(variables | {"basin": (("u0", "v0"), basin)} | further, place, {"wall": "soft"})


def test_basin_map_lists_its_attractors():
    dataset = basin_table()
    figure = kind_maps.basin_map(dataset)
    entries = legend(figure)
    chaos = "37.5 % aperiodic within 300 periods, $P$ = 2.00 µJ"
    assert list(entries) == ["50 % 1:2/2T, $P$ = 4.00 mJ", chaos, "12.5 % 1:1, $P$ = 1.00 µJ"]
    (mesh,) = figure.axes[0].collections
    colours = mesh.cmap(mesh.norm(mesh.get_array()))
    assert [tuple(colours[0, column]) for column in (0, 4, 7)] == list(entries.values())
    assert entries[chaos] == to_rgba(kind_maps.NO_ORBIT["aperiodic"])
    assert figure.axes[0].get_xlabel() == "$u0$"


def test_attractors_without_a_colour_are_merged():
    many, most = 40, kind_maps.MOST_NAMED
    dataset = basin_table().isel(attractor=np.zeros(many, int))
    dataset["fraction"] = ("attractor", np.full(many, 1 / many))
    dataset["basin"] = (("u0", "v0"), np.arange(80).reshape(8, 10) % many)
    entries = legend(kind_maps.basin_map(dataset))
    assert list(entries)[-1] == f"70 % {many - most} others"


def test_multistability_map_counts_attractors():
    number = np.tile([0, 1, 1, 3], (5, 1))
    place = coords(d=np.linspace(0.1, 0.3, 5), kappa=np.arange(3.0, 7.0))
    dataset = xr.Dataset({"attractors": (("d", "kappa"), number)}, place, {"wall": "soft"})
    entries = legend(kind_maps.multistability_map(dataset))
    assert list(entries) == ["25 % undecided", "50 % 1 attractor", "0 % 2 attractors", "25 % 3 attractors"]


def test_map_of_kinds_requires_a_plane_and_its_variables():
    with pytest.raises(ValueError, match="two axes of more than one value; got d alone"):
        kind_maps.label_map(labelled_map().isel(kappa=[0]))
    with pytest.raises(ValueError, match="without status"):
        kind_maps.label_map(labelled_map().drop_vars("status"))
    with pytest.raises(ValueError, match="without P"):
        kind_maps.basin_map(basin_table().drop_vars("P"))


# --- any variable -----------------------------------------------------------------------------------------------------


def map_of_all_kinds() -> xr.Dataset:
    """Return `drawn_map` with variables of all kinds: wide and narrow numbers, counts, signs, flags, booleans."""
    dataset = drawn_map(d=D, kappa=KAPPA)
    shape = dataset["P"].shape
    spread = np.linspace(-1, 1, dataset["P"].size).reshape(shape)
    status = {"flag_values": [0, 4, 9], "flag_meanings": "ok slow not_run"}
    return dataset.assign(
        power=(("d", "kappa"), dataset["P"].values ** 2, {"units": "W"}),
        max_penetration=(("d", "kappa"), 0.002 + 1e-3 * spread, {"units": "m"}),
        asymmetry=(("d", "kappa"), spread, {"units": "1"}),
        impacts_left=(("d", "kappa"), np.where(spread < 0, -1, np.arange(48).reshape(shape) % 3)),
        status=(("d", "kappa"), np.where(spread < -0.5, 4, 0).astype(np.int8), status),
    )


@pytest.mark.parametrize(
    ("name", "log", "label"),
    [
        ("power", True, "power [W]"),
        ("max_penetration", False, "max penetration [m]"),
        ("asymmetry", False, "asymmetry"),
        ("impacts_left", False, "impacts left"),
    ],
)
def test_numeric_variables_are_drawn(name, log, label):
    dataset = map_of_all_kinds()
    figure = number_maps.variable_map(dataset, name)
    mesh = figure.axes[0].collections[0]
    assert isinstance(mesh.norm, LogNorm) == log
    assert figure.axes[1].get_ylabel() == label
    visible = dataset[name].where(dataset["admissible"] & (dataset[name] >= 0 if name == "impacts_left" else True))
    assert mesh.norm.vmax == pytest.approx(float(visible.max()))
    drawn = np.ma.count(mesh.get_array())
    assert drawn == {"power": 47, "impacts_left": 24}.get(name, 48)
    assert "inadmissible" in words(figure)


def test_variable_without_admissibility_is_drawn(tmp_path):
    figure = number_maps.variable_map(map_of_all_kinds()[["max_penetration"]], "max_penetration")
    save(figure, tmp_path / "map.png")
    assert "inadmissible" not in words(figure)
    assert (tmp_path / "map.png").exists()


def test_kinds_have_separate_colours():
    for name, share in (("status", "75 % ok\n25 % slow"), ("admissible", "25 % no\n75 % yes")):
        figure = number_maps.variable_map(map_of_all_kinds(), name)
        assert "\n".join(text.get_text() for text in figure.legends[0].get_texts()) == share
        assert figure.axes[0].get_yscale() == "log"  # the axes keep the scales of the map


def test_a_variable_over_one_axis_is_a_curve():
    figure = number_maps.variable_map(map_of_all_kinds().isel(kappa=3), "asymmetry")
    assert figure.axes[0].get_yscale() == "linear"
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), map_of_all_kinds()["asymmetry"][:, 3])


def test_few_admissible_cells_do_not_determine_the_colour_scale():
    dataset = drawn_map(d=D, kappa=KAPPA)
    for admissible_count, span in ((4, (2e-6, 48e-6)), (5, (4e-6, 8e-6))):  # of 47 cells shown
        dataset["admissible"][:] = (dataset["P"] > 3.5e-6) & (dataset["P"] < (3.5 + admissible_count) * 1e-6)
        norm = number_maps.power_map(dataset).axes[0].collections[0].norm
        assert (norm.vmin, norm.vmax) == pytest.approx(span)


def test_missing_power_raises_and_names_the_alternative():
    with pytest.raises(ValueError, match=r"dataset must hold P, .* without P; variable_map \(--show NAME\) draws any"):
        number_maps.power_map(map_of_all_kinds().drop_vars("P"))
    with pytest.raises(ValueError, match=r"name must be among P, .* got 'lyapunov'"):
        number_maps.variable_map(map_of_all_kinds(), "lyapunov")


def test_title_of_a_map_of_kinds_does_not_overlap_its_legend():
    quantities = {"r": ("r", "1", 0.5), "omega": (r"\omega", "rad s-1", 3.142), "A": ("A", "m s-2", 1.0)}
    further = {
        name: ((), value, {"symbol": symbol, "units": unit}) for name, (symbol, unit, value) in quantities.items()
    }
    dataset = labelled_map(gamma=0.1).assign_coords(further)
    figure = kind_maps.label_map(dataset)
    figure.canvas.draw()
    (list_box,) = figure.legends
    assert figure.get_suptitle().startswith("soft walls")
    title_box = figure._suptitle.get_window_extent().expanded(1.05, 1.0)  # texts closer than 5 % are hard to read
    assert not list_box.get_window_extent().overlaps(title_box)
