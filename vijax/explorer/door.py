"""`vijax.explore`: the page of a map, in a notebook or from Python."""

import webbrowser
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.explorer.address import PORT, check_listener
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr


@door
def explore(
    source: "xr.Dataset | str | Path | None" = None,
    *,
    curves: "xr.Dataset | str | Path | None" = None,
    address: str = "127.0.0.1",
    port: int = PORT,
    allow_origin: str | tuple[str, ...] = (),
    browser: bool = True,
) -> None:
    """Look into a map: a page with the motion of each cell that is picked, and what surrounds it.

    In a notebook the page stands in a frame below the cell, and the kernel goes on. Elsewhere a server runs until it is
    stopped by Ctrl-C. Needs the extra `explore`, which brings bokeh.

    Args:
        source: What `sweep` returned, over two axes at least, or a store of it; a small plane is made unless given.
        curves: Of bifurcations, which are laid over the map: what `curve_dataset` returned, or a store of it.
        address: That the server binds: this machine alone unless given. Any other needs `allow_origin`, and a token in
            the address of the page.
        port: Of the server; 0 for any that is free.
        allow_origin: HOST:PORT, one or several, as they stand in the browser of who may ask.
        browser: Whether the page is opened in a browser.

    Raises:
        ModuleNotFoundError: Without bokeh.
        ValueError, OSError: A map that cannot be looked into, curves that are not of it, an address without an origin,
            a port that is taken.
    """
    check_bokeh()
    checks.flag("browser", browser)
    origins = check_listener(address, port, allow_origin)
    given = import_module("vijax.explorer.source").Source(source, curves)
    given.check()
    if _in_notebook():
        import_module("vijax.explorer.notebook").show(given, address, port, origins)
        return
    server, crew, page = import_module("vijax.explorer.server").serve(given, address, port, origins)
    run(server, crew, page, browser)


def check_bokeh() -> None:
    """Raise ModuleNotFoundError, with what to do, where bokeh is not installed."""
    if find_spec("bokeh") is None:
        raise ModuleNotFoundError("bokeh must be installed for a page; got none; pip install 'vijax[explore]'")


def run(server: Any, crew: Any, page: str, browser: bool) -> None:
    """Say where the page is, open it, and serve until Ctrl-C."""
    print(f"{page}\nstop it by Ctrl-C", flush=True)
    if browser:
        webbrowser.open(page)
    try:
        server.io_loop.start()
    finally:
        server.stop()
        crew.close()


def _in_notebook() -> bool:
    """Tell whether a kernel of Jupyter runs this."""
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    shell = get_ipython()
    return shell is not None and hasattr(shell, "kernel")
