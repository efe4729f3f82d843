"""Documentation pages that messages refer to, as opened by `vijax docs NAME`."""

from typing import Literal

PageName = Literal[
    "attractors", "design", "excitation", "limits", "maps", "methods", "model", "programs", "status", "studies"
]
"""Last word of a page's address. A test checks that each page exists, and that a message refers to it."""


def see(page: PageName, message: str) -> str:
    """Return a message that ends with a reference to a documentation page."""
    return f"{message}; see docs: {page}"
