"""The glossary (docs/glossary.md) holds for the code: terms have modules, retired words stay out of names and text."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs/glossary.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in PAGE.splitlines() if line.startswith("| ")]
TERMS = [row for row in ROWS if row[-1].startswith("`") and "/" in row[-1]]
RETIRED = {word for row in ROWS if len(row) == 2 and row[0].startswith("`") for word in re.findall(r"\w+", row[0])}
SOURCES = sorted(
    path for folder in ("vijax", "scripts", "benchmarks", "docs") for path in (ROOT / folder).rglob("*.py")
)

# Phrases of docstrings and comments that hide the subject of a sentence, and their largest rate in 1,000 words.
RATES = {
    r"\bwhat\b": 2.0,
    r"\b(told|tells?|said|says?|asked|asks?)\b": 0.5,
    r"\b(of|to|in|by|from|with|at|on) (which|whom)\b|\bwhose\b": 1.0,
}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def identifiers(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of every function, class, argument, field and variable that a file defines."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id


def words(name: str) -> set[str]:
    return {word.lower() for word in re.split(r"_+|(?<=[a-z])(?=[A-Z])", name.strip("_")) if word}


def prose() -> Iterator[str]:
    """Yield every docstring and comment of the package."""
    for path in SOURCES:
        if ROOT / "vijax" not in path.parents:
            continue
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield ast.get_docstring(node) or ""
        for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
            if token.type == tokenize.COMMENT:
                yield token.string.lstrip("# ")


def test_every_term_has_one_row_and_its_module_exists():
    names = [row[0] for row in TERMS]
    assert len(names) > 60
    assert sorted(names) == sorted(set(names))
    assert [row[-1] for row in TERMS if not (ROOT / "vijax" / row[-1].strip("`")).exists()] == []


def test_retired_words_are_in_no_name():
    assert len(RETIRED) > 60
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in SOURCES
        for line, name in identifiers(path)
        if words(name) & RETIRED
    ]
    assert found == []


def test_no_term_is_a_retired_word():
    assert [row[0] for row in TERMS if row[0] in RETIRED] == []


def test_sentences_name_their_subjects():
    text = "\n".join(prose())
    count = len(text.split())
    assert count > 50_000
    rates = {pattern: 1000 * len(re.findall(pattern, text, re.I)) / count for pattern in RATES}
    assert {pattern: rate for pattern, rate in rates.items() if rate > RATES[pattern]} == {}
