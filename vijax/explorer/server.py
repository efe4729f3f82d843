"""The server of a page: where it listens, what is compiled before somebody asks, and what the end of a page costs."""

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
from vijax.explorer.jobs import Crew
from vijax.explorer.page import ExplorerPage
from vijax.explorer.request_filter import UNUSED_CHECK, UNUSED_LIFETIME, Refusal, RequestFilter, TokenProvider
from vijax.explorer.source import Source
from vijax.explorer.theme import plain
from vijax.explorer.warming import Warmth, warm

REFRESH = 1000
"""Milliseconds after which a store is looked at again."""


COLLECTED = 32
"""Pages that end between two searches for their garbage: one takes 0.14 s where programs were compiled."""


def application(source: Source, crew: Crew, warmth: Warmth) -> Application:
    """Make the application: a page for every session, all of one source."""
    ended = itertools.count(1)

    def session(document: Document) -> None:
        page = _open(document, source, crew, warmth)
        _on_end(document, lambda: None if page is None else page.jobs.close(), ended)

    return Application(FunctionHandler(session))


def _on_end(document: Document, close: Callable[[], None], ended: Iterator[int]) -> None:
    """Close a page when its session ends, and collect garbage only after every `COLLECTED`-th page.

    Bokeh searches all objects of the process for garbage whenever a document ends, and once more for callbacks of
    `on_session_destroyed`. Many pages that end together would keep the server from answering.
    """
    destroy = document.destroy

    def destroyed(session: Any) -> None:
        close()
        collects = next(ended) % COLLECTED == 0
        bokeh_document.gc = gc if collects else _NoCollector  # type: ignore[assignment]
        try:
            destroy(session)
        finally:
            bokeh_document.gc = gc

    document.destroy = destroyed  # type: ignore[method-assign]


class _NoCollector:
    """What Bokeh uses of `gc`."""

    @staticmethod
    def collect() -> None:
        """Do nothing."""


def _open(document: Document, source: Source, crew: Crew, warmth: Warmth) -> ExplorerPage | None:
    """Make the page of one session; if the map cannot be read, a document with the reason, and return None."""
    document.title = "vijax explore"
    document.template = _template()
    document.config.notify_connection_status = False  # the page says it itself, and comes back by itself
    document.config.reconnect_session = False  # a server that is started again knows no session
    arguments = _arguments(document)
    try:
        plane = source.plane()
        shown, note = view.first_view(plane), ""
        try:
            shown = view.from_query(plane, arguments)
        except ValueError as error:
            note = f"The address is not of this map: {error}"
        page = ExplorerPage(document, source, plane, shown, crew)
    except (ValueError, OSError) as error:
        document.template_variables["problem"] = plain(str(error))
        return None
    document.template_variables["note"] = plain(note)
    with document.models.freeze():  # else Bokeh collects the models of all roots again for each
        for name, one in page.drawing.figures.all().items():
            one.name = name
            document.add_root(one)
    _listen(document, page)
    document.add_periodic_callback(page.refresh, REFRESH)
    document.add_periodic_callback(partial(_tell_of_warmth, page, warmth, [""]), 300)
    return page


def _tell_of_warmth(page: ExplorerPage, warmth: Warmth, told: list[str]) -> None:
    """Say what is being compiled, when that changes."""
    if warmth.said != told[0]:
        told[0] = warmth.said
        page.tell("warmth", text=warmth.said)


def _arguments(document: Document) -> dict[str, str]:
    context: Any = document.session_context
    request = context.request if context else None
    given = {} if request is None else request.arguments
    return {name: values[-1].decode(errors="replace") for name, values in given.items() if not name.startswith("bokeh")}


def _listen(document: Document, page: ExplorerPage) -> None:
    """Hand the page's script what it needs, and call it when it is told something or the server is lost."""
    shown = page.drawing.figures.map
    marks = {"channel": page.channel, "across": page.drawing.walls.across, "up": page.drawing.walls.up}
    pick = page.drawing.tables.pick
    begin = CustomJS(args={**marks, "pick": pick, "map": shown}, code="vijax.begin({channel, across, up, pick, map})")
    shown.tags = [page.channel]
    document.js_on_event(DocumentReady, begin)
    document.js_on_event(ConnectionLost, CustomJS(code="vijax.lost()"))
    page.channel.js_on_change("told", CustomJS(code="vijax.told(cb_obj.told)"))


def _template() -> Template:
    from bokeh.core.templates import get_env

    files = resources.files("vijax.explorer")
    text, style, script = (files.joinpath(f"page.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js"))
    return get_env().from_string(text.replace("/*style*/", style).replace("/*script*/", script))


def serve(source: Source, address: str, port: int, origins: tuple[str, ...]) -> tuple[BaseServer, Crew, str]:
    """Make a server that listens; give it, its threads, and the address of its page.

    Args:
        source: Where the map comes from.
        address: That it binds.
        port: 0 for any that is free.
        origins: Hosts, each with a port if it is not 80, whose pages may ask; those of this machine unless given.

    Raises:
        ValueError: An address that others can reach without origins.
        OSError: The port is taken, or the address is none of this machine's.
    """
    check_listener(address, port, origins)
    port = bound_port(address, int(port))
    own = tuple(f"{host}:{port}" for host in ("127.0.0.1", "localhost"))
    crew, warmth = Crew(), Warmth()
    token = "" if address in LOCAL else secrets.token_urlsafe(24)
    further: dict[str, Any] = {"auth_provider": TokenProvider(token)} if token else {}
    pages = BokehTornado(
        {"/": application(source, crew, warmth)},
        extra_patterns=[("/token", Refusal)],
        extra_websocket_origins=create_hosts_allowlist(list(origins or own), port),
        unused_session_lifetime_milliseconds=UNUSED_LIFETIME,
        check_unused_sessions_milliseconds=UNUSED_CHECK,
        **further,
    )
    listener = HTTPServer(RequestFilter(pages, (address, *origins)))
    listener.listen(port, address)
    server = BaseServer(IOLoop.current(), pages, listener)
    host = (origins or own)[0]
    crew.submit("warming", lambda: warm(source, crew, warmth))
    server.start()
    query = f"?{urlencode({'token': token})}" if token else ""
    return server, crew, f"http://{host}/{query}"
