"""Docstrings on the page of functions: with public names, without repeated texts, and with short signatures."""

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
_SPACE = "\u200b"  # zero width, as Sphinx reads the words before a blank as a type; `_space` replaces it by a blank


def setup(app: Sphinx) -> None:
    """Process docstrings after napoleon has converted their sections into fields."""
    app.connect("autodoc-process-docstring", _rewrite, priority=900)
    app.connect("autodoc-process-signature", _shorten)
    app.connect("autodoc-skip-member", _leave_out)
    app.connect("doctree-read", _space)


def _rewrite(_app: Sphinx, _what: str, _name: str, thing: Any, _options: Any, lines: list[str]) -> None:
    module = sys.modules.get(getattr(thing, "__module__", "") or "", vijax)
    lines[:] = merged([_NAMED.sub(lambda match: f"`{public(match[1], module)}`", line) for line in lines])


def public(name: str, module: ModuleType) -> str:
    """Return the public name of the object with a name in a module, or the name itself if there is none."""
    value: Any = module
    for part in name.removeprefix("vijax.").split("."):
        value = getattr(value, part, None) or sys.modules.get(f"{getattr(value, '__name__', '')}.{part}")
    if value is None and name.startswith("vijax."):
        home, _, last = name.rpartition(".")
        value = getattr(sys.modules.get(home), last, None)
    return next(
        (public_name for public_name in dir(vijax) if value is not None and getattr(vijax, public_name) is value), name
    )


def merged(lines: list[str]) -> list[str]:
    """Merge consecutive parameters with the same text."""
    return [line for _, group in groupby(_fields(lines), key=lambda field: field[1]) for line in _together([*group])]


def _fields(lines: list[str]) -> Iterator[tuple[str, tuple[str, ...] | int]]:
    """Yield parameters as name and text, and other lines with their number, so that these are never merged."""
    at = 0
    while at < len(lines):
        match, end = _FIELD.match(lines[at]), at + 1
        if match is None:
            yield lines[at], at
        else:
            while end < len(lines) and lines[end].startswith(" "):
                end += 1
            yield match[1], (match[2], *(line.strip() for line in lines[at + 1 : end]))
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
    """Omit the fields of a settings record that is a default; the page has an entry for the record."""
    return (signature and _SETTINGS.sub(r"\1()", signature)), returned


def _leave_out(_app: Sphinx, _what: str, _name: str, thing: Any, _skip: bool, _options: Any) -> bool | None:
    """Omit fields of named tuples, as `Attributes` documents them."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


def _space(_app: Sphinx, tree: Any) -> None:
    """Separate the names of parameters by visible blanks."""
    for node in tree.findall(literal_strong):
        for text in list(node.findall(lambda child: child.tagname == "#text")):
            text.parent.replace(text, type(text)(text.replace(_SPACE, " ")))
