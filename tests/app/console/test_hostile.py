"""Hostile inputs: refused or shown as text, and the console works on."""

from __future__ import annotations

import http.client
import urllib.parse
from contextlib import closing

import pytest

from console_server import PASSWORD

pytest.importorskip("nicegui")

MARKUP = (
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    '"><svg onload=alert(1)>',
    "</title><script>alert(1)</script>",
    "{{constructor.constructor('alert(1)')()}}",
    "javascript:alert(1)",
    "\u202egnp.exe",
    "a\x00b",
    "../" * 40,
    "x" * 5000,
)
PATHS = (
    "/../../../../etc/passwd",
    "/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/_nicegui/../../etc/passwd",
    "/_nicegui/%2e%2e/%2e%2e/etc/passwd",
    "/_nicegui/3.18.0/static/..%2f..%2f..%2fetc/passwd",
    "/_nicegui/3.18.0/components/..%2f..%2fetc/passwd",
    "/report/..%2f..%2fetc%2fpasswd",
    "/report/-1",
    "/report/1e9",
    "/static/%00",
    "//evil.example/",
    "/robot?name=a&name=b&run=%ff",
    "/replay?name=x&run=99999999999999999999999",
    "/replay?name=x&run=1%20OR%201=1",
    "/history?name='; DROP TABLE robots; --".replace(" ", "%20"),
)
COOKIES = (
    "failuretwin_session=",
    "failuretwin_session=ada",
    "failuretwin_session=" + "A" * 43,
    "failuretwin_session=" + "A" * 9000,
    "failuretwin_session=../../etc/passwd",
    "failuretwin_session=%00",
    'failuretwin_session="',
    "failuretwin_session=a; failuretwin_session=b",
    "failuretwin_session[]=a",
    "=; ;;;=;",
    "role=move; name=ada",
)
FOREIGN = (
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:1"},
    {"Origin": "https://127.0.0.1.evil.example"},
    {"Host": "evil.example"},
    {"Host": "127.0.0.1.evil.example"},
    {"Host": "evil.example:80@127.0.0.1"},
)


def answer(server, method, path, headers=None, body=None):
    """Return status, headers and body of a request, sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    with closing(connection):
        connection.putrequest(method, path, skip_host="Host" in (headers or {}))
        data = (body or "").encode()
        told = {"Content-Length": str(len(data))} if body is not None else {}
        for name, value in {**told, **(headers or {})}.items():
            connection.putheader(name, value)
        connection.endheaders(data or None)
        found = connection.getresponse()
        return found.status, dict(found.getheaders()), found.read().decode("utf-8", "replace")


@pytest.fixture(scope="module")
def session(server):
    form = urllib.parse.urlencode({"name": "eve", "password": PASSWORD})
    status, headers, _ = answer(server, "POST", "/login", body=form)
    assert status == 303
    told = headers["set-cookie"]
    assert "HttpOnly" in told
    assert "SameSite=Strict" in told
    return told.partition(";")[0]


@pytest.mark.parametrize("name", MARKUP, ids=range(len(MARKUP)))
def test_markup_in_a_name_is_text(server, session, name):
    path = "/robot?name=" + urllib.parse.quote(name, safe="")
    status, _, page = answer(server, "GET", path, {"Cookie": session})
    assert status == 200
    assert "<script>alert" not in page
    assert "<img src=x" not in page
    assert "<svg onload" not in page


@pytest.mark.parametrize("path", PATHS, ids=range(len(PATHS)))
def test_a_path_leads_nowhere(server, session, path):
    for cookie in ({}, {"Cookie": session}):
        status, _, page = answer(server, "GET", path, cookie)
        assert status in (200, 303, 307, 400, 404, 422)
        assert "root:" not in page
        assert "Traceback" not in page


@pytest.mark.parametrize("cookie", COOKIES, ids=range(len(COOKIES)))
def test_a_forged_session_is_none(server, cookie):
    status, headers, page = answer(server, "GET", "/", {"Cookie": cookie})
    assert (status, page) == (303, "")
    assert headers["location"] == "/login"


@pytest.mark.parametrize("headers", FOREIGN, ids=range(len(FOREIGN)))
def test_another_site_is_refused(server, session, headers):
    for method, path in (("GET", "/"), ("POST", "/stop"), ("POST", "/login")):
        status, _, _ = answer(server, method, path, {"Cookie": session, **headers}, "")
        assert status in (400, 403)


def test_a_huge_upload_is_refused(server, session):
    path = "/_nicegui/client/x/upload/1"
    headers = {"Cookie": session, "Content-Length": str(10**9)}
    status, _, page = answer(server, "POST", path, headers)
    assert status == 413
    assert "larger than 64 MB" in page


@pytest.mark.parametrize(
    "body", ["name=" + "x" * 10**6, "name=%ff%fe&password=%00", "&" * 50, "name=ada", ""]
)
def test_a_strange_form_signs_nobody_in(server, body):
    status, headers, _ = answer(server, "POST", "/login", body=body)
    assert status in (401, 429)
    assert "set-cookie" not in headers


def test_guessing_a_password_has_to_wait(server):
    form = urllib.parse.urlencode({"name": "mallory", "password": "guess"})
    found = [answer(server, "POST", "/login", body=form)[0] for _ in range(6)]
    assert found == [401] * 5 + [429]


def test_sockets_of_strangers_are_closed(server, session):
    sync = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import WebSocketException

    url = f"ws://127.0.0.1:{server.port}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    for headers in ({}, {"Cookie": session, "Origin": "http://evil.example"}):
        with pytest.raises(WebSocketException):
            sync.connect(url, additional_headers=headers).recv(timeout=10)


def test_a_flood_of_events_ends_its_connection_alone(server, session):
    sync = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import ConnectionClosed

    url = f"ws://127.0.0.1:{server.port}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"

    def flood():
        with sync.connect(url, additional_headers={"Cookie": session}) as socket:
            for _ in range(5000):
                socket.send('42["event",{"id":1}]')
            while True:
                socket.recv(timeout=10)

    with pytest.raises((ConnectionClosed, TimeoutError)) as ended:
        flood()
    assert ended.type is not TimeoutError
    assert answer(server, "GET", "/", {"Cookie": session})[0] == 200
