"""`vijax explore`: a page in the browser to explore a map."""

import click

from vijax.cli import process
from vijax.cli.options.value_types import Integer, NewFile
from vijax.cli.page import Page
from vijax.explorer.address import PORT, check_listener


def explore_map(
    store: str | None, curves: str | None, address: str, port: int, allow_origin: tuple[str, ...], no_browser: bool
) -> None:
    """Explore a map in the browser.

    A click on a cell shows its motion, the line through it, its basins, its branch and the nearest optimum. STORE is a
    store that `vijax sweep` wrote or is writing; without it a small plane of d and kappa is computed first.
    """
    from vijax.explorer.explore import check_bokeh, run

    with process.usage_errors():
        check_bokeh()
        from vijax.explorer.server.server import serve
        from vijax.explorer.source import Source

        check_listener(address, port, allow_origin)
        source = Source(store, curves)
        if store is not None or curves is not None:
            source.check()
        server, threads, page = serve(source, address, port, allow_origin)
    try:
        run(server, threads, page, not no_browser)
    except KeyboardInterrupt:
        process.stop("the server is closed")


# --- the page --------------------------------------------------------------------------------------------------------

explore = Page(
    "explore",
    explore_map,
    {
        "Map": [
            click.Argument(["store"], required=False, metavar="[STORE]"),
            click.Option(
                ["--curves"], type=NewFile(), metavar="FILE.zarr", help="curves of its plane, which vijax curves wrote"
            ),
        ],
        "Server": [
            click.Option(["--port"], type=Integer(0), default=PORT, show_default=True, help="0 for any that is free"),
            click.Option(["--address"], default="127.0.0.1", show_default=True, help="that the server binds"),
            click.Option(
                ["--allow-origin"],
                multiple=True,
                metavar="HOST:PORT",
                help="with --address: allowed origin, as in the address bar of the browser",
            ),
            click.Option(["--no-browser"], is_flag=True, help="open no browser, print the address of the page"),
        ],
    },
    examples=[
        "",
        "power_map.zarr",
        "power_map.zarr --curves curves.zarr",
        "power_map.zarr --no-browser --port 0",
        "power_map.zarr --address 0.0.0.0 --allow-origin lab.example.org:5006",
    ],
    epilog="The page is of this machine alone unless --address specifies another; its address then has a token in it. "
    "Needs the extra explore: pip install 'vijax[explore]'.",
)
