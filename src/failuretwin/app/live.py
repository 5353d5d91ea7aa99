"""Watching a robot until its source ends or the time is over: a live view, or a line a change."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import nullcontext
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from failuretwin.app.shadow import SILENCE_S, Change, Changes, Shadow, Snapshot
from failuretwin.app.terminal import tell
from failuretwin.connection.links.base import Event, LinkCounts
from failuretwin.connection.links.statuses import (
    LEVEL_ERROR,
    LEVEL_OK,
    LEVEL_STALE,
    LEVEL_WARN,
    statuses,
)
from failuretwin.core.errors import counted
from failuretwin.core.foreign import printable
from failuretwin.decision.streaming.alarm_rule import movements_to_tell
from failuretwin.decision.streaming.monitor import FaultMonitor
from failuretwin.decision.test_motions.probing import Prober
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.inference.calibration_fit import MISFIT
from failuretwin.inference.explanation import percent

if TYPE_CHECKING:
    from failuretwin.app.keepers import WatchKeeper

REFRESH_S = 0.25
"""Time between two drawings [s]."""
POLL_S = 0.1
"""Longest wait for an event [s]."""
LATE_S = 0.3
"""Delay of a command from which it spoils the diagnosis and is reported [s]."""


class _Screen:
    """Reports changes: in a view on a terminal, else a line for each change."""

    def __init__(
        self, shadow: Shadow, changes: Changes, live: Live | None, keeper: WatchKeeper | None
    ) -> None:
        self.changes = changes
        self._shadow, self._live, self._keeper = shadow, live, keeper
        self._view = View(shadow.twin.robot.motor_names, shadow.source.name)
        self._start_s, self._drawn_s, self._set_up_told = time.monotonic(), 0.0, False

    def look(self, last: bool = False) -> None:
        """Report the changes since the last call."""
        shadow, monitor = self._shadow, self._shadow.monitor
        troubles = troubles_of(shadow, time.monotonic() - self._start_s)
        if self._keeper is not None and self._keeper.trouble:
            troubles += (self._keeper.trouble,)
        jumps = shadow.clock.jumps
        self._tell(*self.changes.notice(shadow.snapshot, shadow.counts, jumps, troubles))
        if monitor is not None and monitor.set_up is not None and not self._set_up_told:
            self._set_up_told = True
            self.say(fit_of(monitor))
        if self._live is None:
            return
        self._view.remember(shadow.snapshot)
        if last or time.monotonic() >= self._drawn_s + REFRESH_S:
            self._drawn_s = time.monotonic()
            picture = self._view.draw(shadow.snapshot, shadow.counts, self.changes.lines)
            self._live.update(picture, refresh=True)

    def hear(self, event: Event | None) -> None:
        """Take an event that was polled elsewhere."""
        self._shadow.hear(event)
        self.look()

    def say(self, text: str) -> None:
        """Report something else."""
        self._tell(self.changes.add(self._shadow.snapshot.stream_time, text))

    def _tell(self, *changes: Change) -> None:
        """Store changes, then tell them."""
        if self._keeper is not None:
            self._keeper.keep(changes, self._shadow.snapshot.answer)
        if self._live is None:
            for change in changes:
                tell(str(change))


def watch_until_end(
    shadow: Shadow,
    changes: Changes,
    console: Console,
    until_s: float,
    prober: Prober | None = None,
    keeper: WatchKeeper | None = None,
) -> None:
    """Watch a robot until `until_s` of our monotonic clock [s], and notice all that changes.

    A terminal gets a live view, other outputs a line for each change. With a prober, one of the
    sinks, the robot makes diagnostic movements when they are due. A keeper stores each change
    before it is told.
    """
    live = Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext()
    with live as shown:
        screen, going = _Screen(shadow, changes, shown, keeper), True
        while going:
            going = shadow.step(POLL_S) and time.monotonic() < until_s
            screen.look(last=not going)
            if going and prober is not None and prober.due:
                prober.ask(screen.hear, screen.say)


def basis_line(known: CalibratedRobot, calibration: Path | None, budget: float, goals: bool) -> str:
    """Return the calibration that the answers rest on, and the delay that lost commands cause.

    Reported `goals` show lost commands at once.
    """
    healthy = known.imperfections
    if healthy.of_class:
        line = (
            f"healthy behaviour: {healthy.name}; {healthy.source}. This robot is not calibrated: "
            "its behaviour is learned as it works, and until then faults take longer to show. "
            "--calibration FILE uses a calibration"
        )
    else:
        written = ""
        if calibration is not None and calibration.is_file():
            day = date.fromtimestamp(calibration.stat().st_mtime).isoformat()
            written = f", written {day}"
        line = f"healthy behaviour: {healthy.name} ({healthy.protocol}; {healthy.source}{written})"
    needed = {} if goals else movements_to_tell(healthy, known.robot.motor_names, budget)
    if not needed:
        return line
    worst = max(needed, key=lambda motor: needed[motor])
    return (
        f"{line}. At these losses a {worst.replace('_', ' ')} that sticks at rest takes about "
        f"{needed[worst]} movements to be told from lost commands"
    )


def fit_of(monitor: FaultMonitor) -> str:
    """Return how well calibration and profile have fitted this robot, in one sentence."""
    fit = monitor.fit
    teachers = counted(fit.learned, "movement")
    if fit.moments and not fit.learned:
        teachers = f"{counted(fit.moments, 'moment')} on its way"
    taught = f"{teachers} taught how this robot is"
    if fit.given:
        own = f"; {taught}" if fit.learned or fit.moments else ""
        said = f"calibration {fit.given!r} is this robot's: {percent(fit.fits)} sure{own}"
    else:
        said = f"no calibration was given; {taught}"
    if monitor.set_up is None:
        return said
    profile = monitor.set_up or "the log fits the profile"
    return f"{said}; after {counted(fit.seen, 'movement')} {profile}"


def troubles_of(shadow: Shadow, since_s: float) -> tuple[str, ...]:
    """Return the obstacles to a diagnosis and its publication, `since_s` [s] after the start."""
    found = [sink.trouble for sink in shadow.sinks if sink.trouble]
    if shadow.source.counts.received == 0 and since_s > SILENCE_S:
        found.append(f"nothing comes from {shadow.source.name}")
    if shadow.reference.late_s >= LATE_S:
        wait = math.ceil(2.0 * shadow.reference.late_s) / 2.0
        found.append(f"commands come late: put commands_late_s = {wait} into the --topics file")
    monitor = shadow.monitor
    if monitor is None:
        return tuple(found)
    found += monitor.rounding
    fit = monitor.fit
    if fit.given and fit.fits < MISFIT and not monitor.set_up:
        found.append(
            f"this robot does not do what calibration {fit.given!r} says: it is judged by what "
            "arms of its kind do and by what it teaches itself"
        )
    return tuple(found)


# The live view: motors, residual, posterior over time, changes.

STYLES = {
    LEVEL_OK: "green",
    LEVEL_WARN: "yellow",
    LEVEL_ERROR: "bold red",
    LEVEL_STALE: "magenta",
}
BLOCKS = " ▁▂▃▄▅▆▇█"
COLUMNS = 60
"""Width of the posterior over time [columns]."""
COLUMN_S = 1.0
"""Time of the stream for each column [s]."""
RESIDUAL_MM = 50.0
"""Residual that fills its bar [mm]."""
BAR = 20
SHOWN_HYPOTHESES = 6
SHOWN_CHANGES = 8


class View:
    """Live view of a shadow."""

    def __init__(self, motors: Sequence[str], source: str) -> None:
        self._motors = motors
        self._source = source
        self._history: deque[dict[str, float]] = deque(maxlen=COLUMNS)
        self._next_s = -np.inf

    def remember(self, snapshot: Snapshot) -> None:
        """Take a snapshot into the posterior over time; time without any is a gap."""
        now_s = snapshot.stream_time
        if now_s < self._next_s:
            return
        if np.isfinite(self._next_s):
            missing = int((now_s - self._next_s) / COLUMN_S)
            self._history.extend([{}] * min(missing, COLUMNS))
        self._next_s = now_s + COLUMN_S
        diagnosis, stale = snapshot.answer.diagnosis, snapshot.answer.state != "OK"
        known = diagnosis is not None and not stale
        self._history.append(dict(diagnosis.posterior) if known and diagnosis else {})

    def draw(
        self, snapshot: Snapshot, counts: LinkCounts, changes: Sequence[Change]
    ) -> RenderableType:
        """Return the view of a snapshot; the newest change is the last."""
        lines = [Text(printable(str(change))) for change in list(changes)[-SHOWN_CHANGES:]]
        return Group(
            self._head(snapshot, counts),
            self._motor_table(snapshot),
            Panel(self._posterior(), title=f"posterior, last {COLUMNS} s", title_align="left"),
            Panel(Group(*lines), title="what changed", title_align="left"),
        )

    def _head(self, snapshot: Snapshot, counts: LinkCounts) -> Text:
        arm = statuses(snapshot.answer, self._motors)[0]
        head = Text(f"{arm.state}:", STYLES[arm.level])
        head.append(f" {printable(arm.message)}\n", "default")
        off = float(np.linalg.norm(snapshot.residual)) * 1000.0
        share = 0.0 if np.isnan(off) else min(1.0, off / RESIDUAL_MM)
        said = "no reading" if np.isnan(off) else f"{off:5.1f} mm off the reference"
        head.append(
            f"{printable(self._source)}  {snapshot.stream_time:.1f} s  {counts.received} events, "
            f"{counts.garbage} garbage, {counts.dropped} dropped, {counts.reconnects} reconnects, "
            f"{1000 * snapshot.seconds:.1f} ms a sample\n",
            "dim",
        )
        head.append(f"tool   {_bar(share)} {said}", "default")
        return head

    def _motor_table(self, snapshot: Snapshot) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("motor", "state", "faulty", "", "how"):
            table.add_column(name)
        for status in statuses(snapshot.answer, self._motors)[1:]:
            probability = float(status.values.get("probability", 0.0))
            table.add_row(
                printable(status.name),
                Text(status.state, STYLES[status.level]),
                f"{100 * probability:5.1f} %" if status.values else "",
                _bar(probability),
                printable(status.message),
            )
        return table

    def _posterior(self) -> Table:
        """Return the posterior over time, a row for each hypothesis that ever mattered."""
        weight = Counter[str]()
        for column in self._history:
            weight.update(column)
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, _ in weight.most_common(SHOWN_HYPOTHESES):
            blocks = "".join(_block(column.get(name)) for column in self._history)
            last = self._history[-1].get(name)
            table.add_row(printable(name), blocks, "" if last is None else f"{100 * last:5.1f} %")
        return table


def _bar(share: float) -> str:
    full = round(BAR * share)
    return "█" * full + "·" * (BAR - full)


def _block(probability: float | None) -> str:
    if probability is None:
        return "?"
    return BLOCKS[round(probability * (len(BLOCKS) - 1))]
