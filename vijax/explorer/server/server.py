"""Server of a page: its sessions, the compilation ahead of the first request, and the cleanup when a page ends."""

import gc
import itertools
import secrets
from collections.abc import Callable, Iterator
from functools import partial
from importlib import resources
from typing import Any
from urllib.parse import urlencode

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.document import document as bokeh_document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.models import CustomJS
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import create_hosts_allowlist
from jinja2 import Template
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop

from vijax.explorer import view
from vijax.explorer.address import LOCAL, bound_port, check_listener
from vijax.explorer.page import ExplorerPage
from vijax.explorer.server.jobs import JobThreads
from vijax.explorer.server.precompilation import CompilationState, precompile
from vijax.explorer.server.request_filter import UNUSED_CHECK, UNUSED_LIFETIME, Refusal, RequestFilter, TokenProvider
from vijax.explorer.source import Source
from vijax.explorer.theme import plain

REFRESH = 1000
"""Milliseconds between two checks whether the store of the map has changed."""


PAGES_PER_COLLECTION = 32
"""Garbage is collected at the end of every 32nd page only, because a collection takes 0.14 s."""


def application(source: Source, threads: JobThreads, compilation: CompilationState) -> Application:
    """Return the Bokeh application, which opens one page per session; all pages show the map of `source`."""
    ended = itertools.count(1)

    def session(document: Document) -> None:
        page = _open(document, source, threads, compilation)
        _on_end(document, lambda: None if page is None else page.jobs.close(), ended)

    return Application(FunctionHandler(session))


def _on_end(document: Document, close: Callable[[], None], ended: Iterator[int]) -> None:
    """Call `close` when the session of a page ends, and reduce Bokeh's garbage collections.

    By itself, Bokeh collects the garbage of the whole process at the end of every session, which would block the server
    if many pages end together. The replaced `document.destroy` collects only for every `PAGES_PER_COLLECTION`-th page.
    A callback of `on_session_destroyed` is not used to close a page, because Bokeh collects once more to find these
    callbacks.

    Args:
        document: Document of the session.
        close: Function that cancels the jobs of the page.
        ended: Counter of the ended pages of the server.
    """
    destroy = document.destroy

    def destroyed(session: Any) -> None:
        close()
        collect_now = next(ended) % PAGES_PER_COLLECTION == 0
        bokeh_document.gc = gc if collect_now else _NoCollector  # type: ignore[assignment]
        try:
            destroy(session)
        finally:
            bokeh_document.gc = gc

    document.destroy = destroyed  # type: ignore[method-assign]


class _NoCollector:
    """Replacement of the module `gc` in Bokeh's document module, so that Bokeh does not collect garbage."""

    @staticmethod
    def collect() -> None:
        """Do nothing."""


def _open(
    document: Document, source: Source, threads: JobThreads, compilation: CompilationState
) -> ExplorerPage | None:
    """Build the page of one session; if the map cannot be read, return None and display the reason instead."""
    document.title = "vijax explore"
    document.template = _template()
    document.config.notify_connection_status = False  # the page shows a lost connection itself, and reloads itself
    document.config.reconnect_session = False  # a restarted server has no earlier sessions
    arguments = _arguments(document)
    try:
        plane = source.plane()
        page_view, note = view.first_view(plane), ""
        try:
            page_view = view.from_query(plane, arguments)
        except ValueError as error:
            note = f"The address is not of this map: {error}"
        page = ExplorerPage(document, source, plane, page_view, threads)
    except (ValueError, OSError) as error:
        document.template_variables["problem"] = plain(str(error))
        return None
    document.template_variables["note"] = plain(note)
    with document.models.freeze():  # otherwise `add_root` walks all models each time
        for name, plot in page.drawing.figures.all().items():
            plot.name = name
            document.add_root(plot)
    _listen(document, page)
    document.add_periodic_callback(page.refresh, REFRESH)
    document.add_periodic_callback(partial(_send_compilation_state, page, compilation, [""]), 300)
    return page


def _send_compilation_state(page: ExplorerPage, compilation: CompilationState, sent: list[str]) -> None:
    """Send the state of the compilation to the page if it has changed; `sent[0]` is the last sent text."""
    if compilation.text != sent[0]:
        sent[0] = compilation.text
        page.send("compilation", text=compilation.text)


def _arguments(document: Document) -> dict[str, str]:
    context: Any = document.session_context
    request = context.request if context else None
    request_arguments = {} if request is None else request.arguments
    return {
        name: values[-1].decode(errors="replace")
        for name, values in request_arguments.items()
        if not name.startswith("bokeh")
    }


def _listen(document: Document, page: ExplorerPage) -> None:
    """Connect the browser's script: it gets the Bokeh models, every message, and an event if the connection is lost."""
    map_figure = page.drawing.figures.map
    models = {"channel": page.channel, "across": page.drawing.walls.across, "up": page.drawing.walls.up}
    pick = page.drawing.tables.pick
    begin = CustomJS(
        args={**models, "pick": pick, "map": map_figure}, code="vijax.begin({channel, across, up, pick, map})"
    )
    map_figure.tags = [page.channel]
    document.js_on_event(DocumentReady, begin)
    document.js_on_event(ConnectionLost, CustomJS(code="vijax.lost()"))
    page.channel.js_on_change("message", CustomJS(code="vijax.receive(cb_obj.message)"))


def _template() -> Template:
    from bokeh.core.templates import get_env

    files = resources.files("vijax.explorer")
    text, style, script = (files.joinpath(f"page.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js"))
    return get_env().from_string(text.replace("/*style*/", style).replace("/*script*/", script))


def serve(source: Source, address: str, port: int, origins: tuple[str, ...]) -> tuple[BaseServer, JobThreads, str]:
    """Return a listening server, its threads, and the address of its page.

    Args:
        source: Source of the map.
        address: Address that the server binds.
        port: Port of the server; 0 selects any free port.
        origins: Origins HOST:PORT (or HOST for port 80) of the pages that may connect; if empty, the local names of
            this machine.

    Raises:
        ValueError: Other machines can reach the address and no origin is specified.
        OSError: The port is in use, or this machine does not have the address.
    """
    check_listener(address, port, origins)
    port = bound_port(address, int(port))
    local_hosts = tuple(f"{host}:{port}" for host in ("127.0.0.1", "localhost"))
    threads, compilation = JobThreads(), CompilationState()
    token = "" if address in LOCAL else secrets.token_urlsafe(24)
    further: dict[str, Any] = {"auth_provider": TokenProvider(token)} if token else {}
    pages = BokehTornado(
        {"/": application(source, threads, compilation)},
        extra_patterns=[("/token", Refusal)],
        extra_websocket_origins=create_hosts_allowlist(list(origins or local_hosts), port),
        unused_session_lifetime_milliseconds=UNUSED_LIFETIME,
        check_unused_sessions_milliseconds=UNUSED_CHECK,
        **further,
    )
    listener = HTTPServer(RequestFilter(pages, (address, *origins)))
    listener.listen(port, address)
    server = BaseServer(IOLoop.current(), pages, listener)
    host = (origins or local_hosts)[0]
    threads.submit("compilation", lambda: precompile(source, threads, compilation))
    server.start()
    query = f"?{urlencode({'token': token})}" if token else ""
    return server, threads, f"http://{host}/{query}"
