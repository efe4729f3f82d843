"""The pages build without a warning, load nothing from other servers, and show the current program."""

import asyncio
import html
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from nbclient.exceptions import DeadKernelError

import vijax
from docs import executed
from docs.__main__ import main
from vijax.cli.main import vijax as command

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """The built pages. Warnings are errors, also for broken links within the pages."""
    place = tmp_path_factory.mktemp("pages")
    assert main(["--into", str(place)]) == 0
    return place / "html"


class Loads(HTMLParser):
    """Collects the addresses that a browser loads with a page, without the links that a reader may follow."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the addresses that a tag loads."""
        loading = ("src", "srcset", "data", "poster") + (("href",) if tag in ("link", "use", "image", "base") else ())
        self.addresses += [value for name, value in attrs if name in loading and value]


def loaded(file: Path) -> Iterator[str]:
    """Yield the addresses that a page or a style sheet loads."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".html":
        page = Loads()
        page.feed(text)
        yield from page.addresses
    yield from re.findall(r"url\(\s*['\"]?([^'\")]+)", text)
    yield from re.findall(r"@import\s+['\"]([^'\"]+)", text)


def test_nothing_is_loaded_from_other_servers(built):
    files = [*built.rglob("*.html"), *built.rglob("*.css")]
    assert len(files) > 10
    outside = {(file.name, address) for file in files for address in loaded(file) if re.match(r"(?:\w+:)?//", address)}
    assert not outside
    assert (built / "_static/tex-svg.js").stat().st_size > 1e6


def test_addresses_of_other_servers_are_detected(tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        '<a href="https://a.b"><script src="//c.d/e.js"></script><style>@import "https://f.g"; p {url(//h.i)}'
    )
    assert set(loaded(page)) == {"//c.d/e.js", "https://f.g", "//h.i"}


def test_all_public_names_are_on_the_page_of_functions(built):
    text = (built / "reference/functions.html").read_text(encoding="utf-8")
    listed = re.findall(r'<dt class="sig[^>]*id="vijax\.([\w.]+)"', text)
    tops = [name for name in listed if name in set(vijax.__all__) - {"plots"} or name.startswith("plots.")]
    public_names = {name for name in vijax.__all__ if name != "plots"} | {
        f"plots.{name}" for name in vijax.plots.__all__
    }
    assert set(tops) == public_names
    assert len(tops) == len(public_names)


def test_all_options_are_on_the_page_of_the_command(built):
    text = (built / "reference/command.html").read_text(encoding="utf-8")
    for name in command.list_commands(None):
        section = text.partition(f'id="vijax-{name}"')[2].partition("<section")[0]
        options = [
            flag for option in command.get_command(None, name).params for flag in option.opts if flag[:2] == "--"
        ]
        assert not [flag for flag in options if not re.search(rf"{flag}\b", section)], name


def test_no_page_shows_outputs_of_other_code():
    stale = [path.name for path in executed.pages() if executed.stored_outputs(executed.read_page(path)) is None]
    assert not stale, f"{stale} have changed since they were executed: python docs --stale"
    assert not executed.stray()


@pytest.mark.parametrize(("block", "page"), [(0, "start.md"), (1, "tutorials/derivatives.md")])
def test_code_of_the_readme_is_code_of_a_page_with_its_output(block, page):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 120
    blocks = re.findall(r"```python\n(.*?)```", readme, re.S)
    assert len(blocks) == 2
    cells = [
        cell
        for cell in executed.read((executed.HERE / page).read_text(encoding="utf-8")).cells
        if cell.cell_type == "code"
    ]
    source = [line for cell in cells for line in cell.source.splitlines()]
    printed = [output.text.strip() for cell in cells for output in cell.outputs if "text" in output]
    lines = [line for line in blocks[block].splitlines() if line]
    comments = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    assert comments
    assert comments == printed[: len(comments)]
    code = [line for line in lines if not line.startswith("# ")]
    places = [source.index(line) for line in code]
    assert places == sorted(places)


def test_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 15
    assert not [link for link in links if not (ROOT / link).exists()]


def test_a_page_with_changed_code_is_not_built():
    text = (executed.HERE / "start.md").read_text(encoding="utf-8")
    assert executed.read(text).cells
    with pytest.raises(ValueError, match="changed since it was executed"):
        executed.read(text.replace("kappa=", "r=0.5, kappa="))


@pytest.mark.parametrize(
    ("old", "new", "other"),
    [
        ("P = 1.66e-04 J", "P = 1.6601e-04 J", False),
        ("P = 1.66e-04 J", "P = 1.67e-04 J", True),
        ("9,312 cells in 11.56 s, 805 cells/s", "9,312 cells in 3.1 s, 2,904 cells/s", False),
        ("9,312 cells in 11.56 s", "9,313 cells in 11.56 s, 805", True),
        ("status ok", "status slow", True),
        ("[4 1 1]", "[4 1]", True),
    ],
)
def test_outputs_differ_by_words_or_numbers_and_not_by_durations(old, new, other):
    assert executed.differ(old, new) == other


def test_descriptions_of_results_are_not_read_as_types(built):
    """Napoleon reads the words before a colon in the first line as a type."""
    text = (built / "reference/functions.html").read_text(encoding="utf-8")
    assert not re.findall(r"Return type<|>Type<", text)


def test_the_page_of_functions_uses_public_names_and_has_no_repetition(built):
    text = (built / "reference/functions.html").read_text(encoding="utf-8")
    assert "Alias for field" not in text
    assert "Settings(first_step" not in text
    plain = html.unescape(re.sub(r"<[^>]+>", "", text))
    assert "optimise_all" not in plain
    assert "As in follow_orbits. Symmetric orbits" in plain
    assert re.search(r"periods, until, transient, device, dtype, progress, axes.{,9}As in sweep", plain, re.S)
    sentences = [line for line in plain.splitlines() if "Symmetric orbits are reduced to half a" in line]
    assert len(sentences) == 1
    blocks = [html.unescape(re.sub(r"<[^>]+>", "", block)) for block in re.findall(r"<pre>(.*?)</pre>", text, re.S)]
    (example,) = [block for block in blocks if block.startswith("sweep(d=np.linspace")]
    assert len(example.splitlines()) == 4


@pytest.fixture
def executing(monkeypatch, tmp_path):
    """Return a build of the named pages that only executes them, by the specified function."""

    def build(names, execute) -> int:
        monkeypatch.setattr(executed, "pages", lambda: (executed.HERE / name for name in names))
        monkeypatch.setattr(executed, "stray", list)
        monkeypatch.setattr(executed, "execute", execute)
        monkeypatch.setattr("docs.__main__.build_main", lambda _: 0)
        return main(["--execute", "--into", str(tmp_path)])

    return build


def test_execution_ends_with_a_summary_of_the_changes(executing, capsys):
    differences = {"start.md": [], "maps.md": ["kept:\n1\ncame:\n2"]}

    async def execute(page):
        return differences[page.name]

    assert executing(differences, execute) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "executed 2 pages: other outputs than before on maps.md"


def test_a_page_that_fails_is_named_and_the_others_continue(executing, capsys):
    async def execute(page):
        if page.name == "curves.md":
            raise DeadKernelError("it died")
        return []

    assert executing(["start.md", "curves.md"], execute) == 1
    lines = capsys.readouterr().out.splitlines()
    # The longest page starts first.
    assert [line.partition(":")[0] for line in lines[::2]] == ["curves.md", "start.md"]
    assert lines[1] == "failed: it died"
    assert lines[-1] == "executed 2 pages: all outputs as before; failed: curves.md"


def test_ctrl_c_stops_all_pages_without_a_traceback(executing, capsys, monkeypatch):
    monkeypatch.setattr("docs.__main__.AT_ONCE", 2)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for background processes
    ended = []

    async def execute(page):
        try:
            await asyncio.sleep(0.1)
            if page.name == "maps.md":
                os.kill(os.getpid(), signal.SIGINT)
            await asyncio.sleep(10)
            return []
        finally:
            ended.append(page.name)

    try:
        assert executing(["start.md", "maps.md", "data.md"], execute) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(ended) == ["maps.md", "start.md"]
    assert "stopped" in capsys.readouterr().out


# --- as a browser shows them -----------------------------------------------------------------------------------------

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the pages with")


def find_flaws(built: Path, pages: list[str]) -> dict[str, list[str]]:
    """Return the flaws of each page at two widths; a single run of a browser shows all pages in a frame."""
    text = (Path(__file__).parent / "look.html").read_text(encoding="utf-8")
    text = text.replace("PAGES = []", f"PAGES = {json.dumps(pages)}").replace("WIDTHS = []", "WIDTHS = [1280, 400]")
    (built / "look.html").write_text(text, encoding="utf-8")
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--allow-file-access-from-files",
        "--window-size=1400,1000",
    ]
    line = [BROWSER, *options, "--virtual-time-budget=600000", "--dump-dom", (built / "look.html").as_uri()]
    result = subprocess.run(line, capture_output=True, text=True, timeout=300)
    (report,) = re.findall(r'<pre id="found">(.*?)</pre>', result.stdout, re.S)
    return json.loads(html.unescape(report))


@pytest.mark.long
@pytest.mark.browser
@browser
def test_pages_fit_and_show_their_pictures_and_formulas(built):
    pages = sorted(path.relative_to(built).as_posix() for path in built.rglob("*.html") if path.name != "look.html")
    flaws = find_flaws(built, pages)
    assert len(flaws) > 20
    assert {page: flaws_of_page for page, flaws_of_page in flaws.items() if flaws_of_page} == {}


@pytest.mark.browser
@browser
def test_flaws_of_a_page_are_detected(tmp_path):
    (tmp_path / "page.html").write_text(
        '<div style="width: 500px">wide</div><img src="none.png"><span class="math">x</span>'
    )
    flaws = find_flaws(tmp_path, ["page.html"])["page.html"]
    assert [flaw.split()[0] for flaw in flaws] == ["broken", "formula", "508"]
