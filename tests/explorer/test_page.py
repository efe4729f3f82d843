"""A page without a browser: what it is asked, what it tells, and which jobs it begins."""

import threading
from base64 import b64decode
from types import SimpleNamespace

import numpy as np
import pytest
from bokeh.document import Document

import vijax
from tests.explorer.drawn_curves import drawn_curves
from tests.helpers import no_cell_runs
from vijax.explorer import export, server, view
from vijax.explorer import page as room
from vijax.explorer.jobs import Crew
from vijax.explorer.page import ExplorerPage
from vijax.explorer.plane import explored
from vijax.explorer.source import Source
from vijax.explorer.warming import Warmth, warm
from vijax.model.records import Status


@pytest.fixture(scope="module")
def power():
    """A map whose cells are not run: a page computes none of it by itself."""
    with no_cell_runs():
        return vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4))


def widened(power, columns: int, rows: int):
    """Make a map of so many cells, of which nothing but the status is kept."""
    wide = power[["status"]].isel(d=np.zeros(columns, int), kappa=np.zeros(rows, int))
    return wide.assign_coords(d=np.linspace(0.1, 0.3, columns), kappa=np.geomspace(3, 400, rows))


@pytest.fixture
def opened():
    """Open pages of maps; give each with all that it tells."""
    crews = []

    def open_page(dataset, curves=None, query=None) -> tuple[ExplorerPage, list[dict]]:
        crew, told = Crew(), []
        crews.append(crew)
        source = Source(dataset, curves)
        shown = view.from_query(source.plane(), query or {})
        made = ExplorerPage(Document(), source, source.plane(), shown, crew)
        made.channel.on_change("told", lambda attribute, old, new: told.append(new))
        return made, told

    yield open_page
    for crew in crews:
        crew.close()


@pytest.mark.parametrize(("columns", "asks"), [(1000, False), (1001, True)])
def test_a_plane_beyond_a_million_cells_is_made_only_if_it_is_asked_for_twice(
    power, opened, monkeypatch, columns, asks
):
    begun = threading.Event()
    monkeypatch.setattr(room, "sweep", lambda **_: begun.set())
    monkeypatch.setattr(room, "explored", lambda found: found)
    one, told = opened(widened(power, columns, 1000))
    one.heard({"kind": "make"})
    assert [message["section"] for message in told] == (["ask"] if asks else ["panel"])
    if asks:
        assert told[0]["text"] == "This plane has 1,001,000 cells and may take long. Make it?"
        assert one.jobs.running() == ()
        assert not begun.is_set()
        one.heard({"kind": "make", "sure": True})
    assert begun.wait(10)


def test_what_is_asked_of_a_plane_is_all_that_its_sliders_say(power, opened, monkeypatch):
    asked, begun = {}, threading.Event()
    monkeypatch.setattr(room, "sweep", lambda **given: asked.update(given) or begun.set())
    monkeypatch.setattr(room, "explored", lambda found: found)
    one, _ = opened(power, query={"r": "0.6"})
    one.heard({"kind": "make"})
    assert begun.wait(10)
    assert asked["r"] == 0.6
    assert asked["d"].tolist() == power["d"].values.tolist()
    assert asked["kappa"].tolist() == power["kappa"].values.tolist()


def test_a_value_beyond_its_slider_is_never_run(power, opened):
    one, told = opened(power)
    for message in ({"name": "r", "value": 1.5}, {"name": "omega", "value": 1e9}, {"name": "r", "value": [3]}):
        one.heard({"kind": "value", **message})
        assert told[-2]["section"] == "note"
        assert told[-2]["error"]
    assert one.view.values == {}
    assert one.jobs.running() == ()


def test_a_motion_that_is_dragged_starts_where_the_last_one_ended_within_bounds(power, opened, monkeypatch):
    monkeypatch.setattr(room, "motion", lambda cell: None)
    one, told = opened(power)
    one.motion = SimpleNamespace(end=(0.9, 0.2))
    one.heard({"kind": "pick", "column": 1, "row": 1})
    assert one.view.values == {}
    one.heard({"kind": "follow", "follow": True})
    one.heard({"kind": "pick", "column": 2, "row": 1})
    assert one.view.values == {"u0": 0.5 * float(power["d"][2]), "v0": 0.2}
    assert told[-1]["query"].endswith("follow=1&u0=0.11666666666666667&v0=0.2")
    one.heard({"kind": "follow", "follow": False})
    assert one.view.values == {}


def test_line_and_branch_go_along_the_axis_that_is_chosen(power, opened):
    one, _ = opened(power)
    assert one.axis.name == "kappa"
    one.heard({"kind": "along", "along": "d"})
    assert one.axis.name == "d"
    assert one.drawing.figures.line.x_range.end == one.plane.x.edges[-1]
    assert one.drawing.figures.branch.below[0].axis_label.startswith("d")


def test_a_picture_is_of_what_the_page_shows(power, opened):
    one, _ = opened(power, drawn_curves(), {"variable": "P"})
    one._draw_map()
    dataset, name, curves, unstable = one.exports["map"]
    assert (name, unstable) == ("P", False)
    assert dataset["P"].equals(power["P"])
    assert curves is one.source.curves.dataset
    one.heard({"kind": "colour", "variable": "status", "scale": "auto", "curves": "hidden"})
    _, name, curves, unstable = one.exports["map"]
    assert (name, unstable) == ("status", False)
    assert curves is None
    one.heard({"kind": "colour", "variable": "status", "scale": "auto", "curves": "unstable"})
    assert one.exports["map"][3]


def test_a_picture_is_drawn_by_the_function_of_its_panel(power, monkeypatch):
    """Each function of `vijax.plots` gives its own name here, which is what the file then holds."""
    drawn = ("curves", "label_map", "power_map", "variable_map", "motion_figure", "orbit_diagram", "basins", "branches")
    for name in drawn:
        monkeypatch.setattr(export, name, lambda *_, name=name, **__: name)
    monkeypatch.setattr(export, "trajectory", lambda *_, **__: None)
    monkeypatch.setattr(export, "save", lambda figure, file: file.write_text(f"{figure}{file.suffix}"))
    panel = SimpleNamespace(dataset=power, span=2.0, end=(0.0, 0.1), pair=None)
    for what, found, name in (
        ("map", (power, "P", None, False), "power_map"),
        ("map", (power[["P"]], "P", None, False), "variable_map"),
        ("map", (power, "label", None, False), "label_map"),
        ("map", (power, "P", drawn_curves(), False), "curves"),
        ("motion", (panel, panel), "motion_figure"),
        ("line", panel, "orbit_diagram"),
        ("basin", panel, "basins"),
        ("branch", panel, "branches"),
    ):
        assert b64decode(export.picture(what, found, "svg")).decode() == f"{name}.svg"
    with pytest.raises(ValueError, match="format must be"):
        export.picture("map", (power, "P", None, False), "exe")


def test_what_is_compiled_is_told_until_all_is(power, opened):
    one, told = opened(power)
    warmth, before = Warmth("compiling: lines"), [""]
    for _ in range(2):
        server._tell_of_warmth(one, warmth, before)
    warmth.said = ""
    server._tell_of_warmth(one, warmth, before)
    assert [message["text"] for message in told] == ["compiling: lines", ""]


def test_compiling_ends_whatever_goes_wrong(power):
    warmth = Warmth()
    broken = Source(power)
    broken.plane = lambda: 1 / 0
    warm(broken, Crew(), warmth)
    assert warmth.said == ""


def test_curves_of_another_value_leave_the_map_with_a_word(power, opened):
    one, told = opened(power, drawn_curves())
    one._draw_map()
    assert len(one.drawing.tables.curves.data["xs"]) == 1
    one._remade(explored(power.assign_coords(r=0.6)))
    (said,) = (message["text"] for message in told if message["section"] == "curves" and message["text"])
    assert "their r is 0.5, here it is 0.6" in said
    assert one.drawing.tables.curves.data["xs"] == []


def test_hatching_marks_and_legend_are_of_the_cells_that_they_tell_of(power, opened):
    admissible, period, status = np.ones((4, 4), bool), np.ones((4, 4), int), np.zeros((4, 4), int)
    admissible[1:3, 0] = admissible[2, 3] = False  # two neighbours make one rectangle
    period[0, 2] = period[3, 1] = 0
    period[2, 2] = -1
    status[3, 3] = Status.NOT_RUN  # of such a cell nothing is told
    period[3, 3], admissible[3, 3] = -1, False
    place = ("d", "kappa")
    energies = np.where(period < 0, 0.0, 1e-6 * (1 + np.arange(16).reshape(4, 4)))
    told_of = {"admissible": admissible, "period": period, "status": status, "P": energies}
    one, told = opened(power.assign({name: (place, values) for name, values in told_of.items()}))
    one._draw_map()
    across, up = one.plane.x, one.plane.y
    tables = one.drawing.tables

    veiled = {
        tuple(
            int(np.argmin(abs(axis.edges - tables.veil.data[side][k])))
            for axis, side in ((across, "left"), (across, "right"), (up, "bottom"), (up, "top"))
        )
        for k in range(len(tables.veil.data["left"]))
    }
    assert veiled == {(1, 3, 0, 1), (2, 3, 3, 4)}

    def at(table):
        return {(across.nearest(x), up.nearest(y)) for x, y in zip(table.data["x"], table.data["y"], strict=True)}

    assert (at(tables.dots), at(tables.crosses), at(tables.star)) == ({(0, 2), (3, 1)}, {(2, 2)}, {(3, 2)})
    (legend,) = (message for message in told if message["section"] == "legend")
    counts = {text.partition(",")[0]: count for _, _, text, count in legend["entries"]}
    assert counts == {
        "inadmissible": 3,
        "border of period 1": 12,
        "aperiodic": 2,
        "undecided": 1,
        "no impact": 1,
        "largest admissible P": 1,
    }


def test_a_page_that_is_closed_ends_its_jobs(power, monkeypatch):
    pages, begun, go = [], threading.Event(), threading.Event()
    monkeypatch.setattr(server, "ExplorerPage", lambda *args: pages.append(ExplorerPage(*args)) or pages[-1])
    crew = Crew()
    document = server.application(Source(power), crew, Warmth()).create_document()
    (one,) = pages
    heard = []

    def slow(tell):
        begun.set()
        assert go.wait(10)
        tell(0, 1)

    job = one.jobs.start("slow", slow, heard.append, heard.append)
    assert begun.wait(10)
    document.on_change(heard.append)  # as a session does, which ends its document by the same object
    document.destroy(heard.append)
    go.set()
    job.future.result(timeout=10)
    assert one.jobs.running() == ()
    assert job.over.is_set()
    assert heard == []
    crew.close()


HUGE = 10**400
NO_NUMBERS = (np.inf, -np.inf, np.nan, "x", [1], {})


MEANINGLESS = (
    *({"kind": "value", "name": "r", "value": value} for value in (*NO_NUMBERS, HUGE, "1e999")),
    *({"kind": "pick", "column": value, "row": 0} for value in (*NO_NUMBERS, 0.5, None, "1")),
    {"kind": "pick", "column": 0, "row": 0, "number": np.inf},
    {"kind": "value", "value": 1},
    {"kind": "colour", "variable": [1], "scale": "auto", "curves": "stable"},
    {"kind": "along", "along": None},
    {"kind": "open", "name": HUGE},
    {"kind": "export", "what": HUGE, "format": "pdf"},
)


def test_a_message_without_meaning_is_answered_with_one_line(power, opened):
    one, told = opened(power)
    before = one.view
    for message in MEANINGLESS:
        told.clear()
        one.heard(message)
        notes = [said["text"] for said in told if said["section"] == "note"]
        assert len(notes) == 1, message
        assert "\n" not in notes[0], message
        assert len(notes[0]) < 300, message
        assert one.view == before, message
        assert not one.jobs.running(), message


def test_a_cell_beyond_the_map_is_the_nearest_one(power, opened):
    one, _ = opened(power)
    one.heard({"kind": "pick", "column": HUGE, "row": -HUGE})
    assert one.view.pick == (3, 0)
