"""The page of a map below a cell of a notebook."""

from bokeh.io import output_notebook
from bokeh.io import show as shown
from bokeh.resources import INLINE

from vijax.explorer.jobs import Crew
from vijax.explorer.server import application
from vijax.explorer.source import Source
from vijax.explorer.warming import Warmth


def show(source: Source, origins: tuple[str, ...]) -> None:
    """Show the page of a source; `origins` is where Jupyter is reached, localhost:8888 unless given."""
    output_notebook(INLINE, hide_banner=True)
    where = {"notebook_url": origins[0]} if origins else {}
    shown(application(source, Crew(), Warmth("")), **where)
