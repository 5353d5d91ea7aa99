"""The server: pages behind their guard."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

from nicegui import app, core, ui
from starlette.requests import Request
from starlette.responses import HTMLResponse

from failuretwin.app.console import act, history, replay, robot, texts, wall
from failuretwin.app.console.desk import Desk
from failuretwin.app.console.guard import COOKIE, Guard
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.users import Session, Sessions
from failuretwin.app.terminal import tell

LOCAL = frozenset({"127.0.0.1", "localhost", "::1"})
"""Names of this computer."""
BEAT_S = 0.25
"""Time between two signs that the server works [s]."""
GOODBYE_S = 5
"""How long connections have to end once the console does [s]."""
PATIENCE_S = 10.0
"""Time that a page may be silent, such as while it draws, before it counts as closed [s]."""
LARGEST_MESSAGE = 1024 * 1024
"""Largest message of a page [bytes]."""


class _WithoutLeavers(logging.Filter):
    """Leaves out browsers that went on before their answer, which Starlette logs as an error."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return str(error) != "No response returned."


def serve(desk: Desk, host: str, port: int, sessions: Sessions) -> None:
    """Show the console at an address until it is stopped."""

    def visit_of(request: Request) -> Visit:
        session = sessions.of(request.cookies.get(COOKIE))
        return Visit.of(desk, session or Session("", "see", ended=True), request)

    _add_pages(desk, visit_of)
    hosts = LOCAL if host in LOCAL else frozenset[str]()

    def stop(name: str) -> str:
        if desk.check is None or not desk.check.running:
            return texts.NO_CHECK
        desk.check.stop(texts.STOPPED_BY.format(name=name))
        return texts.STOP_SENT

    app.add_middleware(Guard, sessions=sessions, hosts=hosts, stop=stop)
    core.app.config.socket_io_js_transports = ["websocket"]

    async def beat() -> None:
        while True:
            desk.beat_s = time.monotonic()
            await asyncio.sleep(BEAT_S)

    app.on_startup(lambda: asyncio.create_task(beat()))
    app.on_startup(desk.start)
    app.on_shutdown(desk.stop)
    logging.getLogger("uvicorn.error").addFilter(_WithoutLeavers())
    tell(f"console: http://{host}:{port} (stop with Ctrl-C)")
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(desk.folder / "nicegui"))
    ui.run(
        host=host,
        port=port,
        title=texts.TITLE,
        favicon=Path(__file__).with_name("icon.svg"),
        language="en-GB",
        dark=None,
        reload=False,
        show=False,
        show_welcome_message=False,
        message_history_length=200,
        reconnect_timeout=PATIENCE_S,
        ws_max_size=LARGEST_MESSAGE,
        timeout_graceful_shutdown=GOODBYE_S,
        server_header=False,
    )


def _add_pages(desk: Desk, visit_of: Callable[[Request], Visit]) -> None:
    @ui.page("/")
    def wall_page(request: Request) -> None:
        wall.show(visit_of(request))

    @ui.page("/robot")
    def robot_page(request: Request, name: str = "") -> None:
        robot.show(visit_of(request), name)

    @ui.page("/replay", response_timeout=60.0)
    async def replay_page(request: Request, name: str = "", run: int = 0, at: float = 0.0) -> None:
        await replay.show(visit_of(request), name, run, at)

    @ui.page("/history")
    async def history_page(request: Request, name: str = "") -> None:
        await history.show(visit_of(request), name)

    @ui.page("/check")
    def check_page(request: Request, name: str = "") -> None:
        with page(visit := visit_of(request), texts.CHECK):
            act.CheckPage(visit, name)

    @ui.page("/import")
    def import_page(request: Request) -> None:
        with page(visit := visit_of(request), texts.IMPORT):
            act.ImportPage(visit)

    @app.get("/technician")
    def technician_page(name: str = "", run: int = 0) -> HTMLResponse:
        return HTMLResponse(act.run_report(desk, name, run))

    @app.get("/report/{number}")
    def report_page(number: int) -> HTMLResponse:
        return HTMLResponse(act.report_page(desk, number))
