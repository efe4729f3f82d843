"""The page in a real browser: one server and one Chromium for the whole file."""

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
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed to look at the page with"),
]
WAIT = 120_000  # milliseconds: a program may be compiled first, on a machine that does other things
# Mostly 1:1 orbits: each size of orbits that the map has is compiled ahead.
AXES = {"d": np.linspace(0.2, 0.3, 8), "kappa": np.geomspace(50.0, 400.0, 8)}
PICK = (6, 5)  # a 1:1 orbit, the same for every test
ORBITS = "<i>1:1</i>"  # of the curves, as a store may say it that wants to be more than text


class ServedStore:
    """A process that serves a store and the curves beside it, as a shell would start it."""

    def __init__(self, store: Path) -> None:
        self.store, self.page, self.port = store, "", 0
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it, on the port that it had, and wait until it says where its page is."""
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
        """End it as Ctrl-C does not: at once."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """The map that is served, in its store."""
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
    """The context of all pages: what the first one has loaded, the others need not load again."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True)
        made.close()


# Presses a button as soon as it is there: a job may be done before a hand is at it.
PRESS = """(selector) => {
    const press = (_, seen) => {
        const stop = document.querySelector(selector);
        if (stop && !stop.hidden) { seen.disconnect(); stop.click(); }
    };
    new MutationObserver(press).observe(document.body, { attributes: true, childList: true, subtree: true });
}"""


class Tab:
    """A page in the browser, with all that it asked for and complained of."""

    def __init__(self, browser, address: str) -> None:
        self.page = browser.new_page()
        self.errors: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)

    def shown(self) -> "Tab":
        """Wait until what was asked for last is on the screen."""
        self.page.wait_for_function(
            "document.body.dataset.shown !== undefined && +document.body.dataset.shown >= vijax.number", timeout=WAIT
        )
        return self

    def place(self, pick: tuple[int, int]) -> tuple[float, float]:
        """Find where a cell of the map is on the screen."""
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
        """Read what the page says of the picked cell."""
        return self.page.inner_text("#heading")

    def view(self) -> dict[str, str]:
        """Read the address."""
        return dict(parse_qsl(urlsplit(self.page.url).query))

    def compute(self, name: str) -> None:
        """Ask for a panel."""
        self.page.click(f'.compute[data-name="{name}"]')

    def state(self, name: str, *states: str) -> str:
        """Wait until a panel is in one of some states, and give its text."""
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
    for one in opened:
        one.page.close()


@pytest.fixture(scope="module")
def one(server, browser) -> Iterator[Tab]:
    """The page that most tests share, each of which begins by a pick: to load one takes a browser seconds."""
    made = Tab(browser, server.page)
    yield made.shown()
    made.page.close()


def said_of(dataset, pick: tuple[int, int], **moved: float) -> str:
    """What the page's heading has to be, by a sweep of that cell alone."""
    place = {name: float(values[index]) for (name, values), index in zip(AXES.items(), pick, strict=True)}
    found = vijax.sweep(**(place | {"r": 0.5, "gamma": 0.0} | moved))
    word = label(found["period"], found["impacts_left"], found["impacts_right"], found["status"])
    return f"{word}, P = {float(found['P']):.6g} J"


def test_the_first_load_is_clean_and_asks_nobody_but_this_machine(one):
    assert one.errors == []
    assert {urlsplit(url).hostname for url in one.asked if not url.startswith("data:")} == {"127.0.0.1"}
    assert len(one.asked) > 3


def test_a_click_shows_what_a_sweep_of_that_cell_gives(one, dataset):
    for pick in (PICK, (2, 6), (7, 0)):
        one.click(pick).shown()
        assert one.heading() == said_of(dataset, pick)
        assert one.view()["cell"] == f"{pick[0]},{pick[1]}"


def test_a_drag_picks_the_cells_that_it_passes(one, dataset):
    one.page.mouse.move(*one.place((3, 6)))
    one.page.mouse.down()
    for column in (4, 5, 6):
        one.page.mouse.move(*one.place((column, 6)), steps=3)
    one.page.mouse.up()
    one.shown()
    assert one.heading() == said_of(dataset, (6, 6))


def test_a_second_click_within_300_ms_counts(one, dataset):
    first, second = one.place((2, 6)), one.place(PICK)
    one.page.mouse.click(*first)
    one.page.mouse.click(*second)
    one.page.wait_for_function(f"location.search.includes('cell={PICK[0]}%2C{PICK[1]}')", timeout=WAIT)
    assert one.shown().heading() == said_of(dataset, PICK)


@pytest.mark.long
def test_a_slider_changes_the_motion_and_a_plane_of_its_value_is_made(tab, dataset):
    one = tab().shown().click(PICK).shown()
    one.page.fill('[data-name="r"] input[type="number"]', "0.6")
    one.page.keyboard.press("Enter")
    one.page.wait_for_function("location.search.includes('r=0.6')", timeout=WAIT)
    assert one.shown().heading() == said_of(dataset, PICK, r=0.6)
    one.page.evaluate(PRESS, "[data-panel='plane'] button")
    one.page.click("#make")
    assert "Cancelled" in one.state("plane", "cancelled", "done", "failed")
    # A plane beyond a million cells is made if the answer is yes; test_page has when the server asks.
    for answer in ("dismiss", "accept"):
        one.page.once("dialog", lambda asked, answer=answer: getattr(asked, answer)())
        one.page.evaluate("vijax.told({ section: 'ask', text: 'This plane has 1,001,000 cells. Make it?' })")
        if answer == "dismiss":
            one.page.wait_for_timeout(300)
            assert "Cancelled" in one.page.inner_text("[data-panel='plane']")
    assert "The map is of these values" in one.state("plane", "done", "failed")
    assert "their r is 0.5, here it is 0.6" in one.page.inner_text("#curvenote")


def test_a_value_beyond_its_bounds_is_refused_in_a_line(one, dataset):
    one.click(PICK).shown()
    one.page.fill('[data-name="r"] input[type="number"]', "7")
    one.page.keyboard.press("Enter")
    one.page.wait_for_selector("#note:not([hidden])", timeout=WAIT)
    assert "r must lie between 0.05 and 1 on this page; got 7" in one.page.inner_text("#note")
    assert one.heading() == said_of(dataset, PICK)


@pytest.mark.long
def test_basin_and_branch_are_computed_on_demand_and_cancelled(one):
    one.click(PICK).shown()
    one.compute("basin")
    assert "1:1" in one.state("basin", "done", "failed")
    one.compute("branch")
    assert "The branch has" in one.state("branch", "done", "failed")
    assert one.view()["open"] == "basin,branch"
    one.page.evaluate(PRESS, '.cancel[data-name="basin"]')
    one.compute("basin")
    assert "Cancelled" in one.state("basin", "cancelled")


def test_pictures_are_saved(one):
    one.click(PICK).shown()
    for what, format, begins in (("map", "PNG", b"\x89PNG"), ("motion", "PDF", b"%PDF"), ("motion", "SVG", b"<?xml")):
        with one.page.expect_download(timeout=WAIT) as download:
            one.page.click(f'.files[data-what="{what}"] >> text={format}')
        assert Path(download.value.path()).read_bytes().startswith(begins)
        assert download.value.suggested_filename == f"{what}.{format.lower()}"


def test_the_address_restores_the_view(tab, dataset):
    one = tab("?variable=label&cell=6%2C5&along=d&r=0.6&open=basin&curves=unstable").shown()
    assert "1:1" in one.state("basin", "done", "failed")
    assert one.page.input_value("#variable") == "label"
    assert one.page.input_value("#along") == "d"
    assert one.page.input_value("#curves") == "unstable"
    assert "grazing" in one.page.inner_text("#curvelegend")
    assert one.page.input_value('[data-name="r"] input[type="number"]') == "0.6"
    assert one.heading() == said_of(dataset, PICK, r=0.6)
    asked = {"variable": "label", "cell": "6,5", "along": "d", "r": "0.6", "open": "basin", "curves": "unstable"}
    assert one.view() | asked == one.view()


def test_what_an_address_cannot_say_is_said_as_text(tab):
    one = tab("?variable=<img src=x onerror=alert(1)>").shown()
    assert "variable must be among" in one.page.inner_text("#note")
    assert one.page.query_selector("#note img") is None


def red(one: Tab) -> int:
    """Count the pixels of the map that have the colour of a fold."""
    shot = imread(BytesIO(one.page.locator("#map").screenshot()))[..., :3]
    return int((np.abs(255 * shot - [0xD6, 0x27, 0x28]).max(axis=2) < 12).sum())


@pytest.mark.long
def test_curves_lie_over_the_map_are_told_and_can_be_hidden(one):
    one.click((5, 6)).shown()
    assert f"fold of {ORBITS}" in one.page.inner_text("#rows")
    assert one.page.inner_text("#curvelegend").split() == ["fold", "1"]
    there = red(one)
    assert there > 100
    left, top = one.place((0, 6))
    across = AXES["d"][1] - AXES["d"][0]
    one.page.mouse.move(left + (one.place((1, 6))[0] - left) * (FOLD_AT - AXES["d"][0]) / across, top)
    one.page.wait_for_selector(f"text=fold of {ORBITS}", timeout=WAIT)
    one.page.select_option("#curves", "unstable")
    one.page.wait_for_function("document.getElementById('curvelegend').textContent.includes('grazing')", timeout=WAIT)
    one.page.select_option("#curves", "hidden")
    one.page.wait_for_function("location.search.includes('curves=hidden')", timeout=WAIT)
    one.page.wait_for_function("document.getElementById('curvelegend').children.length === 0", timeout=WAIT)
    one.page.wait_for_timeout(200)
    assert red(one) < there / 10
    one.page.select_option("#curves", "shown")
    one.page.wait_for_function("!location.search.includes('curves')", timeout=WAIT)


@pytest.mark.long
def test_two_tabs_do_not_disturb_each_other(one, tab, dataset):
    other = tab().shown()
    one.click(PICK)
    other.click((2, 6))
    assert one.shown().heading() == said_of(dataset, PICK)
    assert other.shown().heading() == said_of(dataset, (2, 6))
    one.click((3, 6)).shown()
    assert other.heading() == said_of(dataset, (2, 6))


def test_the_keyboard_alone_moves_the_pick(one, dataset):
    one.click((5, 5)).shown()
    one.page.focus("#link")
    for _ in range(12):
        one.page.keyboard.press("Tab")
        if one.page.evaluate("document.activeElement.id") == "map":
            break
    one.page.keyboard.press("ArrowRight")
    one.page.wait_for_function("location.search.includes('cell=6%2C5')", timeout=WAIT)
    assert one.shown().heading() == said_of(dataset, PICK)
    one.page.keyboard.press("ArrowDown")
    one.page.wait_for_function("location.search.includes('cell=6%2C4')", timeout=WAIT)


def test_the_page_fits_400_pixels(one):
    one.page.set_viewport_size({"width": 400, "height": 800})
    one.page.wait_for_function("document.getElementById('map').getBoundingClientRect().width < 400", timeout=WAIT)
    # Panels follow the map a moment later.
    one.page.wait_for_function("document.documentElement.scrollWidth <= 400", timeout=WAIT)
    assert one.page.evaluate("document.getElementById('map').getBoundingClientRect().width") > 300
    one.click((4, 6)).shown()
    assert one.view()["cell"] == "4,6"
    one.page.set_viewport_size({"width": 1280, "height": 800})


def axe() -> Path | None:
    """Find axe-core where npm has put it, or let npm fetch it."""
    folder = Path(os.environ.get("VIJAX_AXE", Path(__file__).parents[2] / ".pytest_cache" / "axe"))
    script = folder / "node_modules/axe-core/axe.min.js"
    npm = shutil.which("npm")
    if not script.is_file() and npm is not None:
        folder.mkdir(parents=True, exist_ok=True)
        line = [npm, "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder), "axe-core@4"]
        subprocess.run(line, capture_output=True, timeout=120)
    return script if script.is_file() else None


def test_screen_readers_find_names_and_colours_have_contrast(one):
    script = axe()
    if script is None:
        pytest.skip("axe-core is not had from npm here")
    one.click(PICK).shown()
    one.compute("basin")
    one.state("basin", "done", "failed")
    one.page.add_script_tag(path=str(script))
    found = one.page.evaluate("async () => (await axe.run()).violations.map((one) => [one.id, one.nodes[0].html])")
    assert found == []


@pytest.mark.long
def test_a_store_that_is_written_is_shown_as_it_grows(tab, server):
    """A tile that is not done yet: its cells are not run, and come while the page is open."""
    record, chunk = tile(server.store)
    kept = {file: file.read_bytes() for file in (record, *chunk)}
    try:
        for file in kept:
            file.unlink()
        one = tab("?cell=0%2C0&variable=status").shown()
        assert "not run" in one.page.inner_text("#legend")
        assert "not run this cell yet" in one.page.inner_text("#cellnote")
    finally:
        for file, content in reversed(kept.items()):
            file.write_bytes(content)
    one.page.wait_for_function("!document.getElementById('legend').textContent.includes('not run')", timeout=WAIT)


def test_a_store_that_is_damaged_is_told_and_the_map_stays(one, tab, server):
    record, (chunk, *_) = tile(server.store)
    before = chunk.read_bytes()
    try:
        chunk.write_bytes(b"\0" * len(before))
        os.utime(record)
        shown = "(note => !note.hidden && note.textContent.includes('cannot be read any more'))"
        one.page.wait_for_function(f"{shown}(document.getElementById('note'))", timeout=WAIT)
        broken = tab()
        broken.page.wait_for_selector("#problem", timeout=WAIT)
        assert "plane.zarr" in broken.page.inner_text("#problem")
    finally:
        chunk.write_bytes(before)
        os.utime(record)
    one.page.wait_for_selector("#note", state="hidden", timeout=WAIT)


def tile(store: Path) -> tuple[Path, list[Path]]:
    """Find the record of the first tile and its chunks, that of P first."""
    record = store / "status/tiles/0.json"
    chunks = [store / name for name in json.loads(record.read_text())["files"]]
    return record, sorted(chunks, key=lambda chunk: chunk.parts[-4] != "P")


@pytest.mark.long
def test_a_server_that_is_lost_is_told_and_comes_back(one, server):
    one.click(PICK).shown()
    said = one.heading()
    server.stop()
    one.page.wait_for_selector("#lost:not([hidden])", timeout=WAIT)
    server.start()
    one.page.wait_for_function("document.getElementById('lost').hidden", timeout=WAIT)
    one.page.wait_for_function("document.body.dataset.shown !== undefined", timeout=WAIT)
    assert one.heading() == said
