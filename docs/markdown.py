"""What generated pieces of pages are written with."""

import re
from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines) + "\n"


def escaped(said: str) -> str:
    """Escape what Markdown would read as markup in a text of help."""
    return re.sub(r"([*_<>$\[\]])", r"\\\1", said)
