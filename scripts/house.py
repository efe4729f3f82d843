"""Print how vijax is laid out: what stands at its top, how rooms and folders import each other, and what is longest.

    python scripts/house.py

A room is a module, a folder is what stands at the top of the package. An arrow is drawn from whoever imports to what is
imported, however often and at whatever depth, once. Floors are counted along the longest way down the arrows. Lines of
a function are those of its signature and body, without its docstring.
"""

import ast
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "vijax"

Arrows = Mapping[str, set[str]]
"""Who imports what; every name is a key."""


def imported(parsed: ast.AST) -> Iterator[str]:
    """Name what a file imports, at any depth, with dots: `from vijax.model import flow` gives vijax.model.flow."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms(package: Path = PACKAGE) -> Arrows:
    """Read the modules of a package and which of each other they import; folders' own `__init__` files are no rooms."""
    files = {path: _dotted(path, package) for path in sorted(package.rglob("*.py")) if path.name != "__init__.py"}
    known = set(files.values())
    found = {}
    for path, name in files.items():
        names = imported(ast.parse(path.read_text(encoding="utf-8"), filename=str(path)))
        # Of a name within a room its room is meant, of a room itself the room.
        candidates = {part for one in names for part in (one, one.rpartition(".")[0])}
        found[name] = (candidates & known) - {name}
    return found


def folders(arrows: Arrows) -> Arrows:
    """Draw the arrows between what stands at the top of the package: vijax.model.flow is of vijax.model."""
    found: dict[str, set[str]] = {_top(name): set() for name in arrows}
    for name, below in arrows.items():
        found[_top(name)] |= {_top(other) for other in below} - {_top(name)}
    return found


def floors(arrows: Arrows) -> int:
    """Count the rooms on the longest way down.

    Raises:
        ValueError: There is a circle, along which no way ends.
    """
    height: dict[str, int] = {}

    def climb(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            raise ValueError(f"imports must not go round in a circle; got {' -> '.join([*above, name])}")
        if name not in height:
            height[name] = 1 + max((climb(other, (*above, name)) for other in sorted(arrows[name])), default=0)
        return height[name]

    return max(climb(name, ()) for name in arrows)


def count(arrows: Arrows) -> int:
    """Count the arrows."""
    return sum(len(below) for below in arrows.values())


def named_alike(package: Path = PACKAGE) -> dict[str, list[str]]:
    """Find the names that several classes of a package have, and the rooms that these stand in."""
    found: dict[str, list[str]] = {}
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(_dotted(path, package))
    return {name: rooms for name, rooms in found.items() if len(rooms) > 1}


def lengths(package: Path = PACKAGE) -> tuple[dict[str, int], dict[str, int]]:
    """Count the lines of every room, and of every function."""
    of_rooms, of_functions = {}, {}
    for path in sorted(package.rglob("*.py")):
        text, name = path.read_text(encoding="utf-8"), _dotted(path, package)
        of_rooms[name] = len(text.splitlines())
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                said = node.body[0] if ast.get_docstring(node) else None
                silent = 0 if said is None else _lines(said)
                of_functions[f"{name}.{node.name}:{node.lineno}"] = _lines(node) - silent
    return of_rooms, of_functions


def at_the_top(package: Path = PACKAGE) -> list[str]:
    """List the folders and files at the top of a package."""
    return sorted(path.name for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())


def lines(package: Path = PACKAGE) -> Iterable[str]:
    """Say all of it, a line each."""
    between_rooms = rooms(package)
    top, between = at_the_top(package), folders(between_rooms)
    yield f"at the top: {len(top)} ({', '.join(top)})"
    for what, arrows in (("rooms", between_rooms), ("folders", between)):
        yield f"{what}: {len(arrows)}, on {floors(arrows)} floors, {count(arrows)} arrows between them"
    across = sum(_top(name) != _top(other) for name, below in between_rooms.items() for other in below)
    yield f"arrows from a room of one folder to a room of another: {across}"
    for what, lines_of in zip(("room", "function"), lengths(), strict=True):
        longest = max(lines_of, key=lambda name: lines_of[name])
        yield f"longest {what}: {longest}, {lines_of[longest]} lines"


def _dotted(path: Path, package: Path) -> str:
    return ".".join([package.name, *path.relative_to(package).with_suffix("").parts])


def _lines(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _top(name: str) -> str:
    return ".".join(name.split(".")[:2])


if __name__ == "__main__":
    print("\n".join(lines()))
