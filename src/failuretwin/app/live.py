"""Watching a robot: until its source ends or the time is over, in a live view or line by line."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

from rich.console import Console
from rich.live import Live

from failuretwin.app.live_view import View
from failuretwin.app.shadow import SILENCE_S, Changes, Shadow
from failuretwin.app.terminal import tell
from failuretwin.connection.links.base import Event, LinkCounts, Sink, Source
from failuretwin.core.errors import counted
from failuretwin.decision.streaming.monitor import FaultMonitor, Fit
from failuretwin.decision.test_motions.probing import Prober
from failuretwin.inference.calibration_fit import MISFIT
from failuretwin.inference.explanation import percent

REFRESH_S = 0.25
"""Time between two drawings [s]."""
POLL_S = 0.1
"""Longest wait for an event [s]."""
LATE_S = 0.3
"""A command that comes later than this spoils the diagnosis, and the user is told [s]."""


@dataclass
class _Screen:
    """Tells what changes: a view on a terminal, else a line for each change."""

    shadow: Shadow
    source: Source
    sinks: Sequence[Sink]
    monitor: FaultMonitor | None
    changes: Changes
    view: View
    live: Live | None

    def __post_init__(self) -> None:
        self._begun_s, self._drawn_s, self._looked = time.monotonic(), 0.0, False

    def look(self, last: bool = False) -> None:
        """Tell what has changed since the last call."""
        shadow, changes, monitor = self.shadow, self.changes, self.monitor
        troubles = _troubles(shadow, self.source, self.sinks, time.monotonic() - self._begun_s)
        if monitor is not None:
            troubles += monitor.rounding
            troubles += () if monitor.set_up else _misfit(monitor.fit)
        counts = _with_stamps(self.source.counts, shadow.senseless_stamps)
        found = changes.notice(shadow.snapshot, counts, shadow.clock_jumps, troubles)
        if monitor is not None and monitor.set_up is not None and not self._looked:
            self._looked = True
            found.append(changes.add(shadow.snapshot.stream_time, fit_of(monitor)))
        if self.live is None:
            for change in found:
                tell(str(change))
            return
        self.view.remember(shadow.snapshot)
        if last or time.monotonic() >= self._drawn_s + REFRESH_S:
            self._drawn_s = time.monotonic()
            picture = self.view.draw(shadow.snapshot, self.source.counts, changes.lines)
            self.live.update(picture, refresh=True)

    def hear(self, event: Event | None) -> None:
        """Take an event that was polled elsewhere."""
        self.shadow.hear(event)
        self.look()

    def say(self, text: str) -> None:
        """Tell something else."""
        change = self.changes.add(self.shadow.snapshot.stream_time, text)
        if self.live is None:
            tell(str(change))


def watch_until_end(
    shadow: Shadow,
    source: Source,
    sinks: Sequence[Sink],
    motors: list[str],
    console: Console,
    until_s: float,
    monitor: FaultMonitor | None = None,
    prober: Prober | None = None,
) -> Changes:
    """Watch a robot until `until_s` of our monotonic clock [s], and return all that has changed.

    With a monitor it is told how well its calibration and the profile fit, once it has seen enough.
    With a prober, one of the sinks, the robot is asked by movements when it is time to.
    On a terminal there is a live view, else a line for each change.
    """
    live = Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext()
    with live as shown:
        told = Changes(motors), View(motors, source.name), shown
        screen, going = _Screen(shadow, source, sinks, monitor, *told), True
        while going:
            going = shadow.step(POLL_S) and time.monotonic() < until_s
            screen.look(last=not going)
            if going and prober is not None and prober.due:
                prober.ask(screen.hear, screen.say)
    return screen.changes


def _with_stamps(counts: LinkCounts, senseless: int) -> LinkCounts:
    """Return what a link has seen, with stamps that make no sense among what makes none."""
    if not senseless:
        return counts
    last = counts.last_garbage or "stamps that leap; such events count when they come"
    return replace(counts, garbage=counts.garbage + senseless, last_garbage=last)


def _misfit(fit: Fit) -> tuple[str, ...]:
    """Return that the calibration is not this robot's, if that is so."""
    if not fit.given or fit.fits >= MISFIT:
        return ()
    return (
        f"this robot does not do what calibration {fit.given!r} says: it is judged by what arms of "
        "its kind do and by what it teaches itself",
    )


def fit_of(monitor: FaultMonitor) -> str:
    """Return how well calibration and profile have fitted this robot, in one sentence."""
    fit = monitor.fit
    taught = f"{fit.learned} movements taught how this robot is"
    if fit.given:
        own = f"; {taught}" if fit.learned else ""
        said = f"calibration {fit.given!r} is this robot's: {percent(fit.fits)} sure{own}"
    else:
        said = f"no calibration was given; {taught}"
    if monitor.set_up is None:
        return said
    profile = monitor.set_up or "the log fits the profile"
    return f"{said}; after {counted(fit.seen, 'movement')} {profile}"


def _troubles(
    shadow: Shadow, source: Source, sinks: Sequence[Sink], since_s: float
) -> tuple[str, ...]:
    """Return what keeps the diagnosis from being made or told, after listening for so long [s]."""
    found = [sink.trouble for sink in sinks if sink.trouble]
    if source.counts.received == 0 and since_s > SILENCE_S:
        found.append(f"nothing comes from {source.name}")
    if shadow.late_s >= LATE_S:
        wait = math.ceil(2.0 * shadow.late_s) / 2.0
        found.append(f"commands come late: put commands_late_s = {wait} into the --topics file")
    return tuple(found)
