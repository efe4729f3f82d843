"""Lazy imports of a package: a module is loaded at the first use of one of its names.

To load all modules of vijax takes half a second; to load only the modules for a trajectory takes half of that. The
import statements of one file declare the names for type checkers; the same statements are parsed here, not executed.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from vijax.runtime.garbage_collection import infrequent_collection


class NameLocation(NamedTuple):
    """Location of a lazily imported object: its module, and its name in the module; None for the module itself."""

    module: str
    name: str | None


def name_locations(package: str, path: Path) -> dict[str, NameLocation]:
    """Return the location of every name that a file imports from within a package, by the names that the file uses."""
    locations: dict[str, NameLocation] = {}

    def inside(module: str | None) -> bool:
        return module is not None and module.startswith(f"{package}.")

    # Includes imports under `if TYPE_CHECKING`, which are never executed.
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and inside(node.module):
            locations.update(
                {
                    imported.asname or imported.name: NameLocation(str(node.module), imported.name)
                    for imported in node.names
                }
            )
        elif isinstance(node, ast.Import):
            locations.update(
                {
                    imported.asname: NameLocation(imported.name, None)
                    for imported in node.names
                    if imported.asname and inside(imported.name)
                }
            )
    return locations


def load(location: NameLocation) -> Any:
    """Load the object at a location."""
    with infrequent_collection():
        module = import_module(location.module)
    return module if location.name is None else getattr(module, location.name)
