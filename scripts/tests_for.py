"""Print or run the test files that import a module of vijax.

    python scripts/tests_for.py vijax/continuation/criticality.py    # print the files
    python scripts/tests_for.py vijax.model.flow --run -x -k flip    # run them; arguments after --run: pytest

A file has distance 1 if it imports the module, or uses a public name that the module defines; it has distance 2 if it
imports a module that imports the module, and so on. By default the nearest files are chosen. Files are ordered by
distance, then by the processor time that `tests/seconds.json` records for them.
"""

import argparse
import ast
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from scripts import import_layers
from tests.seconds import recorded
from vijax.runtime.lazy_imports import name_locations

ROOT = Path(__file__).parent.parent


class DependentFile(NamedTuple):
    """A test file that depends on a module.

    Attributes:
        path: Path of the file, relative to the root of the repository.
        distance: Number of imports between the file and the module.
        seconds: Processor time of its tests; 0 if none is recorded.
    """

    path: str
    distance: int
    seconds: float


def dependent_files(module: str, imports: Mapping[str, set[str]] | None = None) -> list[DependentFile]:
    """Return the test files that depend on a module, nearest first, then cheapest first.

    Args:
        module: Dotted name, such as "vijax.continuation.criticality".
        imports: Modules that each module imports; by default read from the repository.

    Raises:
        ValueError: If the repository has no such module.
    """
    imports = _imports() if imports is None else imports
    if module not in imports:
        raise ValueError(f"MODULE must be a module of the repository; got {module!r}; give it as vijax.orbits.steady")
    distances = _distances(module, imports)
    seconds = recorded()
    files = [
        DependentFile(path, distances[name], seconds.get(path, 0.0))
        for name in distances
        if (path := f"{name.replace('.', '/')}.py").startswith("tests/") and Path(path).name.startswith("test_")
    ]
    return sorted(files, key=lambda file: (file.distance, file.seconds, file.path))


def _distances(module: str, imports: Mapping[str, set[str]]) -> dict[str, int]:
    """Return the number of imports that lead from each dependent module to `module`, by breadth-first search."""
    distances, frontier = {module: 0}, {module}
    while frontier:
        nearest = max(distances.values())
        frontier = {name for name, others in imports.items() if name not in distances and others & frontier}
        distances.update(dict.fromkeys(frontier, nearest + 1))
    return distances


@cache
def _imports() -> dict[str, set[str]]:
    """Return the modules that each module of the repository imports, public names replaced by their modules."""
    public = {name: home.module for name, home in name_locations("vijax", ROOT / "vijax/public.py").items()}
    paths = [path for folder in ("vijax", "tests", "benchmarks", "scripts") for path in (ROOT / folder).rglob("*.py")]
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}
    # `vijax/public.py` imports everything; a dependency on it is a dependency on each name that is used.
    ignored = {"vijax.public", "vijax.__init__"}
    imports = {}
    for name, path in modules.items():
        parsed = ast.parse(path.read_text(encoding="utf-8"))
        # An imported name is a module, or an object inside of its parent module.
        names = {
            part for target in import_layers.imported_names(parsed) for part in (target, target.rpartition(".")[0])
        }
        names |= {public[used] for used in _public_names(parsed) if used in public}
        imports[name] = (names & set(modules)) - {name} - ignored
    return {name: others for name, others in imports.items() if name not in ignored}


def _public_names(parsed: ast.Module) -> set[str]:
    """Return the names that a file takes from `vijax` itself: as `vijax.sweep` or `from vijax import sweep`."""
    names = set()
    for node in ast.walk(parsed):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "vijax":
            names.add(node.attr)
        elif isinstance(node, ast.ImportFrom) and node.module == "vijax":
            names |= {alias.name for alias in node.names}
    return names


def _module_name(text: str) -> str:
    """Return the dotted name of a module from its path or dotted name."""
    return text.removesuffix(".py").replace("/", ".") if "/" in text or text.endswith(".py") else text


def main() -> int:
    """Run the command line."""
    description, _, details = str(__doc__).partition("\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("module", metavar="MODULE", type=_module_name, help="path or dotted name of a module")
    parser.add_argument("--distance", type=int, help="largest distance of the files (default: the smallest distance)")
    parser.add_argument(
        "--run", nargs=argparse.REMAINDER, help="run the files by pytest, with the arguments that follow"
    )
    options = parser.parse_args()
    try:
        files = dependent_files(options.module)
    except ValueError as error:
        parser.error(str(error))
    nearest = min((file.distance for file in files), default=0)
    chosen = [file for file in files if file.distance <= (options.distance or nearest)]
    for file in chosen:
        print(f"{file.distance}  {file.seconds:6.1f} s  {file.path}")
    print(f"{len(chosen)} files; {len(files) - len(chosen)} more at a larger distance")
    if options.run is None or not chosen:
        return 0
    paths = [file.path for file in chosen]
    return subprocess.run([sys.executable, "-m", "pytest", *paths, *options.run], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())
