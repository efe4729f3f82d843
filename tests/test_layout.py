"""Layout of the repository: downward imports, few imports of heavy packages, a fast `import vijax`."""

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

from scripts import import_layers

ROOT = Path(__file__).parent.parent
FOLDERS = ("vijax", "scripts", "benchmarks", "docs", "tests")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
PUBLIC = [path for path in SOURCES if ROOT / "tests" not in path.parents]
PACKAGE = [path for path in SOURCES if ROOT / "vijax" in path.parents]

# Heavy packages, and the only files or folders that may import them.
ONLY_IN = {
    # The benchmarks import diffrax as users without vijax do.
    "diffrax": {
        "vijax/impact/ode/ode.py",
        "vijax/impact/ode/ode_contact.py",
        "benchmarks/peers.py",
        "benchmarks/naive.py",
    },
    "distributed": {"vijax/maps/execution/cluster.py"},
    "pint": {"vijax/model/units.py"},
    "bokeh": {"vijax/explorer"},
    "playwright": {"benchmarks/explore.py"},
    "matplotlib": {"vijax/plots", "scripts/paper/portrait.py", "benchmarks/charts.py"},
}
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in PACKAGE}
NOT_MODULES = {"vijax.waiting", "vijax.json"}  # a logger, a file
NOT_AT_IMPORT = ["bokeh", "matplotlib", "xarray", "diffrax", "optax", "distributed", "pint"]
MAX_TOP_LEVEL, MAX_LAYERS, MAX_FOLDER_IMPORTS = 15, 11, 66
MAX_MODULE_LINES, MAX_FUNCTION_LINES = 400, 50
MAX_IMPORT_RATIO = 2.5  # import time of vijax divided by the import time of JAX; it varies less between machines

# Joined here, so that this line does not match itself.
MACHINE_PATH = re.compile(r"(?<![\w.:/])/({})/\w".format("|".join(["home", "root", "tmp", "work", "Users", "mnt"])))


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_page_on_developing_repeats_the_docstrings_of_the_folders():
    """import-linter checks that imports point downwards, by the contract in pyproject.toml."""
    docstrings = {}
    for path in sorted((ROOT / "vijax").glob("*/__init__.py")):
        docstrings[path.parent.name] = " ".join((ast.get_docstring(tree(path)) or "").split())
    page = (ROOT / "docs/developing.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| `vijax/(\w+)/` \| (.*) \|$", page, re.M)) == docstrings
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    assert f"`{' > '.join(layer for layer in layers if layer[0] != '(')}`" in page


def test_the_init_file_of_a_folder_is_a_docstring():
    for path in (ROOT / "vijax").rglob("*/__init__.py"):
        # `vijax.plots` is part of the public API and also imports its functions, at their first use.
        if path.parent.name not in ("vijax", "plots"):
            assert not tree(path).body[1:], f"{name(path)} must contain a docstring and nothing else"


def test_the_import_graph_is_small():
    modules = import_layers.module_graph()
    folders = import_layers.folder_graph(modules)
    assert len(import_layers.top_level_names()) <= MAX_TOP_LEVEL
    assert import_layers.count_layers(folders) <= MAX_LAYERS
    assert import_layers.count_imports(folders) <= MAX_FOLDER_IMPORTS
    assert len(modules) == len([path for path in PACKAGE if path.name != "__init__.py"])


def test_modules_and_functions_are_short():
    modules, functions = import_layers.lengths()
    assert {name: lines for name, lines in modules.items() if lines > MAX_MODULE_LINES} == {}
    assert {name: lines for name, lines in functions.items() if lines > MAX_FUNCTION_LINES} == {}
    assert len(functions) > 1000


def test_no_two_classes_share_a_name():
    assert import_layers.duplicate_class_names() == {}


def test_lengths_and_duplicate_class_names_are_counted(tmp_path):
    (tmp_path / "one.py").write_text(
        'class Tile:\n    def lay(self):\n        """Lay it.\n\n        Flat.\n        """\n        return 1\n'
    )
    (tmp_path / "two.py").write_text("class Tile:\n    pass\n")
    package = tmp_path.name
    assert import_layers.lengths(tmp_path) == ({f"{package}.one": 7, f"{package}.two": 2}, {f"{package}.one.lay:2": 2})
    assert import_layers.duplicate_class_names(tmp_path) == {"Tile": [f"{package}.one", f"{package}.two"]}


def test_the_import_graph_follows_the_rules_of_python(tmp_path):
    package = tmp_path / "package"
    for file, text in {
        "__init__": "from package.top.c import f",
        "low/__init__": "",
        "low/a": "import math",
        "low/b": "if math:\n    def f():\n        import package.low.a as a",
        "top/__init__": "",
        "top/c": "from package.low import b, a\nfrom package.low.a import f",
    }.items():
        path = (package / file).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    a, b, c = "package.low.a", "package.low.b", "package.top.c"
    modules = import_layers.module_graph(package)
    assert modules == {a: set(), b: {a}, c: {b, a}}
    folders = import_layers.folder_graph(modules)
    assert folders == {"package.low": set(), "package.top": {"package.low"}}
    assert import_layers.top_level_names(package) == ["__init__.py", "low", "top"]
    assert (import_layers.count_layers(modules), import_layers.count_layers(folders)) == (3, 2)
    with pytest.raises(ValueError, match=re.escape(f"{a} -> {b} -> {a}")):
        import_layers.count_layers({a: {b}, b: {a}})


@pytest.mark.parametrize("path", PUBLIC, ids=name)
def test_heavy_packages_are_imported_in_few_places(path):
    packages = {package.split(".")[0] for package in import_layers.imported_names(tree(path))}
    places = {name(path), *(folder.relative_to(ROOT).as_posix() for folder in path.parents if ROOT in folder.parents)}
    forbidden = {package for package, allowed in ONLY_IN.items() if package in packages and not places & allowed}
    assert not forbidden, f"{name(path)} imports {forbidden}; only {[ONLY_IN[package] for package in forbidden]} may"


def module_strings(parsed: ast.AST) -> Iterator[str]:
    """Yield modules and folders in strings: "vijax.plots.cells", and the folder of f"vijax.model.{name}"."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            match = re.fullmatch(r"vijax((?:\.\w+)+)\.?", node.value)
            if match and node.value not in NOT_MODULES:
                yield "vijax" + match.group(1)


# A wrong name would fail only when it is imported; in a thread that imports ahead it would never fail.
@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_modules_in_strings_exist(path):
    for dotted in module_strings(tree(path)):
        while dotted not in MODULES:
            dotted, _, attribute = dotted.rpartition(".")
            assert dotted not in MODULES or hasattr(import_module(dotted), attribute), f"{dotted} has no {attribute}"


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_annotations_are_not_deferred(path):
    assert "__future__.annotations" not in set(import_layers.imported_names(tree(path))), (
        "jaxtyping reads annotations when they are defined"
    )


def public(parsed: ast.Module) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """Yield public functions and classes of a module, and the public methods of these classes."""
    for node in parsed.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from (n for n in node.body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_"))


@pytest.mark.parametrize("path", PUBLIC, ids=name)
def test_everything_public_has_a_docstring(path):
    parsed = tree(path)
    assert ast.get_docstring(parsed), f"{name(path)} must have a docstring"
    assert not [node.name for node in public(parsed) if not ast.get_docstring(node)]


def test_no_file_contains_the_path_of_a_machine():
    texts = [*SOURCES, *ROOT.glob("*.md"), *ROOT.glob("*.toml"), *ROOT.glob("scripts/*.sh"), *ROOT.glob(".ci/*")]
    lines = ((path, line) for path in texts for line in path.read_text(encoding="utf-8").splitlines())
    assert not [f"{name(path)}: {line.strip()}" for path, line in lines if MACHINE_PATH.search(line)]


@cache
def first_import() -> tuple[float, list[str]]:
    """Return the result of `fresh_import`, computed once for several tests."""
    return fresh_import()


def fresh_import(module: str = "vijax.public") -> tuple[float, list[str]]:
    """Return the processor time [s] of an import in a new process, and the top-level packages that it loads."""
    code = (
        f"import json, sys, time; start = time.process_time(); import {module}; seconds = time.process_time() - start; "
        "print(json.dumps([seconds, sorted({name.split('.')[0] for name in sys.modules})]))"
    )
    seconds, packages = json.loads(output_of(code))
    return seconds, packages


def output_of(code: str) -> str:
    """Return the output of a new Python process."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout


def test_import_loads_no_heavy_package():
    _, packages = first_import()
    assert "vijax" in packages
    assert not set(NOT_AT_IMPORT) & set(packages)


def test_plots_import_matplotlib_at_the_first_use():
    output_of(
        "import sys, vijax, vijax.plots.style; from vijax import plots; assert 'matplotlib' not in sys.modules; "
        "plots.power_map; assert 'matplotlib' in sys.modules"
    )


def test_import_is_fast():
    # Processor time, as other tests use the cores. The first import compiles bytecode; any other delay comes from the
    # load of the machine, and alternating imports share it.
    pairs = [(fresh_import()[0], fresh_import("jax.numpy")[0]) for _ in range(4)]
    vijax_seconds, jax_seconds = map(min, zip(*pairs, strict=True))
    assert vijax_seconds < MAX_IMPORT_RATIO * jax_seconds


def test_importing_vijax_alone_does_not_load_jax():
    assert output_of("import sys, vijax; print({'jax', 'numpy'} & set(sys.modules))") == "set()\n"


@pytest.mark.parametrize("imports", ["import vijax, jax", "import jax, vijax", "from vijax import *; import jax"])
def test_jax_has_64_bits_after_vijax_is_imported(imports):
    assert output_of(f"{imports}; print(jax.numpy.ones(1).dtype)") == "float64\n"


@pytest.mark.parametrize("setting", [None, "0"])
def test_the_environment_is_restored_after_the_first_use_of_a_name(monkeypatch, setting):
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    if setting is not None:
        monkeypatch.setenv("JAX_ENABLE_X64", setting)
    code = "import os, vijax, jax; vijax.sweep; print(os.environ.get('JAX_ENABLE_X64'), jax.numpy.ones(1).dtype)"
    assert output_of(code) == f"{setting} float64\n"


def test_all_public_names_are_listed_and_no_others_exist():
    names = json.loads(output_of("import json, vijax; print(json.dumps(dir(vijax)))"))
    assert "sweep" in names
    assert output_of(f"from vijax import *; print(all(name in globals() for name in {names}))") == "True\n"
    assert output_of("import vijax; print(hasattr(vijax, 'swept'))") == "False\n"
