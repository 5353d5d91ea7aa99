"""Requests that are refused before any page sees them, and pages that need no script.

Refused are requests of other sites (header Origin), requests that name another host (header Host,
against DNS rebinding), bodies that are too large and floods of events.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse
from starlette.websockets import WebSocketClose

from failuretwin.app.console import texts
from failuretwin.app.console.users import Session, Sessions
from failuretwin.app.reports.plots import render_page

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "failuretwin_session"
ALIVE = "/alive"
"""Answers 200 to a page whose session goes on, else 401."""
LARGEST_UPLOAD = 64 * 1024 * 1024
"""Largest body of a request [bytes]."""
LARGEST_FORM = 64 * 1024
HOST = re.compile(r"(\[[0-9a-fA-F:]+\]|[A-Za-z0-9_.-]+)(?::\d+)?")
"""A host name or address, and a port."""
MOST_EVENTS, EVENTS_S = 400, 2.0
"""Messages that a page may send in so many seconds."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' ws: wss:; worker-src 'self' blob:; object-src 'none'; base-uri 'none'; "
    "frame-ancestors 'none'; form-action 'self'"
)
"""Browsers load nothing from other hosts."""
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
}


class Guard:
    """Refuses what must not reach the pages, and signs people in and out.

    Args:
        app: The pages.
        sessions: Sessions.
        hosts: Host names that requests may name; empty: any, where people sign in.
        stop: Stops a check; takes who says so and returns what happened.
    """

    def __init__(
        self, app: ASGIApp, sessions: Sessions, hosts: frozenset[str], stop: Callable[[str], str]
    ) -> None:
        self._app, self._sessions, self._hosts, self._stop = app, sessions, hosts, stop

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers, path, is_socket = Headers(scope=scope), scope["path"], scope["type"] == "websocket"
        if self._is_foreign(headers):
            await _refusal(is_socket, 403, texts.FOREIGN)(scope, receive, send)
            return
        token = cookie_parser(headers.get("cookie", "")).get(COOKIE)
        session = self._sessions.of(token)
        if not is_socket and path in ("/login", "/logout", "/stop", ALIVE):
            body = await _form(receive) if scope["method"] == "POST" else None
            await self._answer(path, body, token, session)(scope, receive, send)
            return
        static = path.startswith("/_nicegui/") and not path.startswith("/_nicegui/client/")
        if session is None and not static:
            login = _refusal(True, 403, texts.EXPIRED) if is_socket else _redirect("/login")
            await login(scope, receive, send)
            return
        if is_socket:
            await self._app(scope, _counting(receive), send)
            return
        if int(headers.get("content-length") or 0) > LARGEST_UPLOAD:
            limit = texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2)
            refusal = _refusal(False, 413, texts.REFUSED.format(why=limit))
            await refusal(scope, receive, send)
            return
        await self._app(scope, _limited(receive), _with_headers(send))

    def _is_foreign(self, headers: Mapping[str, str]) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        name = HOST.fullmatch(host)
        if name is None or (self._hosts and name[1].strip("[]") not in self._hosts):
            return True
        return origin is not None and urlsplit(origin).netloc != host

    def _answer(
        self, path: str, body: Mapping[str, str] | None, token: str | None, session: Session | None
    ) -> HTMLResponse:
        """Return the answer of the pages that need no script."""
        if path == ALIVE:
            return _response(401 if session is None else 200)
        if path == "/stop":
            if session is None:
                return _redirect("/login")
            said = "" if body is None else self._stop(session.name or texts.THIS_COMPUTER)
            return _response(200, _page("/stop", texts.STOP, texts.STOP, "status", said))
        if path == "/logout" and body is not None:
            self._sessions.sign_out(token)
            return _redirect("/login", f"{COOKIE}=; Max-Age=0; Path=/")
        if path == "/logout":
            return _redirect("/")
        if body is None:
            return _response(200, _login_page(""))
        name, password = body.get("name", ""), body.get("password", "")
        if self._sessions.waits(name):
            return _response(429, _login_page(texts.TOO_OFTEN))
        made = self._sessions.sign_in(name, password)
        if not made:
            return _response(401, _login_page(texts.WRONG))
        return _redirect("/", f"{COOKIE}={made}; HttpOnly; SameSite=Strict; Path=/")


def _login_page(wrong: str) -> str:
    return _page("/login", texts.LOGIN, texts.SIGN_IN, "alert", wrong)


def _page(path: str, title: str, press: str, role: str, said: str) -> str:
    """Return a page that says something, and sends a form to a path when its button is pressed."""
    values = {"path": path, "title": title, "press": press, "role": role, "said": said}
    return render_page("form.html.j2", {**values, "texts": texts})


async def _form(receive: Receive) -> dict[str, str]:
    """Return the fields of a form; one that is too large, or has too many, has none."""
    body, more = b"", True
    while more and len(body) <= LARGEST_FORM:
        message = await receive()
        body, more = body + message.get("body", b""), message.get("more_body", False)
    if len(body) > LARGEST_FORM:
        return {}
    try:
        fields = parse_qs(body.decode("utf-8", "replace"), max_num_fields=10)
    except ValueError:
        return {}
    return {name: values[0] for name, values in fields.items()}


def _response(status: int, page: str = "") -> HTMLResponse:
    return HTMLResponse(page, status, {"cache-control": "no-store", **HEADERS})


def _redirect(to: str, cookie: str = "") -> HTMLResponse:
    response = _response(303)
    response.headers["location"] = to
    if cookie:
        response.headers["set-cookie"] = cookie
    return response


def _refusal(is_socket: bool, status: int, why: str) -> ASGIApp:
    return WebSocketClose(1008, why[:100]) if is_socket else _response(status, escape(why))


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            given = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                given.setdefault(name, value)
        await send(message)

    return sending


def _limited(receive: Receive) -> Receive:
    """Return a body that ends, as if its sender had left, once it is too large."""
    seen = 0

    async def receiving() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        return {"type": "http.disconnect"} if seen > LARGEST_UPLOAD else message

    return receiving


def _counting(receive: Receive) -> Receive:
    """Return messages of a page, which is left once it sends a flood."""
    begun_s, count = time.monotonic(), 0

    async def receiving() -> Message:
        nonlocal begun_s, count
        message: dict[str, Any] = dict(await receive())
        now_s = time.monotonic()
        if now_s - begun_s > EVENTS_S:
            begun_s, count = now_s, 0
        count += 1
        if count > MOST_EVENTS:
            return {"type": "websocket.disconnect", "code": 1008, "reason": texts.FLOOD}
        return message

    return receiving
