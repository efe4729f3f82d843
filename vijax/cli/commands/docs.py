"""`vijax docs`: open the built documentation in a browser, print its path, or explain how to build it."""

import webbrowser
from pathlib import Path

import click

from vijax.cli import process
from vijax.cli.page import Page

_CLONE = Path(__file__).parents[3]
_BUILD = ".venv/bin/pip install -q -c constraints.txt -e '.[docs]' && .venv/bin/python docs"


def open_page(page: str, where: bool) -> None:
    """Open the pages of vijax in a browser."""
    with process.usage_errors():
        file = _file(page, _CLONE)
    click.echo(str(file))
    if not where and not webbrowser.open(file.as_uri()):
        click.echo("no browser could be opened: open that file in one", err=True)


def _file(name: str, clone: Path) -> Path:
    """Return the path of a built page.

    Args:
        name: File name of the page without its extension.
        clone: Folder of the clone of the repository.

    Raises:
        FileNotFoundError: If the documentation is not built, or vijax is not a clone of the repository.
        ValueError: If there is no such page.
    """
    # These two files identify a clone: next to an installed vijax, a folder `docs` may belong to another package.
    if not all((clone / file).is_file() for file in ("pyproject.toml", "docs/conf.py")):
        raise FileNotFoundError("docs must be built in a clone of the repository; got an installed vijax, without them")
    built = clone / "docs/build/html"
    if not (built / "index.html").is_file():
        sources = clone / "docs"
        raise FileNotFoundError(f"docs must be built first; got none; in {clone} run {_BUILD}, or read {sources}/*.md")
    pages = {file.stem: file for file in built.rglob("*.html") if "_static" not in file.parts}
    if name not in pages:
        raise ValueError(f"page must be one of {', '.join(sorted(pages))}; got {name!r}")
    return pages[name]


# --- the page --------------------------------------------------------------------------------------------------------

docs = Page(
    "docs",
    open_page,
    {
        "Pages": [
            click.Argument(["page"], default="index", metavar="[PAGE]"),
            click.Option(["--where"], is_flag=True, help="print the path, and open nothing"),
        ]
    },
    examples=["", "status", "status --where"],
    epilog="PAGE is the word that messages name after `see docs:`, and the front page unless given.",
)
