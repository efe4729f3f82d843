"""The page in a browser; all tests of this file share a server and a Chromium."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
from matplotlib.image import imread

import vijax
from tests.explorer.drawn_curves import FOLD_AT, drawn_curves
from vijax.model.label import label

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
]
WAIT = 120_000  # milliseconds; this includes compilation on a busy machine
# Mostly 1:1 orbits, since each number of impacts needs another program, compiled in advance.
AXES = {"d": np.linspace(0.2, 0.3, 8), "kappa": np.geomspace(50.0, 400.0, 8)}
PICK = (6, 5)  # cell with a 1:1 orbit, used by most tests
ORBITS = "<i>1:1</i>"  # label of the curves with markup, which the page must display as text


class ServedStore:
    """Process that serves a store and its curves, started as from a shell."""

    def __init__(self, store: Path) -> None:
        self.store, self.page, self.port = store, "", 0
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the process on its previous port, and wait until it prints the address of the page."""
        line = [
            sys.executable,
            "-m",
            "vijax",
            "explore",
            str(self.store),
            "--curves",
            str(self.store / "../curves.zarr"),
        ]
        line += ["--no-browser", "--port", str(self.port)]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.page = self.process.stdout.readline().strip()
        assert self.page.startswith("http://127.0.0.1:"), self.page
        self.port = int(urlsplit(self.page).port or 0)

    def stop(self) -> None:
        """Kill the process at once, unlike Ctrl-C."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """The served map, loaded from its store."""
    folder = tmp_path_factory.mktemp("served")
    vijax.sweep(**AXES, out=folder / "plane.zarr")
    vijax.save(drawn_curves(ORBITS), folder / "curves.zarr")
    return vijax.load(folder / "plane.zarr").assign_attrs(path=str(folder / "plane.zarr"))


@pytest.fixture(scope="module")
def server(dataset) -> Iterator[ServedStore]:
    served = ServedStore(Path(dataset.attrs["path"]))
    served.start()
    yield served
    served.stop()


@pytest.fixture(scope="module")
def browser():
    """Browser context of all pages; later pages use the cache of the first page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True)
        chromium.close()


# Click a button as soon as it appears; a job may end before a click from Python arrives.
PRESS = """(selector) => {
    const press = (_, seen) => {
        const stop = document.querySelector(selector);
        if (stop && !stop.hidden) { seen.disconnect(); stop.click(); }
    };
    new MutationObserver(press).observe(document.body, { attributes: true, childList: true, subtree: true });
}"""


class Tab:
    """Page in the browser with its requests and errors."""

    def __init__(self, browser, address: str) -> None:
        self.page = browser.new_page()
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def wait_for_update(self) -> "Tab":
        """Wait until the page displays the result of its last request."""
        self.page.wait_for_function(
            "document.body.dataset.shown !== undefined && +document.body.dataset.shown >= vijax.number", timeout=WAIT
        )
        return self

    def place(self, pick: tuple[int, int]) -> tuple[float, float]:
        """Return the position of a map cell on the screen."""
        figure = self.page.evaluate(
            """() => {
                const model = Bokeh.documents[0].get_model_by_name("map");
                const view = Bokeh.index.find_one(model), frame = view.frame.bbox;
                const box = document.getElementById("map").getBoundingClientRect();
                return [box.left + frame.left, box.top + frame.top, frame.width, frame.height];
            }"""
        )
        left, top, width, height = figure
        columns, rows = (axis.size for axis in AXES.values())
        return left + width * (pick[0] + 0.5) / columns, top + height * (1 - (pick[1] + 0.5) / rows)

    def click(self, pick: tuple[int, int]) -> "Tab":
        """Click on a cell."""
        self.page.mouse.click(*self.place(pick))
        return self

    def heading(self) -> str:
        """Return the heading of the picked cell."""
        return self.page.inner_text("#heading")

    def view(self) -> dict[str, str]:
        """Return the query of the address."""
        return dict(parse_qsl(urlsplit(self.page.url).query))

    def compute(self, name: str) -> None:
        """Request the computation of a panel."""
        self.page.click(f'.compute[data-name="{name}"]')

    def state(self, name: str, *states: str) -> str:
        """Wait until a panel is in one of the states, and return its text."""
        self.page.wait_for_function(
            "([name, states]) => states.includes(document.querySelector(`[data-panel='${name}']`).dataset.state)",
            arg=[name, list(states)],
            timeout=WAIT,
        )
        return self.page.inner_text(f"[data-panel='{name}']")


@pytest.fixture
def tab(server, browser) -> Iterator[Callable[..., Tab]]:
    """Open pages of the server; they are closed after the test."""
    opened: list[Tab] = []

    def open_tab(query: str = "") -> Tab:
        opened.append(Tab(browser, f"{server.page}{query}"))
        return opened[-1]

    yield open_tab
    for entry in opened:
        entry.page.close()


@pytest.fixture(scope="module")
def shared_tab(server, browser) -> Iterator[Tab]:
    """Page shared by most tests, which begin with a pick; loading a page takes seconds."""
    new_tab = Tab(browser, server.page)
    yield new_tab.wait_for_update()
    new_tab.page.close()


def expected_heading(dataset, pick: tuple[int, int], **moved: float) -> str:
    """Return the expected heading of a cell, from a sweep of this cell alone."""
    place = {name: float(values[index]) for (name, values), index in zip(AXES.items(), pick, strict=True)}
    result = vijax.sweep(**(place | {"r": 0.5, "gamma": 0.0} | moved))
    word = label(result["period"], result["impacts_left"], result["impacts_right"], result["status"])
    return f"{word}, P = {float(result['P']):.6g} J"


def test_first_load_has_no_errors_and_only_local_requests(shared_tab):
    assert shared_tab.errors == []
    assert {urlsplit(url).hostname for url in shared_tab.requests if not url.startswith("data:")} == {"127.0.0.1"}
    assert len(shared_tab.requests) > 3


def test_click_displays_the_result_of_a_sweep_of_the_cell(shared_tab, dataset):
    for pick in (PICK, (2, 6), (7, 0)):
        shared_tab.click(pick).wait_for_update()
        assert shared_tab.heading() == expected_heading(dataset, pick)
        assert shared_tab.view()["cell"] == f"{pick[0]},{pick[1]}"


def test_drag_picks_the_cells_on_its_path(shared_tab, dataset):
    shared_tab.page.mouse.move(*shared_tab.place((3, 6)))
    shared_tab.page.mouse.down()
    for column in (4, 5, 6):
        shared_tab.page.mouse.move(*shared_tab.place((column, 6)), steps=3)
    shared_tab.page.mouse.up()
    shared_tab.wait_for_update()
    assert shared_tab.heading() == expected_heading(dataset, (6, 6))


def test_a_second_click_within_300_ms_counts(shared_tab, dataset):
    first, second = shared_tab.place((2, 6)), shared_tab.place(PICK)
    shared_tab.page.mouse.click(*first)
    shared_tab.page.mouse.click(*second)
    shared_tab.page.wait_for_function(f"location.search.includes('cell={PICK[0]}%2C{PICK[1]}')", timeout=WAIT)
    assert shared_tab.wait_for_update().heading() == expected_heading(dataset, PICK)


@pytest.mark.long
def test_a_slider_changes_the_motion_and_a_plane_of_its_value_is_made(tab, dataset):
    new_tab = tab().wait_for_update().click(PICK).wait_for_update()
    new_tab.page.fill('[data-name="r"] input[type="number"]', "0.6")
    new_tab.page.keyboard.press("Enter")
    new_tab.page.wait_for_function("location.search.includes('r=0.6')", timeout=WAIT)
    assert new_tab.wait_for_update().heading() == expected_heading(dataset, PICK, r=0.6)
    new_tab.page.evaluate(PRESS, "[data-panel='plane'] button")
    new_tab.page.click("#make")
    assert "Cancelled" in new_tab.state("plane", "cancelled", "done", "failed")
    # A plane above a million cells is computed after confirmation; test_page checks when it is requested.
    for answer in ("dismiss", "accept"):
        new_tab.page.once("dialog", lambda dialog, answer=answer: getattr(dialog, answer)())
        new_tab.page.evaluate("vijax.receive({ section: 'confirm', text: 'This plane has 1,001,000 cells. Make it?' })")
        if answer == "dismiss":
            new_tab.page.wait_for_timeout(300)
            assert "Cancelled" in new_tab.page.inner_text("[data-panel='plane']")
    assert "The map is of these values" in new_tab.state("plane", "done", "failed")
    assert "their r is 0.5, here it is 0.6" in new_tab.page.inner_text("#curvenote")


def test_value_outside_its_bounds_is_refused_with_a_note(shared_tab, dataset):
    shared_tab.click(PICK).wait_for_update()
    shared_tab.page.fill('[data-name="r"] input[type="number"]', "7")
    shared_tab.page.keyboard.press("Enter")
    shared_tab.page.wait_for_selector("#note:not([hidden])", timeout=WAIT)
    assert "r must lie between 0.05 and 1 on this page; got 7" in shared_tab.page.inner_text("#note")
    assert shared_tab.heading() == expected_heading(dataset, PICK)


@pytest.mark.long
def test_basin_and_branch_are_computed_on_demand_and_cancelled(shared_tab):
    shared_tab.click(PICK).wait_for_update()
    shared_tab.compute("basin")
    assert "1:1" in shared_tab.state("basin", "done", "failed")
    shared_tab.compute("branch")
    assert "The branch has" in shared_tab.state("branch", "done", "failed")
    assert shared_tab.view()["open"] == "basin,branch"
    shared_tab.page.evaluate(PRESS, '.cancel[data-name="basin"]')
    shared_tab.compute("basin")
    assert "Cancelled" in shared_tab.state("basin", "cancelled")


def test_pictures_are_saved(shared_tab):
    shared_tab.click(PICK).wait_for_update()
    for panel, format, begins in (("map", "PNG", b"\x89PNG"), ("motion", "PDF", b"%PDF"), ("motion", "SVG", b"<?xml")):
        with shared_tab.page.expect_download(timeout=WAIT) as download:
            shared_tab.page.click(f'.files[data-export="{panel}"] >> text={format}')
        assert Path(download.value.path()).read_bytes().startswith(begins)
        assert download.value.suggested_filename == f"{panel}.{format.lower()}"


def test_the_address_restores_the_view(tab, dataset):
    new_tab = tab("?variable=label&cell=6%2C5&along=d&r=0.6&open=basin&curves=unstable").wait_for_update()
    assert "1:1" in new_tab.state("basin", "done", "failed")
    assert new_tab.page.input_value("#variable") == "label"
    assert new_tab.page.input_value("#along") == "d"
    assert new_tab.page.input_value("#curves") == "unstable"
    assert "grazing" in new_tab.page.inner_text("#curvelegend")
    assert new_tab.page.input_value('[data-name="r"] input[type="number"]') == "0.6"
    assert new_tab.heading() == expected_heading(dataset, PICK, r=0.6)
    query = {"variable": "label", "cell": "6,5", "along": "d", "r": "0.6", "open": "basin", "curves": "unstable"}
    assert new_tab.view() | query == new_tab.view()


def test_error_of_an_invalid_address_is_plain_text(tab):
    new_tab = tab("?variable=<img src=x onerror=alert(1)>").wait_for_update()
    assert "variable must be among" in new_tab.page.inner_text("#note")
    assert new_tab.page.query_selector("#note img") is None


def count_fold_pixels(tab: Tab) -> int:
    """Return the number of pixels of the map in the colour of a fold."""
    picture = imread(BytesIO(tab.page.locator("#map").screenshot()))[..., :3]
    return int((np.abs(255 * picture - [0xD6, 0x27, 0x28]).max(axis=2) < 12).sum())


@pytest.mark.long
def test_curves_are_drawn_listed_and_hidden(shared_tab):
    shared_tab.click((5, 6)).wait_for_update()
    assert f"fold of {ORBITS}" in shared_tab.page.inner_text("#rows")
    assert shared_tab.page.inner_text("#curvelegend").split() == ["fold", "1"]
    visible_pixels = count_fold_pixels(shared_tab)
    assert visible_pixels > 100
    left, top = shared_tab.place((0, 6))
    across = AXES["d"][1] - AXES["d"][0]
    shared_tab.page.mouse.move(left + (shared_tab.place((1, 6))[0] - left) * (FOLD_AT - AXES["d"][0]) / across, top)
    shared_tab.page.wait_for_selector(f"text=fold of {ORBITS}", timeout=WAIT)
    shared_tab.page.select_option("#curves", "unstable")
    shared_tab.page.wait_for_function(
        "document.getElementById('curvelegend').textContent.includes('grazing')", timeout=WAIT
    )
    shared_tab.page.select_option("#curves", "hidden")
    shared_tab.page.wait_for_function("location.search.includes('curves=hidden')", timeout=WAIT)
    shared_tab.page.wait_for_function("document.getElementById('curvelegend').children.length === 0", timeout=WAIT)
    shared_tab.page.wait_for_timeout(200)
    assert count_fold_pixels(shared_tab) < visible_pixels / 10
    shared_tab.page.select_option("#curves", "shown")
    shared_tab.page.wait_for_function("!location.search.includes('curves')", timeout=WAIT)


@pytest.mark.long
def test_two_tabs_are_independent(shared_tab, tab, dataset):
    other = tab().wait_for_update()
    shared_tab.click(PICK)
    other.click((2, 6))
    assert shared_tab.wait_for_update().heading() == expected_heading(dataset, PICK)
    assert other.wait_for_update().heading() == expected_heading(dataset, (2, 6))
    shared_tab.click((3, 6)).wait_for_update()
    assert other.heading() == expected_heading(dataset, (2, 6))


def test_the_keyboard_alone_moves_the_pick(shared_tab, dataset):
    shared_tab.click((5, 5)).wait_for_update()
    shared_tab.page.focus("#link")
    for _ in range(12):
        shared_tab.page.keyboard.press("Tab")
        if shared_tab.page.evaluate("document.activeElement.id") == "map":
            break
    shared_tab.page.keyboard.press("ArrowRight")
    shared_tab.page.wait_for_function("location.search.includes('cell=6%2C5')", timeout=WAIT)
    assert shared_tab.wait_for_update().heading() == expected_heading(dataset, PICK)
    shared_tab.page.keyboard.press("ArrowDown")
    shared_tab.page.wait_for_function("location.search.includes('cell=6%2C4')", timeout=WAIT)


def test_the_page_fits_400_pixels(shared_tab):
    shared_tab.page.set_viewport_size({"width": 400, "height": 800})
    shared_tab.page.wait_for_function(
        "document.getElementById('map').getBoundingClientRect().width < 400", timeout=WAIT
    )
    # Panels follow the map a moment later.
    shared_tab.page.wait_for_function("document.documentElement.scrollWidth <= 400", timeout=WAIT)
    assert shared_tab.page.evaluate("document.getElementById('map').getBoundingClientRect().width") > 300
    shared_tab.click((4, 6)).wait_for_update()
    assert shared_tab.view()["cell"] == "4,6"
    shared_tab.page.set_viewport_size({"width": 1280, "height": 800})


def axe() -> Path | None:
    """Return the path of axe-core, downloaded by npm if necessary; None if it is not available."""
    folder = Path(os.environ.get("VIJAX_AXE", Path(__file__).parents[2] / ".pytest_cache" / "axe"))
    script = folder / "node_modules/axe-core/axe.min.js"
    npm = shutil.which("npm")
    if not script.is_file() and npm is not None:
        folder.mkdir(parents=True, exist_ok=True)
        line = [npm, "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder), "axe-core@4"]
        subprocess.run(line, capture_output=True, timeout=120)
    return script if script.is_file() else None


def test_elements_have_accessible_names_and_contrast(shared_tab):
    script = axe()
    if script is None:
        pytest.skip("axe-core is not available from npm")
    shared_tab.click(PICK).wait_for_update()
    shared_tab.compute("basin")
    shared_tab.state("basin", "done", "failed")
    shared_tab.page.add_script_tag(path=str(script))
    violations = shared_tab.page.evaluate(
        "async () => (await axe.run()).violations.map((one) => [one.id, one.nodes[0].html])"
    )
    assert violations == []


@pytest.mark.long
def test_growing_store_is_displayed(tab, server):
    """Without the files of a tile its cells are not run; they appear on the open page after the files return."""
    record, chunk = tile(server.store)
    backup = {file: file.read_bytes() for file in (record, *chunk)}
    try:
        for file in backup:
            file.unlink()
        new_tab = tab("?cell=0%2C0&variable=status").wait_for_update()
        assert "not run" in new_tab.page.inner_text("#legend")
        assert "not run this cell yet" in new_tab.page.inner_text("#cellnote")
    finally:
        for file, content in reversed(backup.items()):
            file.write_bytes(content)
    new_tab.page.wait_for_function("!document.getElementById('legend').textContent.includes('not run')", timeout=WAIT)


def test_damaged_store_is_reported_and_the_map_remains(shared_tab, tab, server):
    record, (chunk, *_) = tile(server.store)
    before = chunk.read_bytes()
    try:
        chunk.write_bytes(b"\0" * len(before))
        os.utime(record)
        note_visible = "(note => !note.hidden && note.textContent.includes('cannot be read any more'))"
        shared_tab.page.wait_for_function(f"{note_visible}(document.getElementById('note'))", timeout=WAIT)
        broken = tab()
        broken.page.wait_for_selector("#problem", timeout=WAIT)
        assert "plane.zarr" in broken.page.inner_text("#problem")
    finally:
        chunk.write_bytes(before)
        os.utime(record)
    shared_tab.page.wait_for_selector("#note", state="hidden", timeout=WAIT)


def tile(store: Path) -> tuple[Path, list[Path]]:
    """Return the record of the first tile and its chunks, with the chunk of P first."""
    record = store / "status/tiles/0.json"
    chunks = [store / name for name in json.loads(record.read_text())["files"]]
    return record, sorted(chunks, key=lambda chunk: chunk.parts[-4] != "P")


@pytest.mark.long
def test_lost_server_is_reported_and_reconnects(shared_tab, server):
    shared_tab.click(PICK).wait_for_update()
    heading = shared_tab.heading()
    server.stop()
    shared_tab.page.wait_for_selector("#lost:not([hidden])", timeout=WAIT)
    server.start()
    shared_tab.page.wait_for_function("document.getElementById('lost').hidden", timeout=WAIT)
    shared_tab.page.wait_for_function("document.body.dataset.shown !== undefined", timeout=WAIT)
    assert shared_tab.heading() == heading
