"""Markdown of generated parts of pages."""

import re
from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines) + "\n"


def escaped(text: str) -> str:
    """Escape characters of a help text that Markdown would read as markup."""
    return re.sub(r"([*_<>$\[\]])", r"\\\1", text)
