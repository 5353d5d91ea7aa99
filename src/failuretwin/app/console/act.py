"""What the console does with care: test movements that anyone can stop, and logs that come in."""

from __future__ import annotations

import re
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from html import escape
from pathlib import Path

from nicegui import events, run, ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.checking import CheckRun, beat_watch
from failuretwin.app.console.desk import Desk, Imported
from failuretwin.app.console.guard import LARGEST_UPLOAD
from failuretwin.app.console.layout import Visit
from failuretwin.app.console.users import MOVE
from failuretwin.app.reports.check_report import check_lines, closing_lines
from failuretwin.app.terminal import Table
from failuretwin.connection.links.base import Commander
from failuretwin.connection.links.replay import Pace
from failuretwin.core.errors import FailureTwinError, InputError
from failuretwin.core.foreign import printable
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.robot_state import robot_state
from failuretwin.decision.test_motions.health_check import Checking, CheckResult
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.inference.diagnoser import BayesDiagnoser

LINES_S = 0.5
"""Time between two updates of a check [s]."""
SHORTEST_CHECK_S, LONGEST_CHECK_S = 5.0, 120.0
BEAT = "<script>setInterval(() => window.socket?.connected && emitEvent('beat'), 1000)</script>"
"""Signs of a page that it works: its arm is stopped if they stay away."""
SUFFIXES = (".nc", ".csv", ".mat", ".bag", ".mcap", ".db3")
ENDINGS = ", ".join(SUFFIXES)
"""Endings of the files that are taken."""
LABELS = f"""for (const one of document.querySelectorAll(".q-uploader__input, .q-uploader a"))
one.setAttribute("aria-label", "{texts.DROP_LABEL}")"""
"""Names the parts of the upload for screen readers."""
REPORTS = 20
"""Pages for technicians that are kept."""


# Checks.


class CheckPage:
    """Starts a check of a robot, shows what happens, and stops it.

    Only the arm of that name tells of it: that of its source, or the one emulated here. Any other
    is an emulated arm of the kind, whose result is not stored.
    """

    def __init__(self, visit: Visit, name: str) -> None:
        desk = visit.desk
        live = desk.live.get(name)
        place = live.settings.place if live is not None else ""
        self._visit, self._name = visit, name
        known = desk.robot(name) if name else desk.known
        if known is None:
            draw.text(texts.NO_ROBOT)
            return
        self._known = known
        self._real = bool(place) and desk.move
        self._own = self._real or (live is not None and live.settings.faults is not None)
        kind = known.robot.name
        self._title = name if self._own else texts.EMULATED.format(kind=kind)
        if name:
            ui.link(name, draw.link_to("robot", name=name))
        where = texts.REAL_ARM.format(place=place) if self._real else texts.EMULATED_ARM
        rehearsal = texts.REHEARSAL.format(kind=kind, name=name or texts.A_ROBOT)
        draw.text(texts.CHECK_NOTE.format(place=where) if self._own else rehearsal)
        if place and not desk.move:
            draw.text(texts.NO_MOVE)
        self._seconds = ui.number(texts.SECONDS, value=20).classes("w-32")
        with ui.row().classes("gap-4 items-center"):
            if visit.session.may(MOVE):
                draw.button(texts.START, self._start)
            else:
                draw.text(texts.START_NOT_ALLOWED.format(role=MOVE))
            # A form: it works without scripts, so also when the page hangs.
            with ui.element("form").props('method="post" action="/stop" target="stop"'):
                stop = draw.text(texts.STOP, "button").props('type="submit"')
                stop.classes("state state-alarm text-lg font-bold px-6 py-2")
        draw.text(texts.STOP_NOTE).classes("soft")
        ui.element("iframe").props(f'name="stop" title="{texts.STOP}"').classes("hidden")
        self._lines = ui.element("div").props('role="log" aria-live="polite"')
        self._shown: list[object] = []
        ui.timer(LINES_S, self._update)
        self._beat_s = time.monotonic()
        ui.on("beat", self._beat)
        ui.add_body_html(BEAT)

    def _beat(self) -> None:
        """Note that the page works."""
        self._beat_s = time.monotonic()

    def _start(self) -> None:
        desk, known, name, own = self._visit.desk, self._known, self._name, self._own
        if not self._visit.allows(MOVE):
            return
        if desk.check is not None and desk.check.running:
            ui.notify(texts.BUSY, type="negative")
            return
        seconds = self._seconds.value
        if seconds is None or not SHORTEST_CHECK_S <= seconds <= LONGEST_CHECK_S:
            ends = {"low": SHORTEST_CHECK_S, "high": LONGEST_CHECK_S}
            ui.notify(texts.SECONDS_RANGE.format(got=seconds, **ends), type="negative")
            return
        self._beat()
        desk.check = CheckRun(
            self._title,
            Checking(known, SafetyGate(known.robot)),
            lambda stack: _arm(desk, known, name if own else "", self._real, stack),
            beat_watch(lambda: desk.beat_s, lambda: self._beat_s),
            lambda result: _keep(desk, known, name if own else "", result),
        )
        desk.check.start(float(seconds))

    def _update(self) -> None:
        check = self._visit.desk.check
        now: list[object] = [] if check is None else [*check.lines, check.result]
        if check is None or check.robot != self._title or now == self._shown:
            return
        self._shown = now
        self._lines.clear()
        with self._lines:
            for line in check.lines:
                draw.text(self._visit.words(line, self._known.robot))
            if check.result is not None:
                _result(check.result, self._known, self._visit)


def _arm(desk: Desk, known: CalibratedRobot, name: str, real: bool, stack: ExitStack) -> Commander:
    """Return the arm that a check moves."""
    from failuretwin.app.arms import commander_of, emulation_with, known_arm
    from failuretwin.app.commands.options import ArmOptions
    from failuretwin.connection.emulated_arm import EmulatedArm

    live = desk.live.get(name)
    if real and live is not None:
        return commander_of(
            ArmOptions(live.settings.place, (), True, live.settings.topics), known, 0, stack
        )
    faults = live.settings.faults if live is not None else None
    emulation = emulation_with(faults or (), known_arm(known.robot), int(time.time()))
    return stack.enter_context(EmulatedArm(emulation, Pace(desk.speed)))


def _keep(desk: Desk, known: CalibratedRobot, name: str, result: CheckResult) -> None:
    """Store the result of a check; no name: it is nobody's."""
    record = desk.record(name, known)
    if record is not None:
        record.remember_check([result])
        desk.look()


def _result(result: CheckResult, known: CalibratedRobot, visit: Visit) -> None:
    words = partial(visit.words, robot=known.robot)
    for part in [*check_lines(result, known.robot, 0.0), *closing_lines(result, known.robot)]:
        if isinstance(part, Table):
            draw.table(part.headings, [[words(cell) for cell in row] for row in part.rows])
        else:
            draw.text(words(part))


# Logs.


class ImportPage:
    """Takes logs, and says below each what it shows, or why it is refused and how to mend that."""

    def __init__(self, visit: Visit) -> None:
        from failuretwin.digital_model.robot import bundled_robots

        desk = visit.desk
        self._visit, self._stores = visit, visit.confirms and desk.store is not None
        own = desk.known.robot.name
        with ui.row().classes("gap-4 items-end"):
            kinds = sorted({own, *bundled_robots()})
            self._kind = draw.Choice(kinds, own, texts.PROFILE)
            if self._stores:
                self._robot = ui.input(texts.ROBOT_NAME).props("maxlength=64").classes("w-64")
        limit = texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2)
        upload = ui.upload(
            label=texts.DROP.format(endings=ENDINGS),
            on_upload=self._take,
            auto_upload=True,
            max_file_size=LARGEST_UPLOAD,
            on_rejected=lambda: self._refuse(texts.REJECTED.format(limit=limit)),
        )
        upload.on("uploaded", upload.reset)  # its list has a tick for files that are refused too
        upload.classes("w-full")
        self._status = ui.element("div").props('role="status"')
        ui.timer(0.2, lambda: ui.run_javascript(LABELS), once=True)

    async def _take(self, event: events.UploadEventArguments) -> None:
        data = await event.file.read()
        try:
            log = placed(self._visit.desk.folder, event.file.name, data)
        except InputError as error:
            self._refuse(str(error))
        else:
            await self._read(log)

    async def _read(self, log: Path, columns: str = "") -> None:
        """Diagnose a log, by a map of its columns (TOML) if there is one."""
        desk, kind = self._visit.desk, self._kind.value
        self._status.clear()
        with self._status:
            draw.text(texts.READING.format(name=log.name))
        name = str(self._robot.value or "").strip() if self._stores else ""
        try:
            found = await run.io_bound(desk.diagnose, log, kind, name, columns)
        except FailureTwinError as error:
            self._refuse(str(error).replace(f"{log.parent}/", ""), log, columns)
            return
        self._status.clear()
        if found is not None:
            with self._status:
                await self._show(log.name, found, kind)

    def _refuse(self, why: str, log: Path | None = None, columns: str = "") -> None:
        """Say why a log is refused; where a map of its columns would help, ask for it."""
        asks = bool(columns) or "--columns" in why
        for option, place in texts.FIELDS.items():
            why = why.replace(option, place)
        self._status.clear()
        with self._status:
            draw.alert(texts.REFUSED.format(why=why))
            if log is None or not asks:
                return
            known = self._visit.desk.of_kind(self._kind.value)
            guess = columns or guessed_columns(log, known)
            field = ui.textarea(texts.COLUMNS, value=guess).props("outlined autogrow")
            field.classes("w-full font-mono")
            draw.button(texts.READ_AGAIN, lambda: self._read(log, str(field.value)))

    async def _show(self, log: str, found: Imported, kind: str) -> None:
        visit, known = self._visit, self._visit.desk.of_kind(kind)
        if known is None:
            return
        state = robot_state(found.diagnoses, known.robot)
        words = partial(visit.words, robot=known.robot)
        draw.heading(words(f"{log}: {state.headline}"))
        draw.text(words(state.step))
        rows = [[one.run, words(one.verdict)] for one in found.diagnoses]
        draw.table((texts.RUN, texts.VERDICT), rows)
        unnamed = texts.NO_NAME if self._stores else texts.NOWHERE_TO_STORE
        role = texts.NOT_BY_YOU.format(role=visit.session.role)
        for line in found.stored or [unnamed if visit.confirms else role]:
            draw.text(line)
        number = await draw.worked(_report, visit.desk, found, known)
        if number is not None:
            ui.link(texts.REPORT, f"/report/{number}", new_tab=True)


def placed(folder: Path, name: str, data: bytes) -> Path:
    """Write a log under a name of our own, and return where it is.

    Raises:
        InputError: If it is of no kind that can be read.
    """
    stem, suffix = Path(name.replace("\\", "/")).stem, Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(texts.OTHER_ENDING.format(name=printable(name)[:80], endings=ENDINGS))
    if len(data) > LARGEST_UPLOAD:
        raise InputError(texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2))
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", stem)[:64] or "log"
    path = Path(tempfile.mkdtemp(dir=folder)) / f"{safe}{suffix}"
    path.write_bytes(data)
    return path


def guessed_columns(log: Path, known: CalibratedRobot | None) -> str:
    """Return a guess of the columns of a table (TOML), to be checked; empty: there is none."""
    from failuretwin.data_knowledge.readers.column_guess import column_map_text

    if log.suffix != ".csv" or known is None:
        return ""
    try:
        return column_map_text(log, known.robot)
    except InputError:
        return ""


def _report(desk: Desk, found: Imported, known: CalibratedRobot) -> int:
    """Write the page for technicians, and return its number."""
    from failuretwin.app.reports.technician_page import write_report

    state = robot_state(found.diagnoses, known.robot)
    folder = Path(tempfile.mkdtemp(dir=desk.folder)) / "report"
    write_report(found.runs, found.diagnoses, known.twin, state, folder)
    number = max(desk.reports, default=0) + 1
    desk.reports[number] = (folder / "index.html").read_text("utf-8")
    for old in sorted(desk.reports)[:-REPORTS]:
        del desk.reports[old]
    return number


def run_report(desk: Desk, name: str, row: int) -> str:
    """Return the page for technicians on a run of a robot in the store."""
    try:
        runs, known = desk.stored_log(name, row)
    except FailureTwinError as error:
        return f"<p>{escape(printable(str(error)))}</p>"
    diagnoses = BayesDiagnoser(known.twin, known.imperfections).diagnose(runs)
    return report_page(desk, _report(desk, Imported(runs, diagnoses, ()), known))


def report_page(desk: Desk, number: int) -> str:
    """Return a page for technicians."""
    return desk.reports.get(number) or f"<p>{escape(texts.NOTHING)}</p>"
