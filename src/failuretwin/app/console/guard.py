"""Requests that are refused before any page sees them, and pages that need no script.

Refused are requests of other sites (header Origin), requests that name another host (header Host,
against DNS rebinding), bodies that are too large and floods of events.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from html import escape
from http.cookies import SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from failuretwin.app.console import texts
from failuretwin.app.console.users import Session, Sessions

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

FORM = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<style>:root{{color-scheme:light dark}}body{{font:1rem/1.5 system-ui,sans-serif;max-width:22rem;
margin:10vh auto;padding:0 1rem}}label,input,button{{display:block;width:100%;font:inherit;
box-sizing:border-box}}input,button{{padding:.5rem;margin:.2rem 0 1rem}}
:focus-visible{{outline:3px solid #ffbf47;box-shadow:0 0 0 5px #16191c}}</style>
<main><h1>{title}</h1>{body}</main></html>"""


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
        headers = {
            key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]
        }
        if self._is_foreign(headers):
            await _refuse(scope, receive, send, 403, texts.FOREIGN)
            return
        token = _token(headers)
        path, session = scope["path"], self._sessions.of(token)
        if scope["type"] == "http" and path in ("/login", "/logout", "/stop", ALIVE):
            body = await _form(receive) if scope["method"] == "POST" else None
            answer = self._answer(path, body, token, session)
            await _send(send, *answer)
            return
        if (session is None and not path.startswith("/_nicegui/")) or _is_upload_without(
            path, session
        ):
            if scope["type"] == "websocket":
                await _refuse(scope, receive, send, 403, texts.EXPIRED)
            else:
                await _send(send, 303, "", {"location": "/login"})
            return
        if scope["type"] == "websocket":
            await self._app(scope, _counting(receive), send)
            return
        if int(headers.get("content-length") or 0) > LARGEST_UPLOAD:
            limit = texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2)
            await _refuse(scope, receive, send, 413, texts.REFUSED.format(why=limit))
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
    ) -> tuple[int, str, Mapping[str, str]]:
        """Return status, page and headers of the pages that need no script."""
        if path == ALIVE:
            return (401 if session is None else 200), "", {}
        if path == "/stop":
            if session is None:
                return 303, "", {"location": "/login"}
            said = "" if body is None else self._stop(session.name or texts.THIS_COMPUTER)
            return 200, _stop_page(said), {}
        if path == "/logout" and body is not None:
            self._sessions.sign_out(token)
            return 303, "", {"location": "/login", "set-cookie": f"{COOKIE}=; Max-Age=0; Path=/"}
        if path == "/logout":
            return 303, "", {"location": "/"}
        if body is None:
            return 200, _login_page(""), {}
        name, password = body.get("name", ""), body.get("password", "")
        if self._sessions.waits(name):
            return 429, _login_page(texts.TOO_OFTEN), {}
        made = self._sessions.sign_in(name, password)
        if not made:
            return 401, _login_page(texts.WRONG), {}
        cookie = f"{COOKIE}={made}; HttpOnly; SameSite=Strict; Path=/"
        return 303, "", {"location": "/", "set-cookie": cookie}


def _is_upload_without(path: str, session: Session | None) -> bool:
    """Return whether somebody who is not signed in reaches for more than scripts and styles."""
    return session is None and path.startswith("/_nicegui/client/")


def _token(headers: Mapping[str, str]) -> str | None:
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except Exception:  # any cookie that another program has set
        return None
    return None if morsel is None else morsel.value


def _login_page(wrong: str) -> str:
    body = (
        f'<p role="alert">{escape(wrong)}</p><form method="post" action="/login">'
        f'<label for="name">{texts.NAME}</label><input id="name" name="name" '
        f'autocomplete="username" required autofocus><label for="password">{texts.PASSWORD}</label>'
        '<input id="password" name="password" type="password" autocomplete="current-password" '
        f"required><button>{texts.SIGN_IN}</button></form>"
    )
    return FORM.format(title=texts.LOGIN, body=body)


def _stop_page(said: str) -> str:
    body = (
        f'<p role="status">{escape(said)}</p><form method="post" action="/stop">'
        f"<button>{texts.STOP}</button></form>"
    )
    return FORM.format(title=texts.STOP, body=body)


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


async def _send(send: Send, status: int, page: str, headers: Mapping[str, str]) -> None:
    sent = {"content-type": "text/html; charset=utf-8", "cache-control": "no-store"}
    await send({
        "type": "http.response.start",
        "status": status,
        "headers": [
            (key.encode(), value.encode()) for key, value in {**sent, **HEADERS, **headers}.items()
        ],
    })  # fmt: skip
    await send({"type": "http.response.body", "body": page.encode()})


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": why[:100]})
        return
    await _send(send, status, escape(why), {})


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            known = {key.lower() for key, _ in message["headers"]}
            more = [(k.encode(), v.encode()) for k, v in HEADERS.items() if k.encode() not in known]
            message = {**message, "headers": [*message["headers"], *more]}
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
