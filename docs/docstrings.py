"""What the page of functions makes of docstrings: short, in public names, each text once."""

import re
import sys
from collections.abc import Iterator
from itertools import groupby
from types import ModuleType
from typing import Any

from sphinx.addnodes import literal_strong
from sphinx.application import Sphinx

import vijax

_SETTINGS = re.compile(r"(\w+Settings)\([^()]*(?:\([^()]*\)[^()]*)*\)")
_NAMED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)")
_FIELD = re.compile(r":param (\w+): *(.*)")
_SPACE = "\u200b"  # of no width, as Sphinx takes what stands before a blank for a type; `_space` widens it


def setup(app: Sphinx) -> None:
    """Read docstrings after napoleon has made fields of their sections."""
    app.connect("autodoc-process-docstring", _rewrite, priority=900)
    app.connect("autodoc-process-signature", _shorten)
    app.connect("autodoc-skip-member", _leave_out)
    app.connect("doctree-read", _space)


def _rewrite(_app: Sphinx, _what: str, _name: str, thing: Any, _options: Any, lines: list[str]) -> None:
    module = sys.modules.get(getattr(thing, "__module__", "") or "", vijax)
    lines[:] = merged([_NAMED.sub(lambda found: f"`{public(found[1], module)}`", line) for line in lines])


def public(name: str, module: ModuleType) -> str:
    """Give the name by which `vijax` offers what a module calls so; the name itself where it offers no such thing."""
    found: Any = module
    for part in name.removeprefix("vijax.").split("."):
        found = getattr(found, part, None) or sys.modules.get(f"{getattr(found, '__name__', '')}.{part}")
    if found is None and name.startswith("vijax."):
        home, _, last = name.rpartition(".")
        found = getattr(sys.modules.get(home), last, None)
    return next((own for own in dir(vijax) if found is not None and getattr(vijax, own) is found), name)


def merged(lines: list[str]) -> list[str]:
    """Say once what several parameters in a row share."""
    return [line for _, group in groupby(_fields(lines), key=lambda field: field[1]) for line in _together([*group])]


def _fields(lines: list[str]) -> Iterator[tuple[str, tuple[str, ...] | int]]:
    """Part lines into parameters, each a name and its text, and single other lines, which equal no other."""
    at = 0
    while at < len(lines):
        found, end = _FIELD.match(lines[at]), at + 1
        if found is None:
            yield lines[at], at
        else:
            while end < len(lines) and lines[end].startswith(" "):
                end += 1
            yield found[1], (found[2], *(line.strip() for line in lines[at + 1 : end]))
        at = end


def _together(group: list[tuple[str, tuple[str, ...] | int]]) -> list[str]:
    (first, text), *_ = group
    if isinstance(text, int):
        return [first]
    names = f",{_SPACE}".join(name for name, _ in group)
    return [f":param {names}: {text[0]}", *(f"    {line}" for line in text[1:])]


def _shorten(
    _app: Sphinx, _what: str, _name: str, _thing: Any, _options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Show no field of a settings record that is a default: the record has an entry of its own."""
    return (signature and _SETTINGS.sub(r"\1()", signature)), returned


def _leave_out(_app: Sphinx, _what: str, _name: str, thing: Any, _skip: bool, _options: Any) -> bool | None:
    """Leave out fields of named tuples, which `Attributes` tells of."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


def _space(_app: Sphinx, tree: Any) -> None:
    """Part the names of parameters by blanks that show."""
    for node in tree.findall(literal_strong):
        for text in list(node.findall(lambda one: one.tagname == "#text")):
            text.parent.replace(text, type(text)(text.replace(_SPACE, " ")))
