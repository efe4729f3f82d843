"""Outputs of the pages' code: executed by one command, stored in the repository by digest, shown by the build.

The cells of a page run in one kernel, in an empty folder. Their outputs are stored in `outputs/PAGE-DIGEST.ipynb`. The
digest is computed from their code, so a page with changed code has no outputs until it is executed again.
"""

import hashlib
import math
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import nbformat
from myst_nb.core.read import read_myst_markdown_notebook
from nbclient import NotebookClient
from nbformat import NotebookNode

HERE = Path(__file__).parent
OUTPUTS = HERE / "outputs"
RELATIVE = 1e-3
"""Largest relative change of a printed number that does not count as another result. Averages over chaos change by
their standard errors if another machine rounds differently; on the pages these errors are smaller."""
STORED_KINDS = ("text/plain", "image/png")
"""Kinds of outputs that are stored. Datasets and tables also have a plain form, which is readable in a diff."""

# Pictures are as small as possible while legible. A warning is shown without the path of the machine that ran the page.
_SETUP = """
import warnings
get_ipython().run_line_magic("matplotlib", "inline")
get_ipython().run_line_magic("config", "InlineBackend.rc = {'figure.dpi': 80}")
warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\\n"
"""
_CELL_SECONDS = 300  # a cell that takes longer hangs
# Without stored programs, each takes at least half a minute. The first page compiles the programs that several need.
_LONGEST = ("curves.md", "design.md", "failures.md", "derivatives.md", "stiffness.md", "power-drop.md")
_NUMBER = re.compile(r"[-+]?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?")
# Durations and rates differ between runs, and so do the spaces that align them.
_TIMES = re.compile(r"[\d.,]+ ?(?:s|ms|us|min)\b|[\d.,]+k? ?\w+/s\b|\s+")


def pages() -> Iterator[Path]:
    """Yield the pages that have cells."""
    for path in sorted(HERE.rglob("*.md")):
        if not {"build", "generated"} & set(path.relative_to(HERE).parts) and _cells(read_page(path)):
            yield path


def changed() -> Iterator[Path]:
    """Yield the pages with code that has changed since its execution."""
    return (path for path in pages() if stored_outputs(read_page(path)) is None)


def read_page(path: Path) -> NotebookNode:
    """Read a page as a notebook without outputs."""
    return read_myst_markdown_notebook(path.read_text(encoding="utf-8"), add_source_map=True)


def read(text: str) -> NotebookNode:
    """Read a page as a notebook with its stored outputs, for MyST-NB.

    Raises:
        ValueError: A page has cells and no outputs.
    """
    notebook = read_myst_markdown_notebook(text, add_source_map=True)
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "ipython3"}
    if _cells(notebook):
        if (path := stored_outputs(notebook)) is None:
            raise ValueError("the code of this page has changed since it was executed; run python docs --execute")
        for cell, old in zip(_cells(notebook), _cells(nbformat.read(path, as_version=4)), strict=True):
            cell.outputs = old.outputs
    return notebook


def stored_outputs(notebook: NotebookNode) -> Path | None:
    """Return the file with the outputs of a page; None if its code has changed since."""
    return next(OUTPUTS.glob(f"*-{_digest(notebook)}.ipynb"), None)


def longest_first(paths: Iterable[Path]) -> list[Path]:
    """Sort pages so that the long ones start first."""
    long = dict(zip(_LONGEST, range(len(_LONGEST)), strict=True))
    return sorted(paths, key=lambda path: long.get(path.name, len(long)))


def stray() -> list[Path]:
    """Return the files of outputs that belong to no current page."""
    return sorted(set(OUTPUTS.glob("*.ipynb")) - {stored_outputs(read_page(path)) for path in pages()})


async def execute(path: Path) -> list[str]:
    """Execute the cells of a page, store their outputs, and return the differences from the outputs stored before.

    Pictures are stored again, but not compared: pixels differ between versions of fonts.

    Raises:
        CellControlSignal: A cell raised, or took too long; the stored outputs do not change.
        DeadKernelError: The kernel ended.
    """
    fresh = read_page(path)
    before = stored_outputs(fresh)
    fresh.cells.insert(0, nbformat.v4.new_code_cell(_SETUP))
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        await NotebookClient(fresh, timeout=_CELL_SECONDS, kernel_name="python3", resources=place).async_execute()
    del fresh.cells[0]
    for cell in _cells(fresh):
        cell.outputs = [_plain(output) for output in _joined(cell.outputs)]
    differences = []
    if before is not None:
        pairs = zip(_cells(nbformat.read(before, as_version=4)), _cells(fresh), strict=True)
        differences = [text for old, new in pairs for text in _differences(old, new)]
        if not differences:
            return []
    _keep(fresh, path)
    return differences


def differ(old: str, new: str) -> bool:
    """Return True if two printed texts differ in their words, or in a number by more than `RELATIVE`."""
    old, new = _TIMES.sub(" ", old), _TIMES.sub(" ", new)
    if _NUMBER.sub("0", old) != _NUMBER.sub("0", new):
        return True
    numbers = zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    return any(not _close(float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in numbers)


def _close(old: float, new: float) -> bool:
    return math.isclose(old, new, rel_tol=RELATIVE)


def _cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def _digest(notebook: NotebookNode) -> str:
    code = "\0".join(cell.source for cell in _cells(notebook))
    return hashlib.sha256(code.encode()).hexdigest()[:12]


def _keep(notebook: NotebookNode, page: Path) -> None:
    name = "-".join(page.relative_to(HERE).with_suffix("").parts)
    for old in OUTPUTS.glob(f"{name}-????????????.ipynb"):
        old.unlink()
    notebook.cells = _cells(notebook)
    for number, cell in enumerate(notebook.cells):
        # Values that change with each execution would be noise in a diff.
        cell.update(id=str(number), execution_count=None, metadata={})
    notebook.metadata = nbformat.from_dict({})
    OUTPUTS.mkdir(exist_ok=True)
    nbformat.write(notebook, OUTPUTS / f"{name}-{_digest(notebook)}.ipynb")


def _joined(outputs: list[NotebookNode]) -> Iterator[NotebookNode]:
    """Join the pieces of each stream, as the number of pieces differs between runs."""
    streams: dict[str, NotebookNode] = {}
    for output in outputs:
        if output.output_type != "stream":
            yield output
        elif output.name in streams:
            streams[output.name].text += output.text
        else:
            streams[output.name] = output
            yield output


def _plain(output: NotebookNode) -> NotebookNode:
    if "data" in output:
        output.data = nbformat.from_dict({kind: output.data[kind] for kind in STORED_KINDS if kind in output.data})
        if "image/png" in output.data:
            output.data.pop("text/plain", None)  # it only states that there is a figure
        output.metadata = nbformat.from_dict({})
    if "execution_count" in output:
        output.execution_count = None
    return output


def _differences(old: NotebookNode, new: NotebookNode) -> Iterator[str]:
    before, now = _texts(old), _texts(new)
    if len(before) != len(now):
        yield f"{len(before)} outputs were kept, {len(now)} came:\n{new.source}"
    for old_text, new_text in zip(before, now, strict=False):
        if differ(old_text, new_text):
            yield f"kept:\n{old_text}\ncame:\n{new_text}"


def _texts(cell: NotebookNode) -> list[str]:
    """Return the text of each output; for a picture, a placeholder."""
    return [output.get("text") or output.get("data", {}).get("text/plain", "a picture") for output in cell.outputs]
