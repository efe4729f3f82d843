"""Figures in prose have a source: a row of a benchmark, printed output, or a list with the command."""

import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import nbformat
import pytest

from docs import executed, measured

ROOT = Path(__file__).parents[2]
LISTED = tomllib.loads((ROOT / "docs/figures.toml").read_text(encoding="utf-8"))
SOURCES = ("command", "setting", "open")
PAGES = ["README.md", *sorted(f"docs/{path.relative_to(ROOT / 'docs')}" for path in (ROOT / "docs").glob("**/*.md"))]
TRACED = [page for page in PAGES if not page.startswith(("docs/build/", "docs/generated/"))]

_NUMBER = r"\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"
_UNITS = (
    r"%|(?:times|us|ms|s|h|min|minutes?|hours?|seconds?|days?|months?|[KMGT]i?B|GB/s|tiles/s|cells/s|bytes|rad/s|uJ|mJ|J|"
    r"m/s|m|mm|cm|Hz|roundings)\b"
)
FIGURE = re.compile(
    rf"(?<![\w.^/:=-])(?:{_NUMBER}(?: (?:to|and|or|against) {_NUMBER})?[ -]?(?:{_UNITS})"
    rf"|(?:\b[Oo]ne|{_NUMBER})(?: \w+)? (?:in|of) {_NUMBER}\b)"
)
_ROW_WITH_COMMAND = re.compile(r"\| (?:`(?:python|bash|time) [^|]*|the same) \|$")


def prose(text: str) -> str:
    """Return a page without its code, formulas and rows of tables that end in the command that prints them."""
    for pattern in (r"^```.*?^```[ ]*$", r"^(?: {4}[^\n]*\n)+", r"\$\$.*?\$\$"):
        text = re.sub(pattern, "", text, flags=re.M | re.S)
    return "\n".join(line for line in text.splitlines() if not _ROW_WITH_COMMAND.search(line))


def figures(text: str) -> Iterator[re.Match[str]]:
    """Yield numbers with a unit, and shares such as 1 in 100, outside of code."""
    for match in FIGURE.finditer(text):
        if text[: match.start()].rpartition("\n")[2].count("`") % 2 == 0:
            yield match


@cache
def texts_of_rows() -> list[str]:
    """Return the texts that pages show for rows of benchmarks."""
    return list(measured.texts().values())


def printed(page: str) -> str:
    """Return the texts of rows and the output of the page's code; the README has the code of the page `start`."""
    name = "start" if page == "README.md" else "-".join(Path(page).relative_to("docs").with_suffix("").parts)
    texts = [*texts_of_rows()]
    for file in executed.OUTPUTS.glob(f"{name}-????????????.ipynb"):
        for cell in nbformat.read(file, as_version=4).cells:
            texts += [output.get("text") or output.get("data", {}).get("text/plain", "") for output in cell.outputs]
    return " ".join(" ".join(texts).split())


def listed(page: str, text: str) -> list[tuple[int, int]]:
    """Return the places on a page of the texts of the list."""
    texts = [item["text"] for item in LISTED["figure"] if item["page"] == page.removeprefix("docs/")]
    return [(at.start(), at.end()) for item in texts for at in re.finditer(re.escape(item), text)]


def untraced(page: str, text: str) -> list[str]:
    """Return the figures of a page that have no source."""
    if any(entry["page"] == page.removeprefix("docs/") for entry in LISTED["page"]):
        return []
    text, output = prose(text), printed(page)
    spans = listed(page, text)
    return [
        match[0]
        for match in figures(text)
        if not any(low <= match.start() and match.end() <= high for low, high in spans)
        and not re.search(rf"(?<![\d.]){re.escape(' '.join(match[0].split()))}(?!\w)", output)
    ]


@pytest.mark.parametrize("page", TRACED)
def test_all_figures_have_a_source(page):
    assert untraced(page, (ROOT / page).read_text(encoding="utf-8")) == []


def test_a_figure_without_a_source_is_detected():
    text = "It takes 3.25 s:\n\n    6 s\n\n`4 s` of code, 17 % more, in one cell of 77.\n| a | 5 ms | `python a.py` |\n"
    assert untraced("docs/maps.md", text) == ["3.25 s", "17 %", "one cell of 77"]


@pytest.mark.parametrize(
    "entry", [*LISTED["figure"], *LISTED["page"]], ids=lambda entry: entry.get("text", entry["page"])
)
def test_a_listed_figure_is_on_its_page_and_has_a_source(entry):
    (source,) = [name for name in SOURCES if name in entry]
    page = (ROOT / "docs" / entry["page"]).read_text(encoding="utf-8")
    assert entry.get("text", "") in page
    if source != "open":
        (file,) = re.findall(r"[\w/-]+\.(?:py|md|sh)", entry[source])
        assert (ROOT / file).exists()
