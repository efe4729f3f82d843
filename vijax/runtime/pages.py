"""The pages of the documentation that messages name: what `vijax docs NAME` opens."""

from typing import Literal

PageName = Literal[
    "attractors", "design", "excitation", "limits", "maps", "methods", "model", "programs", "status", "studies"
]
"""The last word of a page's address. A test sees that each is a page, and that a message names it."""


def see(page: PageName, message: str) -> str:
    """End a message with the page that says more."""
    return f"{message}; see docs: {page}"
