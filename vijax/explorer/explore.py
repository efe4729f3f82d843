"""The public function `vijax.explore`: a page that shows a map, from a notebook or from Python."""

import webbrowser
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.explorer.address import PORT, check_listener
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr


@public_api
def explore(
    source: "xr.Dataset | str | Path | None" = None,
    *,
    curves: "xr.Dataset | str | Path | None" = None,
    address: str = "127.0.0.1",
    port: int = PORT,
    allow_origin: str | tuple[str, ...] = (),
    browser: bool = True,
) -> None:
    """Serve a page in the browser that shows a map and, for a picked cell, its motion, basins, branch and optima.

    In a notebook the page appears in a frame below the cell, and the kernel continues. Elsewhere a server runs until
    Ctrl-C stops it. The function needs the extra `explore`, which installs bokeh.

    Args:
        source: Result of `sweep` over at least two axes, or the path of its store; by default a small plane is
            computed.
        curves: Curves of bifurcations to draw over the map: result of `curve_dataset`, or the path of its store.
        address: Address that the server binds, by default one that only this machine can reach. Any other address
            requires `allow_origin`, and the address of the page then contains a token.
        port: Port of the server; 0 selects any free port.
        allow_origin: One or several HOST:PORT, as the browsers of the permitted users show them.
        browser: Whether the page is opened in a browser.

    Raises:
        ModuleNotFoundError: bokeh is not installed.
        ValueError, OSError: The page cannot show the map, the curves do not belong to the map, the address lacks an
            origin, or the port is in use.
    """
    check_bokeh()
    validation.validate_flag("browser", browser)
    origins = check_listener(address, port, allow_origin)
    page_source = import_module("vijax.explorer.source").Source(source, curves)
    page_source.check()
    if _in_notebook():
        import_module("vijax.explorer.notebook").show(page_source, address, port, origins)
        return
    server, threads, page = import_module("vijax.explorer.server.server").serve(page_source, address, port, origins)
    run(server, threads, page, browser)


def check_bokeh() -> None:
    """Raise ModuleNotFoundError, with the remedy, if bokeh is not installed."""
    if find_spec("bokeh") is None:
        raise ModuleNotFoundError("bokeh must be installed for a page; got none; pip install 'vijax[explore]'")


def run(server: Any, threads: Any, page: str, browser: bool) -> None:
    """Print the page's address, open the page, and serve it until Ctrl-C."""
    print(f"{page}\nstop it by Ctrl-C", flush=True)
    if browser:
        webbrowser.open(page)
    try:
        server.io_loop.start()
    finally:
        server.stop()
        threads.close()


def _in_notebook() -> bool:
    """Return True in a Jupyter kernel."""
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    shell = get_ipython()
    return shell is not None and hasattr(shell, "kernel")
