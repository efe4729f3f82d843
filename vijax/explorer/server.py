"""The server of a page: where it listens, who may come, what is compiled before somebody asks, and its end."""

import secrets
from functools import partial
from importlib import resources
from typing import Any
from urllib.parse import urlencode

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.models import CustomJS
from bokeh.server.auth_provider import AuthProvider
from bokeh.server.server import Server
from jinja2 import Template
from tornado.web import RequestHandler

from vijax.explorer import view
from vijax.explorer.address import LOCAL, bound_port, check_listener
from vijax.explorer.jobs import Crew
from vijax.explorer.page import ExplorerPage
from vijax.explorer.source import Source
from vijax.explorer.theme import plain
from vijax.explorer.warming import Warmth, warm

REFRESH = 1000
"""Milliseconds after which a store is looked at again."""


class _Visitors(AuthProvider):
    """Lets in who brings the token in the address, and remembers that in a cookie."""

    def __init__(self, token: str) -> None:
        self._token = token
        super().__init__()

    @property
    def get_user(self) -> Any:
        """Say who comes; None is nobody."""

        def known(handler: RequestHandler) -> str | None:
            given = handler.get_argument("token", "") or handler.get_cookie(_COOKIE) or ""
            if not secrets.compare_digest(given.encode(), self._token.encode()):
                return None
            handler.set_cookie(_COOKIE, self._token, httponly=True, samesite="Strict")
            return "visitor"

        return known

    @property
    def get_user_async(self) -> None:
        """Ask nobody else."""

    @property
    def login_url(self) -> None:
        """Have no page where a token could be guessed: `get_login_url` says what is missing."""

    @property
    def get_login_url(self) -> Any:
        """Send who has no token to a page that says so."""
        return lambda handler: "/token"

    @property
    def login_handler(self) -> None:
        """Have none."""

    @property
    def logout_url(self) -> None:
        """Have none."""

    @property
    def logout_handler(self) -> None:
        """Have none."""


class _NoToken(RequestHandler):
    """Says that the address lacks its token."""

    def get(self) -> None:
        """Answer."""
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish("This page is opened by the whole address that vijax explore printed, with its token.\n")


_COOKIE = "vijax_explore"


def application(source: Source, crew: Crew, warmth: Warmth) -> Application:
    """Make the application: a page for every session, all of one source."""

    def session(document: Document) -> None:
        _open(document, source, crew, warmth)

    return Application(FunctionHandler(session))


def _open(document: Document, source: Source, crew: Crew, warmth: Warmth) -> None:
    """Make the page of one session; where the map cannot be read, one that says why."""
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
        return
    document.template_variables["note"] = plain(note)
    for name, one in page.drawing.figures.all().items():
        one.name = name
        document.add_root(one)
    _listen(document, page)
    document.add_periodic_callback(page.refresh, REFRESH)
    document.add_periodic_callback(partial(_tell_of_warmth, page, warmth, [""]), 300)
    document.on_session_destroyed(lambda context: page.jobs.close())


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


def serve(source: Source, address: str, port: int, origins: tuple[str, ...]) -> tuple[Server, Crew, str]:
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
    further: dict[str, Any] = {"extra_patterns": [("/token", _NoToken)]}
    if token:
        further["auth_provider"] = _Visitors(token)
    server = Server(
        {"/": application(source, crew, warmth)},
        address=address,
        port=port,
        allow_websocket_origin=list(origins or own),
        **further,
    )
    host = (origins or own)[0]
    crew.submit("warming", lambda: warm(source, crew, warmth))
    server.start()
    query = f"?{urlencode({'token': token})}" if token else ""
    return server, crew, f"http://{host}/{query}"
