"""Which requests the server of a page answers: by their host, by their token, and by the number of open pages."""

import secrets
from typing import Any

from bokeh.server.auth_provider import AuthProvider
from bokeh.server.tornado import BokehTornado
from bokeh.util.token import get_session_id
from tornado.httputil import HTTPMessageDelegate, HTTPServerRequest
from tornado.routing import Router
from tornado.web import Application, RequestHandler

from vijax.explorer.address import LOCAL, host_of

MOST_SESSIONS = 32
"""Sessions at a time: each holds its own copy of the map that its page shows."""

MOST_WAITING = 8
"""Sessions at a time to which no browser is connected: to make one keeps the server from answering for 0.3 s."""

UNUSED_LIFETIME = 10_000
"""Milliseconds after which a session ends to which no browser is connected."""

UNUSED_CHECK = 2_000
"""Milliseconds between two searches for such sessions."""

_COOKIE = "vijax_explore"
# Paths whose requests make a session if there is none: the page, its parts, and the connection of its script.
_SESSION_PATHS = ("/", "/autoload.js", "/metadata", "/ws")
_TOKEN_MISSING = "This page is opened by the whole address that vijax explore printed, with its token."
_HOST_UNKNOWN = (
    "The host of the address must be one that this server was given; open the address that vijax explore printed, or "
    "start the server with --allow-origin HOST:PORT."
)
_TOO_MANY = (
    f"At most {MOST_SESSIONS} pages may be open at a time, and {MOST_WAITING} may be loading; close one, and load this "
    f"page again in {(UNUSED_LIFETIME + UNUSED_CHECK) // 1000} seconds."
)


class TokenProvider(AuthProvider):
    """Admits a request with the token in its address, and stores the token in a cookie."""

    def __init__(self, token: str) -> None:
        self._token = token
        super().__init__()

    @property
    def get_user(self) -> Any:
        """Return a function from a request to its user; None is nobody."""

        def known(handler: RequestHandler) -> str | None:
            given = handler.get_argument("token", "") or handler.get_cookie(_COOKIE) or ""
            if not secrets.compare_digest(given.encode(), self._token.encode()):
                return None
            handler.set_cookie(_COOKIE, self._token, httponly=True, samesite="Strict")
            return "visitor"

        return known

    @property
    def get_user_async(self) -> None:
        """Return None: there is no second way to find a user."""

    @property
    def login_url(self) -> None:
        """Return None: there is no page where a token could be guessed; `get_login_url` leads to an explanation."""

    @property
    def get_login_url(self) -> Any:
        """Return a function from a request without a token to the page that explains it."""
        return lambda handler: "/token"

    @property
    def login_handler(self) -> None:
        """Return None."""

    @property
    def logout_url(self) -> None:
        """Return None."""

    @property
    def logout_handler(self) -> None:
        """Return None."""


class Refusal(RequestHandler):
    """Answers with a status and a sentence."""

    def initialize(self, status: int = 403, text: str = _TOKEN_MISSING) -> None:
        """Take the status and the sentence; by default those for a missing token."""
        self._answer = status, text

    def prepare(self) -> None:
        """Answer a request of any method."""
        status, text = self._answer
        self.set_status(status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{text}\n")


class RequestFilter(Router):
    """Passes requests to the pages, if their host is known and no further session would be too many.

    A page of another origin cannot read answers of this server, unless its name is made to point to this machine; such
    a request has a foreign host.

    Args:
        pages: The application that answers.
        hosts: Names and numbers, without ports, by which this server is known besides those of this machine.
    """

    def __init__(self, pages: BokehTornado, hosts: tuple[str, ...]) -> None:
        self._pages, self._hosts = pages, {*LOCAL, *map(host_of, hosts)}
        self._refusals = Application()

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> HTTPMessageDelegate | None:
        """Choose who answers a request."""
        if host_of(request.host) not in self._hosts:
            return self._refuse(request, 403, _HOST_UNKNOWN)
        path = request.path.rstrip("/") or "/"
        if path in _SESSION_PATHS and not self._admits(_session(request)):
            return self._refuse(request, 503, _TOO_MANY)
        return self._pages.find_handler(request, **kwargs)

    def _admits(self, asked: str | None) -> bool:
        """Return True if a session is there already, or one more would not be too many."""
        sessions = self._pages.get_sessions("/")
        if any(session.id == asked for session in sessions):
            return True
        waiting = sum(session.connection_count == 0 for session in sessions)
        return len(sessions) < MOST_SESSIONS and waiting < MOST_WAITING

    def _refuse(self, request: HTTPServerRequest, status: int, text: str) -> HTTPMessageDelegate:
        return self._refusals.get_handler_delegate(request, Refusal, {"status": status, "text": text})


def _session(request: HTTPServerRequest) -> str | None:
    """Return the session that the script of a page connects to; None if the request names none."""
    _, _, token = request.headers.get("Sec-WebSocket-Protocol", "").partition(",")
    try:
        return get_session_id(token.strip()) if token else None
    except Exception:  # a token that is none raises errors of many kinds
        return None
