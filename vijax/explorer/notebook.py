"""The page of a map below a cell of a notebook: the page of a server in the kernel, in a frame of its own.

A frame, and not the figures alone as `bokeh.io.show` would put them there: what is written about a cell, the sliders
and the keys are of the page, and the notebook's own styles do not reach into it.
"""

from typing import Any

from IPython.display import IFrame, display

from vijax.explorer.server import serve
from vijax.explorer.source import Source

HEIGHT = 900
"""Pixels of the frame."""

_KEPT: list[Any] = []  # servers, which would end with the last that knows them


def show(source: Source, address: str, port: int, origins: tuple[str, ...]) -> None:
    """Serve the page of a source from this kernel, and show it."""
    server, crew, page = serve(source, address, port, origins)
    _KEPT.append((server, crew))
    display(IFrame(page, width="100%", height=HEIGHT))
