"""Shows the page of a map below a notebook cell: a server in the kernel serves the page, and a frame displays it.

`bokeh.io.show` would embed the figures only, without the page's texts, sliders and keyboard shortcuts. In a frame, the
styles of the notebook do not apply to the page.
"""

from typing import Any

from IPython.display import IFrame, display

from vijax.explorer.server.server import serve
from vijax.explorer.source import Source

HEIGHT = 900
"""Height of the frame in pixels."""

_SERVERS: list[Any] = []  # references that keep the servers from garbage collection


def show(source: Source, address: str, port: int, origins: tuple[str, ...]) -> None:
    """Serve the page of a source from this kernel, and show it in a frame."""
    server, threads, page = serve(source, address, port, origins)
    _SERVERS.append((server, threads))
    display(IFrame(page, width="100%", height=HEIGHT))
