"""Print the layout of vijax: top-level names, imports between modules and between folders, and longest parts.

    python scripts/import_layers.py

An import edge leads from the importing module to the imported one, and counts once, however often and at whatever depth
it occurs. The number of layers is the length of the longest import path. The length of a function counts its signature
and body, without its docstring.
"""

import ast
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "vijax"

ImportGraph = Mapping[str, set[str]]
"""The names that each name imports; every name is a key."""


def imported_names(parsed: ast.AST) -> Iterator[str]:
    """Yield the dotted names that a file imports, at any depth: vijax.model.flow for `from vijax.model import flow`."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def module_graph(package: Path = PACKAGE) -> ImportGraph:
    """Return the import graph of the modules of a package, without `__init__` files."""
    files = {path: _dotted(path, package) for path in sorted(package.rglob("*.py")) if path.name != "__init__.py"}
    modules = set(files.values())
    graph = {}
    for path, name in files.items():
        names = imported_names(ast.parse(path.read_text(encoding="utf-8"), filename=str(path)))
        # An imported name is a module, or an object inside of its parent module.
        candidates = {part for target in names for part in (target, target.rpartition(".")[0])}
        graph[name] = (candidates & modules) - {name}
    return graph


def folder_graph(modules: ImportGraph) -> ImportGraph:
    """Return the import graph of the top-level names of the package: vijax.model.flow belongs to vijax.model."""
    graph: dict[str, set[str]] = {_top(name): set() for name in modules}
    for name, below in modules.items():
        graph[_top(name)] |= {_top(other) for other in below} - {_top(name)}
    return graph


def count_layers(graph: ImportGraph) -> int:
    """Return the number of names on the longest import path.

    Raises:
        ValueError: If there is a circular import.
    """
    height: dict[str, int] = {}

    def climb(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            raise ValueError(f"imports must not be circular; got {' -> '.join([*above, name])}")
        if name not in height:
            height[name] = 1 + max((climb(other, (*above, name)) for other in sorted(graph[name])), default=0)
        return height[name]

    return max(climb(name, ()) for name in graph)


def count_imports(graph: ImportGraph) -> int:
    """Return the number of import edges."""
    return sum(len(below) for below in graph.values())


def duplicate_class_names(package: Path = PACKAGE) -> dict[str, list[str]]:
    """Return the names shared by several classes of a package, with the modules that define them."""
    classes: dict[str, list[str]] = {}
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, []).append(_dotted(path, package))
    return {name: modules for name, modules in classes.items() if len(modules) > 1}


def lengths(package: Path = PACKAGE) -> tuple[dict[str, int], dict[str, int]]:
    """Return the number of lines of every module, and of every function."""
    of_modules, of_functions = {}, {}
    for path in sorted(package.rglob("*.py")):
        text, name = path.read_text(encoding="utf-8"), _dotted(path, package)
        of_modules[name] = len(text.splitlines())
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                docstring = node.body[0] if ast.get_docstring(node) else None
                docstring_lines = 0 if docstring is None else _lines(docstring)
                of_functions[f"{name}.{node.name}:{node.lineno}"] = _lines(node) - docstring_lines
    return of_modules, of_functions


def top_level_names(package: Path = PACKAGE) -> list[str]:
    """Return the names of folders and files at the top of a package."""
    return sorted(path.name for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())


def lines(package: Path = PACKAGE) -> Iterable[str]:
    """Yield the report, line by line."""
    modules = module_graph(package)
    top, folders = top_level_names(package), folder_graph(modules)
    yield f"at the top: {len(top)} ({', '.join(top)})"
    for kind, graph in (("modules", modules), ("folders", folders)):
        yield f"{kind}: {len(graph)}, in {count_layers(graph)} layers, {count_imports(graph)} imports between them"
    across = sum(_top(name) != _top(other) for name, below in modules.items() for other in below)
    yield f"imports between modules of different folders: {across}"
    for kind, lines_of in zip(("module", "function"), lengths(), strict=True):
        longest = max(lines_of, key=lambda name: lines_of[name])
        yield f"longest {kind}: {longest}, {lines_of[longest]} lines"


def _dotted(path: Path, package: Path) -> str:
    return ".".join([package.name, *path.relative_to(package).with_suffix("").parts])


def _lines(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _top(name: str) -> str:
    return ".".join(name.split(".")[:2])


if __name__ == "__main__":
    print("\n".join(lines()))
