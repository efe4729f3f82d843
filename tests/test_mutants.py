"""`scripts/mutants.py` draws changes of one line, and separates detected from undetected changes."""

import ast
from collections import Counter

import pytest

from scripts import mutants
from scripts.tests_for import DependentFile

SOURCE = '''"""A text with 3 in it."""

LIMIT = 3.0


def gap(low: float = 1.0, high: int = 2) -> float:
    if low < 0:
        raise ValueError(f"low must be at least {0}")
    return -larger(low - LIMIT, high) + max(low, high)
'''


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    path = tmp_path / "gap.py"
    path.write_text(SOURCE)
    return path


def test_only_lines_that_compute_are_changed(file):
    changes = [(change.kind, change.new.strip()) for change in mutants.mutants(file)]
    result = "return -larger(low - LIMIT, high) + max(low, high)"
    assert sorted(changes) == sorted(
        [
            ("constant", "LIMIT = 3.3000000000000003"),
            ("comparison", "if low <= 0:"),
            ("constant", "if low < 1:"),
            ("sign", result.replace("-larger", "larger")),
            ("sign", result.replace("low - LIMIT", "low + LIMIT")),
            ("sign", result.replace(") + max", ") - max")),
            ("arguments", result.replace("low - LIMIT, high", "high, low - LIMIT")),
        ]
    )


def test_a_draw_is_the_same_for_a_seed_and_has_all_kinds():
    paths = sorted((mutants.Path(mutants.ROOT) / "vijax/model").glob("*.py"))
    drawn = mutants.draw(paths, 40, seed=0)
    assert drawn == mutants.draw(paths, 40, seed=0)
    assert drawn != mutants.draw(paths, 40, seed=1)
    assert len({(change.path, change.line) for change in drawn}) == 40
    assert min(Counter(change.kind for change in drawn).values()) >= 9
    for change in drawn:
        lines = (mutants.ROOT / change.path).read_text().split("\n")
        assert lines[change.line - 1] == change.old != change.new
        lines[change.line - 1] = change.new
        ast.parse("\n".join(lines))


TESTS = {
    "noticed": ("def test_limit():\n    assert LIMIT == 3.0\n", "FAILED test_gap.py::test_limit"),
    "not noticed": ("def test_limit():\n    assert LIMIT > 3.0\n", ""),
    "no test to run": ("", ""),
}


@pytest.mark.parametrize(("tests", "caught_by"), TESTS.values(), ids=TESTS)
def test_a_mutant_is_caught_by_the_first_test_that_fails_and_is_undone(file, monkeypatch, tmp_path, tests, caught_by):
    (tmp_path / "test_gap.py").write_text(f"from gap import LIMIT\n\n\n{tests}")
    (tmp_path / "test_more.py").write_text("def test_more():\n    pass\n")
    files = [DependentFile("test_gap.py", 1, 0.0), DependentFile("test_more.py", 2, 500.0)]
    monkeypatch.setattr(mutants, "dependent_files", lambda module: files)
    (mutant,) = [change for change in mutants.mutants(file) if change.line == 3]
    outcome = mutants.run(mutant, tmp_path, most_seconds=100.0)
    assert outcome.caught_by == caught_by
    assert outcome.files == 1
    assert file.read_text() == SOURCE


def test_expected_survivors_are_changes_of_existing_lines():
    for path, old, new in mutants.expected_survivors():
        lines = [line.strip() for line in (mutants.ROOT / path).read_text().split("\n")]
        assert old in lines
        assert old != new
