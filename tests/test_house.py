"""The layout: imports point downwards, heavy packages stay in their rooms, `import vijax` is light and quick."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

from scripts import house

ROOT = Path(__file__).parent.parent
FOLDERS = ("vijax", "scripts", "benchmarks", "docs", "tests")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
PUBLIC = [path for path in SOURCES if ROOT / "tests" not in path.parents]
PACKAGE = [path for path in SOURCES if ROOT / "vijax" in path.parents]

# Heavy packages, and the files (or folders) that alone may import them.
ONLY_IN = {
    # Those of benchmarks are what users write without vijax.
    "diffrax": {"vijax/engine/ode.py", "vijax/engine/ode_contact.py", "benchmarks/peers.py", "benchmarks/naive.py"},
    "distributed": {"vijax/planes/cluster.py"},
    "pint": {"vijax/model/units.py"},
    "bokeh": {"vijax/explorer"},
    "playwright": {"benchmarks/explore.py"},
    "matplotlib": {"vijax/plots", "scripts/paper/portrait.py", "benchmarks/charts.py"},
}
KNOWN = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in PACKAGE}
NO_ROOMS = {"vijax.waiting", "vijax.json"}  # a logger, a file
NOT_AT_IMPORT = ["bokeh", "matplotlib", "xarray", "diffrax", "optax", "distributed", "pint"]
IMPORTS_OF_JAX = 2.5  # how many of them importing vijax may take: machines differ by more than imports do

# Built here, so that this line is not what it looks for.
MACHINE_PATH = re.compile(r"(?<![\w.:/])/({})/\w".format("|".join(["home", "root", "tmp", "work", "Users", "mnt"])))


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_page_on_developing_says_of_every_folder_what_it_says_itself():
    """That imports point downwards is held by import-linter, by the contract in pyproject.toml."""
    said = {}
    for path in sorted((ROOT / "vijax").glob("*/__init__.py")):
        parsed = tree(path)
        # Who asks `vijax.plots` for a picture finds it there; it alone is a page of its own.
        assert not parsed.body[1:] or path.parent.name == "plots", (
            f"{name(path)} must hold a docstring and nothing else"
        )
        said[path.parent.name] = " ".join((ast.get_docstring(parsed) or "").split())
    page = (ROOT / "docs/developing.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| `vijax/(\w+)/` \| (.*) \|$", page, re.M)) == said
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    assert f"`{' > '.join(layer for layer in layers if layer[0] != '(')}`" in page


def test_the_house_is_small_enough_to_know():
    rooms = house.rooms()
    assert len(house.at_the_top()) <= 14
    assert house.floors(house.folders(rooms)) <= 10
    assert house.count(house.folders(rooms)) <= 60
    assert len(rooms) == len([path for path in PACKAGE if path.name != "__init__.py"])


def test_rooms_and_functions_are_short_enough_to_read():
    rooms, functions = house.lengths()
    assert {name: lines for name, lines in rooms.items() if lines > 400} == {}
    assert {name: lines for name, lines in functions.items() if lines > 50} == {}
    assert len(functions) > 1000


def test_one_noun_is_one_record():
    """A name that two rooms give to two things says neither."""
    assert house.named_alike() == {}


def test_lengths_and_namesakes_are_counted(tmp_path):
    (tmp_path / "one.py").write_text(
        'class Tile:\n    def lay(self):\n        """Lay it.\n\n        Flat.\n        """\n        return 1\n'
    )
    (tmp_path / "two.py").write_text("class Tile:\n    pass\n")
    package = tmp_path.name
    assert house.lengths(tmp_path) == ({f"{package}.one": 7, f"{package}.two": 2}, {f"{package}.one.lay:2": 2})
    assert house.named_alike(tmp_path) == {"Tile": [f"{package}.one", f"{package}.two"]}


def test_rooms_arrows_and_floors_are_read_as_python_does(tmp_path):
    package = tmp_path / "hut"
    for file, text in {
        "__init__": "from hut.top.roof import tile",
        "low/__init__": "",
        "low/ground": "import math",
        "low/cellar": "if math:\n    def dig():\n        import hut.low.ground as ground",
        "top/__init__": "",
        "top/roof": "from hut.low import cellar, ground\nfrom hut.low.ground import floor",
    }.items():
        path = (package / file).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    ground, cellar, roof = "hut.low.ground", "hut.low.cellar", "hut.top.roof"
    rooms = house.rooms(package)
    assert rooms == {ground: set(), cellar: {ground}, roof: {cellar, ground}}
    assert house.folders(rooms) == {"hut.low": set(), "hut.top": {"hut.low"}}
    assert house.at_the_top(package) == ["__init__.py", "low", "top"]
    assert (house.floors(rooms), house.floors(house.folders(rooms))) == (3, 2)
    with pytest.raises(ValueError, match=re.escape(f"{ground} -> {cellar} -> {ground}")):
        house.floors({ground: {cellar}, cellar: {ground}})


@pytest.mark.parametrize("path", PUBLIC, ids=name)
def test_heavy_packages_stay_in_their_room(path):
    packages = {package.split(".")[0] for package in house.imported(tree(path))}
    own = {name(path), *(folder.relative_to(ROOT).as_posix() for folder in path.parents if ROOT in folder.parents)}
    strays = {package for package, rooms in ONLY_IN.items() if package in packages and not own & rooms}
    assert not strays, f"{name(path)} imports {strays}; only {[ONLY_IN[package] for package in strays]} may"


def named(parsed: ast.AST) -> Iterator[str]:
    """Rooms and folders that strings name: "vijax.plots.cells", and of f"vijax.engine.{name}" the folder."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found = re.fullmatch(r"vijax((?:\.\w+)+)\.?", node.value)
            if found and node.value not in NO_ROOMS:
                yield "vijax" + found.group(1)


# A misspelt one would be found when it is imported, which for a thread that imports ahead is never.
@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_rooms_named_in_strings_are_there(path):
    for dotted in named(tree(path)):
        while dotted not in KNOWN:
            dotted, _, attribute = dotted.rpartition(".")
            assert dotted not in KNOWN or hasattr(import_module(dotted), attribute), f"{dotted} has no {attribute}"


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_annotations_are_not_deferred(path):
    assert "__future__.annotations" not in set(house.imported(tree(path))), (
        "jaxtyping reads annotations as they are defined"
    )


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


@cache
def first_import() -> tuple[float, list[str]]:
    """The first of several."""
    return fresh_import()


def fresh_import(what: str = "vijax.public") -> tuple[float, list[str]]:
    """Seconds of one core that an import takes in a new process, and the top-level packages it loads."""
    code = (
        f"import json, sys, time; start = time.process_time(); import {what}; seconds = time.process_time() - start; "
        "print(json.dumps([seconds, sorted({name.split('.')[0] for name in sys.modules})]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    seconds, packages = json.loads(done.stdout)
    return seconds, packages


def test_import_loads_nothing_heavy():
    _, packages = first_import()
    assert "vijax" in packages
    assert not set(NOT_AT_IMPORT) & set(packages)


def test_a_room_of_plots_is_loaded_when_it_is_asked_for():
    code = (
        "import sys, vijax, vijax.plots.style; from vijax import plots; assert 'matplotlib' not in sys.modules; "
        "plots.power_map; assert 'matplotlib' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_import_is_quick():
    # Time of the process, as other tests use the cores. The first import compiles bytecode; what else is slower comes
    # from the load of the machine, which both have if they run in turn.
    pairs = [(fresh_import()[0], fresh_import("jax.numpy")[0]) for _ in range(4)]
    own, jax_alone = map(min, zip(*pairs, strict=True))
    assert own < IMPORTS_OF_JAX * jax_alone


def said(code: str) -> str:
    """What a new process prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout


def test_importing_vijax_alone_does_not_load_jax():
    assert said("import sys, vijax; print({'jax', 'numpy'} & set(sys.modules))") == "set()\n"


@pytest.mark.parametrize("imports", ["import vijax, jax", "import jax, vijax", "from vijax import *; import jax"])
def test_jax_has_64_bits_once_vijax_is_imported(imports):
    assert said(f"{imports}; print(jax.numpy.ones(1).dtype)") == "float64\n"


@pytest.mark.parametrize("said_before", [None, "0"])
def test_the_environment_is_as_it_was_once_a_name_is_used(monkeypatch, said_before):
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    if said_before is not None:
        monkeypatch.setenv("JAX_ENABLE_X64", said_before)
    code = "import os, vijax, jax; vijax.sweep; print(os.environ.get('JAX_ENABLE_X64'), jax.numpy.ones(1).dtype)"
    assert said(code) == f"{said_before} float64\n"


def test_what_is_offered_can_be_listed_and_nothing_else_is_had():
    offered = json.loads(said("import json, vijax; print(json.dumps(dir(vijax)))"))
    assert "sweep" in offered
    assert said(f"from vijax import *; print(all(name in globals() for name in {offered}))") == "True\n"
    assert said("import vijax; print(hasattr(vijax, 'swept'))") == "False\n"
