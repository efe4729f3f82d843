"""Refuses requests to the server: a host that is not permitted, a wrong token, or too many open pages."""

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
"""Most sessions (open pages) at a time, because every session holds its own copy of the displayed map."""

MOST_WAITING = 8
"""Most sessions without a connected browser at a time, because creating a session blocks the server for 0.3 s."""

UNUSED_LIFETIME = 10_000
"""Milliseconds after which a session without a connected browser ends."""

UNUSED_CHECK = 2_000
"""Milliseconds between two searches for sessions that are older than `UNUSED_LIFETIME` without a browser."""

_COOKIE = "vijax_explore"
# A request for one of these paths makes Bokeh create a session, unless the request belongs to an existing session.
_SESSION_PATHS = ("/", "/autoload.js", "/metadata", "/ws")
_TOKEN_MISSING = "This page is opened by the whole address that vijax explore printed, with its token."
_HOST_UNKNOWN = (
    "The host of the address must be one that this server accepts; open the address that vijax explore printed, or "
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
        """Return a function from a request handler to a user name, or to None if the request has no valid token."""

        def user(handler: RequestHandler) -> str | None:
            token = handler.get_argument("token", "") or handler.get_cookie(_COOKIE) or ""
            # Constant-time comparison, so that response times reveal nothing about the token.
            if not secrets.compare_digest(token.encode(), self._token.encode()):
                return None
            handler.set_cookie(_COOKIE, self._token, httponly=True, samesite="Strict")
            return "visitor"

        return user

    @property
    def get_user_async(self) -> None:
        """Return None, because `get_user` is not asynchronous; Bokeh permits only one of the two."""

    @property
    def login_url(self) -> None:
        """Return None, because there is no page for logging in; `get_login_url` leads to an explanation."""

    @property
    def get_login_url(self) -> Any:
        """Return a function from a request without a valid token to the address of a page that explains the refusal."""
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
    """Answers every request with a status code and a sentence that explains the refusal."""

    def initialize(self, status: int = 403, text: str = _TOKEN_MISSING) -> None:
        """Store the status code and the sentence; by default those for a missing token."""
        self._answer = status, text

    def prepare(self) -> None:
        """Answer a request before its HTTP method is considered, so that all methods have the same answer."""
        status, text = self._answer
        self.set_status(status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{text}\n")


class RequestFilter(Router):
    """Passes requests to the pages if their host is permitted and the number of sessions is below its limits.

    The check of the host prevents DNS rebinding: a hostile page can read this server's answers if the host name of the
    page is made to point to this machine, but its requests then carry that foreign host name.

    Args:
        pages: The application that answers permitted requests.
        hosts: Permitted hosts in addition to the local ones in `LOCAL`; a port in them is ignored.
    """

    def __init__(self, pages: BokehTornado, hosts: tuple[str, ...]) -> None:
        self._pages, self._hosts = pages, {*LOCAL, *map(host_of, hosts)}
        self._refusals = Application()

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> HTTPMessageDelegate | None:
        """Return the handler of a request: a handler of the pages, or a `Refusal` with status 403 or 503."""
        if host_of(request.host) not in self._hosts:
            return self._refuse(request, 403, _HOST_UNKNOWN)
        path = request.path.rstrip("/") or "/"
        if path in _SESSION_PATHS and not self._admits(_session(request)):
            return self._refuse(request, 503, _TOO_MANY)
        return self._pages.find_handler(request, **kwargs)

    def _admits(self, session_id: str | None) -> bool:
        """Return True if the session exists, or if the numbers of sessions permit a new one."""
        sessions = self._pages.get_sessions("/")
        if any(session.id == session_id for session in sessions):
            return True
        waiting = sum(session.connection_count == 0 for session in sessions)
        return len(sessions) < MOST_SESSIONS and waiting < MOST_WAITING

    def _refuse(self, request: HTTPServerRequest, status: int, text: str) -> HTTPMessageDelegate:
        return self._refusals.get_handler_delegate(request, Refusal, {"status": status, "text": text})


def _session(request: HTTPServerRequest) -> str | None:
    """Return the session identifier in the websocket header of a request; None if there is no valid identifier."""
    _, _, token = request.headers.get("Sec-WebSocket-Protocol", "").partition(",")
    try:
        return get_session_id(token.strip()) if token else None
    except Exception:  # an invalid token raises errors of many types
        return None
