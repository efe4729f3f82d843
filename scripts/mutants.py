"""Change one line of the package at a time, run the tests that depend on it, and print the undetected changes.

    python scripts/mutants.py                                   # 200 changes, seed 0, on two workers
    python scripts/mutants.py --count 20 --only vijax/orbits    # of one folder or file
    python scripts/mutants.py --list                            # print the changes and run nothing

A change, or mutant, flips a sign, alters a constant, moves the border of a comparison or swaps two arguments. Each is
made in a copy of the repository; the test files that depend on the module run there, nearest and cheapest first
(`scripts/tests_for.py`), until one fails. A mutant that survives indicates code without a test, or a change without
effect; `tests/mutants.toml` lists the second kind with the reason.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from scripts.tests_for import ROOT, dependent_files

_LAYERS = ("model", "impact", "simulation", "orbits", "continuation", "design", "maps")
FOLDERS = tuple(f"vijax/{name}" for name in _LAYERS)
EXPECTED_SURVIVORS = ROOT / "tests/mutants.toml"
_SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}
_COMPARISONS = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
}
# Functions with a result independent of the order of the arguments, and functions of non-numeric arguments.
_SYMMETRIC = {
    "maximum",
    "minimum",
    "max",
    "min",
    "hypot",
    "logical_and",
    "logical_or",
    "isinstance",
    "getattr",
    "setattr",
}
_PASSED, _NO_TESTS = 0, 5  # exit statuses of pytest; a file of long tests has no test to run


class Mutant(NamedTuple):
    """A change of one line.

    Attributes:
        path: Path of the file, relative to the root of the repository.
        line: Number of the line.
        kind: "sign", "constant", "comparison" or "arguments".
        old: The line as it is.
        new: The line after the change.
    """

    path: str
    line: int
    kind: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line} {self.kind}: {self.old.strip()} -> {self.new.strip()}"


class Outcome(NamedTuple):
    """Outcome of the tests of a mutant.

    Attributes:
        mutant: The change.
        caught_by: The first test that failed; "" if none did.
        seconds: Time of its tests.
        files: Number of test files that ran.
    """

    mutant: Mutant
    caught_by: str
    seconds: float
    files: int


# --- mutants ---------------------------------------------------------------------------------------------------------


def mutants(path: Path) -> list[Mutant]:
    """Return every change that can be made to one file, in the order of its lines."""
    text = path.read_text(encoding="utf-8")
    lines, relative = text.splitlines(), path.relative_to(ROOT).as_posix()
    changes = []
    for node in _numeric(ast.parse(text)):
        for kind, start, end, new in _changes(node, lines):
            line = lines[node.lineno - 1]
            changes.append(Mutant(relative, node.lineno, kind, line, line[:start] + new + line[end:]))
    return changes


def draw(paths: Iterable[Path], count: int, seed: int) -> list[Mutant]:
    """Return mutants drawn at random, balanced between kinds, at most one per line."""
    by_kind: dict[str, list[Mutant]] = {}
    for path in paths:
        for mutant in mutants(path):
            by_kind.setdefault(mutant.kind, []).append(mutant)
    generator = random.Random(seed)
    for of_kind in by_kind.values():
        generator.shuffle(of_kind)
    drawn: dict[tuple[str, int], Mutant] = {}
    while len(drawn) < count and any(by_kind.values()):
        for of_kind in by_kind.values():
            if of_kind and len(drawn) < count:
                mutant = of_kind.pop()
                drawn.setdefault((mutant.path, mutant.line), mutant)
    return list(drawn.values())


def _numeric(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield the expressions of a file that compute, without annotations, decorators, errors and texts."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.arguments | ast.Assert):
            continue
        if isinstance(node, ast.AnnAssign):
            if node.value is not None:
                yield from _with_children(node.value)
            continue
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            for statement in node.body:
                yield from _numeric(ast.Module([statement], []))
            continue
        yield from _with_children(node)


def _with_children(node: ast.AST) -> Iterator[ast.expr]:
    if isinstance(node, ast.expr) and node.lineno == node.end_lineno:
        yield node
    yield from _numeric(node)


def _changes(node: ast.expr, lines: list[str]) -> Iterator[tuple[str, int, int, str]]:
    """Yield the changes of one expression: kind, first and last column that are replaced, and the new text."""
    line = lines[node.lineno - 1]
    if not line.isascii():  # columns of `ast` count bytes
        return
    if isinstance(node, ast.BinOp) and type(node.op) in _SIGNS:
        yield from _operator("sign", line, node.left, node.right, *_SIGNS[type(node.op)])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", node.col_offset, node.operand.col_offset, ""
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in _COMPARISONS:
        yield from _operator("comparison", line, node.left, node.comparators[0], *_COMPARISONS[type(node.ops[0])])
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        new = repr(node.value + 1 if isinstance(node.value, int) else 1.1 * node.value or 0.1)
        yield "constant", node.col_offset, int(node.end_col_offset or 0), new
    elif isinstance(node, ast.Call) and _name(node.func) not in _SYMMETRIC:
        for first, second in zip(node.args, node.args[1:], strict=False):
            old = [line[item.col_offset : item.end_col_offset] for item in (first, second)]
            if old[0] != old[1] and not any(isinstance(item, ast.Starred | ast.Lambda) for item in (first, second)):
                between = line[first.end_col_offset : second.col_offset]
                yield "arguments", first.col_offset, int(second.end_col_offset or 0), old[1] + between + old[0]


def _operator(
    kind: str, line: str, left: ast.expr, right: ast.expr, old: str, new: str
) -> Iterator[tuple[str, int, int, str]]:
    """Yield the change of an operator between two operands, if it is unambiguous among brackets next to it."""
    start, end = int(left.end_col_offset or 0), right.col_offset
    if line[start:end].count(old) == 1:
        place = line.index(old, start)
        yield kind, place, place + len(old), new


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


# --- outcomes --------------------------------------------------------------------------------------------------------


def run(mutant: Mutant, copy: Path, most_seconds: float) -> Outcome:
    """Run the tests that depend on a mutant in a copy of the repository, until one fails.

    Args:
        mutant: The change; it is undone afterwards.
        copy: The copy, not used by other runs.
        most_seconds: Limit of the recorded time of the test files; the nearest files run in any case.
    """
    module = mutant.path.removesuffix(".py").replace("/", ".")
    files, spent = dependent_files(module), 0.0
    chosen = []
    for file in files:
        spent += file.seconds
        if spent > most_seconds and file.distance > files[0].distance:
            break
        chosen.append(file.path)
    target = copy / mutant.path
    original = target.read_text(encoding="utf-8")
    lines = original.split("\n")
    lines[mutant.line - 1] = mutant.new
    start = time.monotonic()
    try:
        target.write_text("\n".join(lines), encoding="utf-8")
        done = _pytest(copy, chosen, 10 * most_seconds)
    finally:
        target.write_text(original, encoding="utf-8")
    return Outcome(mutant, done, time.monotonic() - start, len(chosen))


def _pytest(copy: Path, files: list[str], timeout: float) -> str:
    """Run test files and return the first failure; a run that exceeds `timeout` seconds is a failure, too."""
    environment = os.environ | {"PYTHONPATH": str(copy), "CI": "true"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", *files]
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return "no end"
    if done.returncode in (_PASSED, _NO_TESTS):
        return ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" - ")[0] if failed else f"pytest ended with status {done.returncode}"


def copies(number: int, folder: Path) -> list[Path]:
    """Copy the repository several times, without ignored files."""
    made = []
    for place in range(number):
        copy = folder / f"copy{place}"
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for name in filter(None, tracked.split("\0")):
            if (ROOT / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, copy / name)
        made.append(copy)
    return made


def expected_survivors() -> dict[tuple[str, str, str], str]:
    """Return reasons of expected survivors, by file, old line and new line without indentation."""
    listed = tomllib.loads(EXPECTED_SURVIVORS.read_text(encoding="utf-8")).get("mutant", [])
    return {(entry["path"], entry["old"], entry["new"]): entry["reason"] for entry in listed}


def outcomes(drawn: list[Mutant], workers: int, most_seconds: float) -> Iterator[Outcome]:
    """Run the tests of each mutant, several mutants at once, and yield the outcomes in the order of completion."""
    free: SimpleQueue[Path] = SimpleQueue()

    def in_a_copy(mutant: Mutant) -> Outcome:
        copy = free.get()
        try:
            return run(mutant, copy, most_seconds)
        finally:
            free.put(copy)

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as pool:
        for copy in copies(workers, Path(folder)):
            free.put(copy)
        futures = [pool.submit(in_a_copy, mutant) for mutant in drawn]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def main() -> int:
    """Run the command line; the exit status is 1 if the caught share is less than `--least`."""
    options = _parser().parse_args()
    paths = sorted(path for name in options.only for path in _python_files(ROOT / name))
    drawn, reasons = draw(paths, options.count, options.seed), expected_survivors()
    if options.list:
        print(*drawn, sep="\n")
        return 0
    caught, survivors, harmless = 0, [], 0
    for outcome in outcomes(drawn, options.workers, options.seconds):
        mutant = outcome.mutant
        reason = reasons.get((mutant.path, mutant.old.strip(), mutant.new.strip()), "")
        if outcome.caught_by:
            caught += 1
            result = f"caught by {outcome.caught_by}"
        elif reason:
            harmless += 1
            result = f"no effect: {reason}"
        else:
            survivors.append(mutant)
            result = f"SURVIVED {outcome.files} test files"
        print(f"{mutant}\n    {result}, {outcome.seconds:.0f} s", flush=True)
    share = caught / max(caught + len(survivors), 1)
    print(f"{caught} of {caught + len(survivors)} caught ({100 * share:.1f} %); {harmless} are known to have no effect")
    print(*(f"survived: {mutant}" for mutant in survivors), sep="\n")
    return int(share < options.least)


def _python_files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*.py") if file.name != "__init__.py"]


def _parser() -> argparse.ArgumentParser:
    description, _, details = str(__doc__).partition("\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=200, help="number of mutants (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: %(default)s)")
    parser.add_argument("--only", nargs="+", default=FOLDERS, metavar="PATH", help="folders or files to change")
    parser.add_argument("--workers", type=int, default=2, help="mutants tested at once (default: %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=300, help="recorded seconds of the tests of one mutant (default: %(default)s)"
    )
    parser.add_argument("--least", type=float, default=0.95, help="share that must be caught (default: %(default)s)")
    parser.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    return parser


if __name__ == "__main__":
    sys.exit(main())
