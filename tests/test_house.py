"""The layout: imports point downwards, heavy packages stay in their rooms, `import vijax` is light and quick."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("vijax", "scripts", "benchmarks", "tests")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).glob("*.py"))
PUBLIC = [path for path in SOURCES if path.parent.name != "tests"]
PACKAGE = [path for path in SOURCES if path.parent.name == "vijax"]

# What each room may import of the others: the README's room table. `__init__` names the public functions of all.
ROOMS: dict[str, set[str]] = {
    "context": set(),
    "checks": set(),
    "units": {"checks"},
    "model": {"context", "checks", "units"},
    "xla": set(),
    "flow": {"model", "xla"},
    "membrane": {"checks", "model"},
    "method": {"checks", "model", "membrane"},
    "lanes": {"xla"},
    "energy": {"context", "checks", "units", "xla", "lanes", "model", "flow"},
    "exact": {"xla", "model", "flow", "energy"},
    "polynomial": {"xla", "flow"},
    "quick": {"xla", "model", "flow", "energy", "exact", "polynomial"},
    "sampled": {"xla", "model", "flow", "energy", "exact", "quick"},
    "ode": {"xla", "model", "flow", "membrane", "method"},
    "rk4": {"xla", "model", "flow", "membrane", "method"},
    "cell": {"model", "method", "quick"},
    "relay": {"lanes", "model", "flow", "quick", "cell"},
    "recurrence": {"xla", "lanes", "model", "flow", "method", "quick", "cell", "relay"},
    "fold": {"xla", "lanes", "model", "flow", "energy", "quick", "cell", "relay", "recurrence"},
    "summary": {"model", "quick", "cell", "relay"},
    "trips": {"xla", "lanes", "model", "flow", "exact", "quick", "sampled", "ode", "rk4", "cell", "recurrence", "fold"},
    "files": {"checks"},
    "inventory": {"files"},
    "store": {"checks", "files", "inventory"},
    "traced": {"xla", "lanes", "files"},
    "simulate": {
        "context",
        "checks",
        "membrane",
        "traced",
        "model",
        "exact",
        "quick",
        "lanes",
        "method",
        "cell",
        "relay",
        "recurrence",
        "summary",
        "trips",
    },
    "trajectory": {"context", "checks", "lanes", "model", "flow", "exact", "ode", "rk4", "membrane", "method"},
    "curve": {"context", "checks", "lanes", "model", "flow"},
    "elimination": set(),
    "shooting": {"model", "flow", "elimination"},
    "clearance": {"model", "flow", "exact", "shooting"},
    "steady": {"context", "checks", "elimination", "model", "flow", "energy", "exact", "shooting", "clearance"},
    "ascent": set(),
    "tolerance": {"checks", "model"},
    "tuning": {"context", "checks", "units", "model"},
    "objective": {"model", "shooting", "steady", "ascent", "tuning"},
    "impact_map": {"xla", "model", "quick", "lanes", "cell", "trips"},
    "label": {"model"},
    "orbit": {
        "context",
        "checks",
        "xla",
        "model",
        "flow",
        "lanes",
        "energy",
        "curve",
        "shooting",
        "impact_map",
        "label",
        "trajectory",
    },
    "arc": {"elimination", "model", "lanes", "shooting", "clearance"},
    "record": {"xla", "model", "exact", "lanes", "trajectory"},
    "survey": {"context", "lanes", "model", "simulate", "record", "shooting"},
    "starts": {"lanes", "model", "energy", "tuning", "survey"},
    "axes": {"checks", "units", "model"},
    "branch": {"context", "checks", "units", "lanes", "model", "shooting", "orbit", "arc", "axes"},
    "dataset": {"lanes", "model", "method", "axes", "simulate"},
    "frame": {"model", "dataset", "files", "inventory", "store"},
    "study": {"lanes", "axes", "dataset", "files", "inventory", "store", "frame"},
    "refine": {"label"},
    "cluster": {"checks"},
    "calls": {"context", "lanes", "model", "dataset", "study", "simulate"},
    "estimate": {"context", "checks", "lanes", "dataset", "files", "traced"},
    "grid": {
        "context",
        "checks",
        "estimate",
        "lanes",
        "model",
        "membrane",
        "method",
        "axes",
        "dataset",
        "store",
        "study",
        "cluster",
        "refine",
        "calls",
    },
    "attractor": {"context", "checks", "model", "axes", "dataset", "label", "grid"},
    "chaos": {"context", "checks", "model", "grid", "attractor"},
    "compare": {"context", "checks", "model", "dataset", "label", "grid"},
    "design": {
        "context",
        "checks",
        "estimate",
        "xla",
        "model",
        "energy",
        "lanes",
        "steady",
        "ascent",
        "tolerance",
        "tuning",
        "objective",
        "orbit",
        "starts",
        "axes",
    },
    "surroundings": {"context", "checks", "model", "orbit", "steady", "branch", "attractor", "tuning", "design"},
    "diagram": {
        "context",
        "checks",
        "estimate",
        "lanes",
        "model",
        "energy",
        "simulate",
        "record",
        "axes",
        "dataset",
        "grid",
    },
    "style": {"checks", "files"},
    "paper": set(),
    "portrait": {"style"},
    "cached": {"model", "orbit", "branch", "diagram", "paper"},
    "figures": {"model", "curve", "orbit", "paper", "portrait", "cached"},
    "evidence": {"model", "orbit", "branch", "attractor", "chaos", "label", "cached", "paper"},
    "claims": {"model", "branch", "chaos", "diagram", "grid", "cached", "paper", "evidence"},
    "report": {"checks", "units", "model", "energy", "design", "objective", "surroundings", "tolerance", "tuning"},
    "chart": {"checks", "style"},
    "blueprint": {"checks", "units", "report", "style", "tuning"},
    "panels": set(),
    "plot": {"checks", "model", "axes", "dataset", "label", "grid", "compare", "style", "panels"},
}
ROOMS["__init__"] = set(ROOMS)

ONLY_IN = {
    "diffrax": {"vijax/ode.py", "benchmarks/peers.py", "benchmarks/naive.py"},  # what users write without vijax
    "distributed": {"vijax/cluster.py"},
    "pint": {"vijax/units.py"},
    "matplotlib": {"vijax/plot.py", "vijax/chart.py", "vijax/portrait.py", "vijax/blueprint.py"},
}
NOT_AT_IMPORT = ["matplotlib", "xarray", "diffrax", "optax", "distributed", "pint"]
IMPORT_SECONDS = 1.5

# Built here, so that this line is not what it looks for.
MACHINE_PATH = re.compile(r"(?<![\w.:/])/({})/\w".format("|".join(["home", "root", "tmp", "work", "Users", "mnt"])))


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported(parsed: ast.AST) -> Iterator[str]:
    """Dotted names that a file imports, at any depth: `from vijax import flow` gives vijax.flow."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = ("vijax." if node.level else "") + (node.module or "")
            yield from (f"{package.rstrip('.')}.{alias.name}" for alias in node.names)


def rooms_imported(parsed: ast.AST) -> set[str]:
    """Rooms among a file's imports; a public name taken from the package itself counts as the room `__init__`."""
    parts = [name.split(".") for name in imported(parsed)]
    return {part[1] if part[1:] and part[1] in ROOMS else "__init__" for part in parts if part[0] == "vijax"}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_table_has_no_cycle_and_no_room_twice():
    seen: set[str] = set()
    for room, below in ROOMS.items():
        assert below <= seen, f"{room} may import {below - seen}, which stand under it in the table"
        seen.add(room)


@pytest.mark.parametrize("path", PACKAGE, ids=name)
def test_imports_point_downwards(path):
    assert path.stem in ROOMS, f"{name(path)} has no line in the room table of tests/test_house.py"
    upwards = rooms_imported(tree(path)) - ROOMS[path.stem]
    assert not upwards, f"{name(path)} must not import {sorted(upwards)}"


@pytest.mark.parametrize("path", PUBLIC, ids=name)
def test_heavy_packages_stay_in_their_room(path):
    packages = {package.split(".")[0] for package in imported(tree(path))}
    strays = {package for package, rooms in ONLY_IN.items() if package in packages and name(path) not in rooms}
    assert not strays, f"{name(path)} imports {strays}; only {[ONLY_IN[package] for package in strays]} may"


def test_rooms_and_imports_are_read_as_python_does():
    source = "from vijax import flow, sweep\nimport numpy\nimport vijax.grid as g\nif g:\n    from .model import State"
    assert rooms_imported(ast.parse(source)) == {"flow", "grid", "model", "__init__"}


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_annotations_are_not_deferred(path):
    assert "__future__.annotations" not in set(imported(tree(path))), "jaxtyping reads annotations as they are defined"


def public(parsed: ast.Module) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """Public functions and classes of a module, and the public methods of those classes."""
    for node in parsed.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from (n for n in node.body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_"))


@pytest.mark.parametrize("path", PUBLIC, ids=name)
def test_everything_public_has_a_docstring(path):
    parsed = tree(path)
    assert ast.get_docstring(parsed), f"{name(path)} does not say what it is"
    assert not [node.name for node in public(parsed) if not ast.get_docstring(node)]


def test_no_file_names_a_path_of_one_machine():
    texts = [*SOURCES, *ROOT.glob("*.md"), *ROOT.glob("*.toml"), *ROOT.glob("scripts/*.sh"), *ROOT.glob(".ci/*")]
    lines = ((path, line) for path in texts for line in path.read_text(encoding="utf-8").splitlines())
    assert not [f"{name(path)}: {line.strip()}" for path, line in lines if MACHINE_PATH.search(line)]


def fresh_import() -> tuple[float, list[str]]:
    """Seconds of one core that `import vijax` takes in a new process, and the top-level packages it loads."""
    code = (
        "import json, sys, time; start = time.process_time(); import vijax; seconds = time.process_time() - start; "
        "print(json.dumps([seconds, sorted({name.split('.')[0] for name in sys.modules})]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    seconds, packages = json.loads(done.stdout)
    return seconds, packages


def test_import_loads_nothing_heavy():
    _, packages = fresh_import()
    assert "vijax" in packages
    assert not set(NOT_AT_IMPORT) & set(packages)


def test_import_is_quick():
    # Time of the process, as other tests hold the cores; the least of three, as the first import compiles bytecode.
    assert min(fresh_import()[0] for _ in range(3)) < IMPORT_SECONDS
