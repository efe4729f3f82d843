"""What a package offers, loaded name by name: a room is loaded when something of it is first asked for.

All rooms of vijax take half a second to load, those that a trajectory needs half of that. The imports of a file say to
a type checker what is offered and where it stands; the same lines are read here, and not run.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from vijax.runtime.garbage import seldom_collected


class Home(NamedTuple):
    """Where an offered name stands: in a module, by a name of its own there; None where it is the module itself."""

    module: str
    name: str | None


def homes(package: str, path: Path) -> dict[str, Home]:
    """Read where what a file imports from within a package stands, by the names that it gives to it."""
    found: dict[str, Home] = {}

    def inside(module: str | None) -> bool:
        return module is not None and module.startswith(f"{package}.")

    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and inside(node.module):
            found.update({one.asname or one.name: Home(str(node.module), one.name) for one in node.names})
        elif isinstance(node, ast.Import):
            found.update({one.asname: Home(one.name, None) for one in node.names if one.asname and inside(one.name)})
    return found


def load(home: Home) -> Any:
    """Load what stands there."""
    with seldom_collected():
        module = import_module(home.module)
    return module if home.name is None else getattr(module, home.name)
