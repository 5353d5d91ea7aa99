"""What the console does with care: test movements that anyone can stop, and logs that come in."""

from __future__ import annotations

import re
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

from nicegui import events, ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.checking import CheckRun, beat_watch
from failuretwin.app.console.desk import Desk, Imported
from failuretwin.app.console.guard import LARGEST_UPLOAD
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.users import MOVE
from failuretwin.app.reports.check_report import check_lines, closing_lines
from failuretwin.app.terminal import Table
from failuretwin.connection.links.base import Commander
from failuretwin.connection.links.replay import Pace
from failuretwin.core.errors import FailureTwinError
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
SUFFIXES = (".nc", ".csv", ".mat", ".bag", ".mcap", ".db3", ".parquet")
"""Files that are taken."""
LABELS = f"""for (const one of document.querySelectorAll(".q-uploader__input, .q-uploader a"))
one.setAttribute("aria-label", "{texts.DROP_LABEL}")"""
"""Names the parts of the upload for screen readers."""
REPORTS = 20
"""Pages for technicians that are kept."""


# Checks.


def show_check(visit: Visit, name: str) -> None:
    """Draw the page of checks."""
    with page(visit, texts.CHECK):
        CheckPage(visit, name)


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


@dataclass(frozen=True)
class Arrived:
    """A log that arrived, as it lies in our folder."""

    path: Path
    name: str


def show_import(visit: Visit) -> None:
    """Draw the page for logs."""
    from failuretwin.digital_model.robot import bundled_robots

    desk = visit.desk
    own = desk.known.robot.name
    with page(visit, texts.IMPORT):
        with ui.row().classes("gap-4 items-end"):
            kinds = sorted({own, *bundled_robots()})
            kind = draw.Choice(kinds, own, texts.PROFILE)
            robot = ui.input(texts.ROBOT_NAME).props("maxlength=64").classes("w-64")
        status = ui.element("div").props('role="status"')

        async def take(event: events.UploadEventArguments) -> None:
            status.clear()
            with status:
                draw.text(texts.WORKING)
            data = await event.file.read()
            arrived = _placed(desk.folder, event.file.name, data)
            wanted = str(robot.value or "").strip() if visit.confirms else ""
            found = None
            if isinstance(arrived, str):
                ui.notify(arrived, type="negative", multi_line=True)
            else:
                found = await draw.worked(desk.diagnose, arrived.path, kind.value, wanted)
            status.clear()
            if found is not None:
                with status:
                    await _show_imported(visit, found, kind.value)

        upload = ui.upload(
            label=texts.DROP,
            on_upload=take,
            auto_upload=True,
            max_file_size=LARGEST_UPLOAD,
            max_files=20,
            on_rejected=lambda: ui.notify(
                texts.REFUSED.format(why=texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2)),
                type="negative",
            ),
        )
        upload.classes("w-full")
        ui.timer(0.2, lambda: ui.run_javascript(LABELS), once=True)


def _placed(folder: Path, name: str, data: bytes) -> Arrived | str:
    """Write a log under a name of our own, or return why it is refused."""
    stem, suffix = Path(name.replace("\\", "/")).stem, Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        why = f"{printable(name)[:80]}: expected one of {', '.join(SUFFIXES)}"
        return texts.REFUSED.format(why=why)
    if len(data) > LARGEST_UPLOAD:
        return texts.REFUSED.format(why=texts.TOO_LARGE.format(limit=LARGEST_UPLOAD // 1024**2))
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", stem)[:64] or "log"
    place = Path(tempfile.mkdtemp(dir=folder))
    path = place / f"{safe}{suffix}"
    path.write_bytes(data)
    return Arrived(path, safe)


async def _show_imported(visit: Visit, found: Imported, kind: str) -> None:
    known = visit.desk.of_kind(kind)
    if known is None:
        return
    state, words = (
        robot_state(found.diagnoses, known.robot),
        partial(visit.words, robot=known.robot),
    )
    draw.heading(words(state.headline))
    draw.text(words(state.step))
    rows = [[one.run, words(one.verdict)] for one in found.diagnoses]
    draw.table((texts.RUN, texts.VERDICT), rows)
    for line in found.stored or [texts.NOT_STORED]:
        draw.text(line)
    number = await draw.worked(_report, visit.desk, found, known)
    if number is not None:
        ui.link(texts.REPORT, f"/report/{number}", new_tab=True)


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
