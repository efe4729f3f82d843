"""`vijax docs`, and the pages that messages name."""

import ast
import re
import webbrowser
from typing import get_args

import pytest

from tests.helpers import SCRIPTS
from vijax.cli import main
from vijax.cli.commands import docs
from vijax.model.records import Status
from vijax.runtime.doc_pages import PageName, see

ROOT = SCRIPTS.parent


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A clone with two built pages."""
    for name in (
        "pyproject.toml",
        "docs/conf.py",
        "docs/build/html/index.html",
        "docs/build/html/reference/status.html",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.setattr(docs, "_CLONE", tmp_path)
    return tmp_path


@pytest.fixture
def browser(monkeypatch):
    """The addresses that a browser opens."""
    addresses = []
    monkeypatch.setattr(webbrowser, "open", lambda address: addresses.append(address) or True)
    return addresses


@pytest.mark.parametrize(("arguments", "file"), [([], "index.html"), (["status"], "reference/status.html")])
def test_docs_opens_a_page_and_prints_its_path(clone, browser, capsys, arguments, file):
    page = clone / "docs/build/html" / file
    assert main.main(["docs", *arguments]) == 0
    assert browser == [page.as_uri()]
    assert capsys.readouterr().out == f"{page}\n"


def test_docs_prints_the_path_of_a_page(clone, browser, capsys):
    assert main.main(["docs", "--where"]) == 0
    assert not browser
    assert capsys.readouterr().out.endswith("index.html\n")


def test_docs_reports_a_missing_browser(clone, monkeypatch, capsys):
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    assert main.main(["docs"]) == 0
    assert "no browser could be opened" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("docs/build/html/index.html", "error: docs must be built first; got none; in "),
        ("docs/conf.py", "error: docs must be built in a clone of the repository; got an installed vijax"),
        ("pyproject.toml", "error: docs must be built in a clone of the repository; got an installed vijax"),
        ("docs/build/html/reference/status.html", "error: page must be one of index; got 'status'"),
    ],
)
def test_missing_pages_are_reported_in_a_single_line(clone, browser, capsys, missing, message):
    (clone / missing).unlink()
    assert main.main(["docs", "status"]) == 2
    assert capsys.readouterr().err.startswith(message)
    assert not browser


def test_docs_and_readme_explain_the_build_alike():
    assert docs._BUILD in " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


# --- pages that messages name ----------------------------------------------------------------------------------------


def named_pages() -> set[str]:
    """Return the pages that messages of the package name."""
    names = set()
    for path in (ROOT / "vijax").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == see.__name__:
                assert isinstance(node.args[0], ast.Constant), path
                names.add(node.args[0].value)
    return names


def test_pages_that_messages_name_exist_once():
    pages = [path.stem for path in (ROOT / "docs").rglob("*.md") if not {"build", "generated"} & set(path.parts)]
    assert named_pages() == set(get_args(PageName))
    assert {name: pages.count(name) for name in named_pages()} == dict.fromkeys(named_pages(), 1)


def test_no_message_names_a_page_in_another_way():
    files = [path for path in (ROOT / "vijax").rglob("*.py") if path.name != "doc_pages.py"]
    assert [path.name for path in files if re.search(r"see docs: ", path.read_text(encoding="utf-8"))] == []
    assert see("status", Status.SLOW.advice).endswith("confirmed aperiodic; see docs: status")


@pytest.mark.parametrize(
    ("line", "page"),
    [
        ("sweep --d 1m --kappa 3", "maps"),
        ("sweep --method rk4 --wall rigid", "methods"),
        ("sweep --workers 2 --plot map.png", "studies"),
        ("branch --impacts RX --along d=0.1:0.3", "attractors"),
        ("design --reliability 99%", "design"),
    ],
)
def test_an_error_names_the_page_that_explains_it(tmp_path, monkeypatch, capsys, line, page):
    monkeypatch.chdir(tmp_path)
    assert main.main(line.split()) == 2
    assert capsys.readouterr().err.endswith(f"; see docs: {page}\n")
