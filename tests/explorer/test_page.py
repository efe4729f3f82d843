"""A page without a browser: messages to the page, its answers, and the jobs that it starts."""

import threading
from base64 import b64decode
from types import SimpleNamespace

import numpy as np
import pytest
from bokeh.document import Document

import vijax
from tests.explorer.drawn_curves import drawn_curves
from tests.helpers import no_cell_runs
from vijax.explorer import export, view
from vijax.explorer import page as page_module
from vijax.explorer.page import ExplorerPage
from vijax.explorer.plane import explored
from vijax.explorer.server import server
from vijax.explorer.server.jobs import JobThreads
from vijax.explorer.server.precompilation import CompilationState, precompile
from vijax.explorer.source import Source
from vijax.model.records import Status


@pytest.fixture(scope="module")
def power():
    """Map without cell runs; a page computes no cell of its map by itself."""
    with no_cell_runs():
        return vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4))


def widened(power, columns: int, rows: int):
    """Return a map with the numbers of cells and no variable except the status."""
    wide = power[["status"]].isel(d=np.zeros(columns, int), kappa=np.zeros(rows, int))
    return wide.assign_coords(d=np.linspace(0.1, 0.3, columns), kappa=np.geomspace(3, 400, rows))


@pytest.fixture
def opened():
    """Open pages of maps; return each page with the list of its messages."""
    all_threads = []

    def open_page(dataset, curves=None, query=None) -> tuple[ExplorerPage, list[dict]]:
        threads, messages = JobThreads(), []
        all_threads.append(threads)
        source = Source(dataset, curves)
        initial_view = view.from_query(source.plane(), query or {})
        page = ExplorerPage(Document(), source, source.plane(), initial_view, threads)
        page.channel.on_change("message", lambda attribute, old, new: messages.append(new))
        return page, messages

    yield open_page
    for threads in all_threads:
        threads.close()


@pytest.mark.parametrize(("columns", "needs_confirmation"), [(1000, False), (1001, True)])
def test_plane_above_a_million_cells_requires_confirmation(power, opened, monkeypatch, columns, needs_confirmation):
    started = threading.Event()
    monkeypatch.setattr(page_module, "sweep", lambda **_: started.set())
    monkeypatch.setattr(page_module, "explored", lambda dataset: dataset)
    page, messages = opened(widened(power, columns, 1000))
    page.handle_message({"kind": "make"})
    assert [message["section"] for message in messages] == (["confirm"] if needs_confirmation else ["panel"])
    if needs_confirmation:
        assert messages[0]["text"] == "This plane has 1,001,000 cells and may take long. Make it?"
        assert page.jobs.running() == ()
        assert not started.is_set()
        page.handle_message({"kind": "make", "confirmed": True})
    assert started.wait(10)


def test_new_plane_uses_all_slider_values(power, opened, monkeypatch):
    requested, started = {}, threading.Event()
    monkeypatch.setattr(page_module, "sweep", lambda **arguments: requested.update(arguments) or started.set())
    monkeypatch.setattr(page_module, "explored", lambda dataset: dataset)
    page, _ = opened(power, query={"r": "0.6"})
    page.handle_message({"kind": "make"})
    assert started.wait(10)
    assert requested["r"] == 0.6
    assert requested["d"].tolist() == power["d"].values.tolist()
    assert requested["kappa"].tolist() == power["kappa"].values.tolist()


def test_value_outside_its_slider_is_not_run(power, opened):
    page, messages = opened(power)
    for message in ({"name": "r", "value": 1.5}, {"name": "omega", "value": 1e9}, {"name": "r", "value": [3]}):
        page.handle_message({"kind": "value", **message})
        assert messages[-2]["section"] == "note"
        assert messages[-2]["error"]
    assert page.view.values == {}
    assert page.jobs.running() == ()


def test_followed_motion_starts_at_the_last_end_within_bounds(power, opened, monkeypatch):
    monkeypatch.setattr(page_module, "motion", lambda cell: None)
    page, messages = opened(power)
    page.motion = SimpleNamespace(end=(0.9, 0.2))
    page.handle_message({"kind": "pick", "column": 1, "row": 1})
    assert page.view.values == {}
    page.handle_message({"kind": "follow", "follow": True})
    page.handle_message({"kind": "pick", "column": 2, "row": 1})
    assert page.view.values == {"u0": 0.5 * float(power["d"][2]), "v0": 0.2}
    assert messages[-1]["query"].endswith("follow=1&u0=0.11666666666666667&v0=0.2")
    page.handle_message({"kind": "follow", "follow": False})
    assert page.view.values == {}


def test_line_and_branch_use_the_selected_axis(power, opened):
    page, _ = opened(power)
    assert page.axis.name == "kappa"
    page.handle_message({"kind": "along", "along": "d"})
    assert page.axis.name == "d"
    assert page.drawing.figures.line.x_range.end == page.plane.x.edges[-1]
    assert page.drawing.figures.branch.below[0].axis_label.startswith("d")


def test_exported_picture_agrees_with_the_page(power, opened):
    page, _ = opened(power, drawn_curves(), {"variable": "P"})
    page._draw_map()
    dataset, name, curves, unstable = page.exports["map"]
    assert (name, unstable) == ("P", False)
    assert dataset["P"].equals(power["P"])
    assert curves is page.source.curves.dataset
    page.handle_message({"kind": "colour", "variable": "status", "scale": "auto", "curves": "hidden"})
    _, name, curves, unstable = page.exports["map"]
    assert (name, unstable) == ("status", False)
    assert curves is None
    page.handle_message({"kind": "colour", "variable": "status", "scale": "auto", "curves": "unstable"})
    assert page.exports["map"][3]


def test_exported_picture_uses_the_function_of_its_panel(power, monkeypatch):
    """Replace each function of `vijax.plots` by a function that returns its name, which the file then contains."""
    drawn = ("curves", "label_map", "power_map", "variable_map", "motion_figure", "orbit_diagram", "basins", "branches")
    for name in drawn:
        monkeypatch.setattr(export, name, lambda *_, name=name, **__: name)
    monkeypatch.setattr(export, "trajectory", lambda *_, **__: None)
    monkeypatch.setattr(export, "save", lambda figure, file: file.write_text(f"{figure}{file.suffix}"))
    panel = SimpleNamespace(dataset=power, span=2.0, end=(0.0, 0.1), pair=None)
    for kind, data, name in (
        ("map", (power, "P", None, False), "power_map"),
        ("map", (power[["P"]], "P", None, False), "variable_map"),
        ("map", (power, "label", None, False), "label_map"),
        ("map", (power, "P", drawn_curves(), False), "curves"),
        ("motion", (panel, panel), "motion_figure"),
        ("line", panel, "orbit_diagram"),
        ("basin", panel, "basins"),
        ("branch", panel, "branches"),
    ):
        assert b64decode(export.picture(kind, data, "svg")).decode() == f"{name}.svg"
    with pytest.raises(ValueError, match="format must be"):
        export.picture("map", (power, "P", None, False), "exe")


def test_compilation_state_is_sent_until_it_ends(power, opened):
    page, messages = opened(power)
    compilation, before = CompilationState("compiling: lines"), [""]
    for _ in range(2):
        server._send_compilation_state(page, compilation, before)
    compilation.text = ""
    server._send_compilation_state(page, compilation, before)
    assert [message["text"] for message in messages] == ["compiling: lines", ""]


def test_compilation_state_ends_after_an_error(power):
    compilation = CompilationState()
    broken = Source(power)
    broken.plane = lambda: 1 / 0
    precompile(broken, JobThreads(), compilation)
    assert compilation.text == ""


def test_curves_of_another_value_are_removed_with_a_note(power, opened):
    page, messages = opened(power, drawn_curves())
    page._draw_map()
    assert len(page.drawing.tables.curves.data["xs"]) == 1
    page._remade(explored(power.assign_coords(r=0.6)))
    (note,) = (message["text"] for message in messages if message["section"] == "curves" and message["text"])
    assert "their r is 0.5, here it is 0.6" in note
    assert page.drawing.tables.curves.data["xs"] == []


def test_hatching_symbols_and_legend_agree_with_the_cells(power, opened):
    admissible, period, status = np.ones((4, 4), bool), np.ones((4, 4), int), np.zeros((4, 4), int)
    admissible[1:3, 0] = admissible[2, 3] = False  # two neighbours make one rectangle
    period[0, 2] = period[3, 1] = 0
    period[2, 2] = -1
    status[3, 3] = Status.NOT_RUN  # a cell without a result has no symbol
    period[3, 3], admissible[3, 3] = -1, False
    place = ("d", "kappa")
    energies = np.where(period < 0, 0.0, 1e-6 * (1 + np.arange(16).reshape(4, 4)))
    variables = {"admissible": admissible, "period": period, "status": status, "P": energies}
    page, messages = opened(power.assign({name: (place, values) for name, values in variables.items()}))
    page._draw_map()
    across, up = page.plane.x, page.plane.y
    tables = page.drawing.tables

    hatched = {
        tuple(
            int(np.argmin(abs(axis.edges - tables.veil.data[side][k])))
            for axis, side in ((across, "left"), (across, "right"), (up, "bottom"), (up, "top"))
        )
        for k in range(len(tables.veil.data["left"]))
    }
    assert hatched == {(1, 3, 0, 1), (2, 3, 3, 4)}

    def at(table):
        return {(across.nearest(x), up.nearest(y)) for x, y in zip(table.data["x"], table.data["y"], strict=True)}

    assert (at(tables.dots), at(tables.crosses), at(tables.star)) == ({(0, 2), (3, 1)}, {(2, 2)}, {(3, 2)})
    (legend,) = (message for message in messages if message["section"] == "legend")
    counts = {text.partition(",")[0]: count for _, _, text, count in legend["entries"]}
    assert counts == {
        "inadmissible": 3,
        "border of period 1": 12,
        "aperiodic": 2,
        "undecided": 1,
        "no impact": 1,
        "largest admissible P": 1,
    }


def test_closed_page_ends_its_jobs(power, monkeypatch):
    pages, started, go = [], threading.Event(), threading.Event()
    monkeypatch.setattr(server, "ExplorerPage", lambda *args: pages.append(ExplorerPage(*args)) or pages[-1])
    threads = JobThreads()
    document = server.application(Source(power), threads, CompilationState()).create_document()
    (page,) = pages
    deliveries = []

    def slow(report):
        started.set()
        assert go.wait(10)
        report(0, 1)

    job = page.jobs.start("slow", slow, deliveries.append, deliveries.append)
    assert started.wait(10)
    document.on_change(deliveries.append)  # a session destroys its document with the same object
    document.destroy(deliveries.append)
    go.set()
    job.future.result(timeout=10)
    assert page.jobs.running() == ()
    assert job.cancelled.is_set()
    assert deliveries == []
    threads.close()


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
    {"kind": "export", "panel": HUGE, "format": "pdf"},
)


def test_invalid_message_is_answered_with_a_short_note(power, opened):
    page, messages = opened(power)
    before = page.view
    for message in MEANINGLESS:
        messages.clear()
        page.handle_message(message)
        notes = [sent["text"] for sent in messages if sent["section"] == "note"]
        assert len(notes) == 1, message
        assert "\n" not in notes[0], message
        assert len(notes[0]) < 300, message
        assert page.view == before, message
        assert not page.jobs.running(), message


def test_pick_outside_the_map_is_the_nearest_cell(power, opened):
    page, _ = opened(power)
    page.handle_message({"kind": "pick", "column": HUGE, "row": -HUGE})
    assert page.view.pick == (3, 0)
