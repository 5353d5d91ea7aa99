"""Robots that are watched while the console is open, each in a thread."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Thread

import numpy as np

from failuretwin.app.console import state as shown
from failuretwin.app.console import texts
from failuretwin.app.console.state import Clock, LiveView, Sample, Tile, Trace
from failuretwin.app.keepers import WatchKeeper
from failuretwin.app.live import troubles_of
from failuretwin.app.shadow import Changes, Shadow
from failuretwin.connection.links.base import OK, Answer, Item, Sink, Source
from failuretwin.connection.links.statuses import BEFORE, Status, statuses
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.foreign import printable
from failuretwin.decision.streaming.fleet import SILENCE_S
from failuretwin.decision.streaming.monitor import FaultMonitor
from failuretwin.decision.streaming.set_up_watch import PROOF
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.inference.explanation import set_up_doubt

KEPT_S = 600.0
"""Time of a live robot that can be replayed [s]."""
KEPT = 6000
"""Readings that are kept at most: `KEPT_S` at 10 Hz."""
POSTERIOR_S = 1.0
"""Time between two kept posteriors [s]."""
SHOWN_CHANGES = 8
SINCE = re.compile(r"since (\d+\.\d) s(?: \((\d+\.\d) to (\d+\.\d) s\))?")
"""When a fault began, in a verdict: by the time of the stream [s]."""
POLL_S = 0.1
HANGS_S = 60.0
"""Time without a step from which a watch counts as hanging [s]; a new alarm takes up to 20."""


@dataclass(frozen=True)
class LiveSettings:
    """What watches one robot.

    Attributes:
        name: Name of the robot.
        known: The robot, calibrated.
        monitor: The diagnoser.
        open_source: Opens its source on a stack.
        wait_s: Longest delay of commands [s].
        faults: Faults of an arm emulated here, which its check has too; None: it is another arm.
        place: Network of the real arm; empty: emulated or a log.
        topics: File that names its topics; None: as usual.
    """

    name: str
    known: CalibratedRobot
    monitor: FaultMonitor
    open_source: Callable[[ExitStack], Source]
    wait_s: float = 0.0
    faults: tuple[str, ...] | None = None
    place: str = ""
    topics: Path | None = None


class LiveRobot(Sink):
    """Watches one robot in a thread; other threads read `view` and `trace`.

    Args:
        settings: The robot and its source.
        begin_keeping: Begins to store changes; None: they are not stored.
    """

    trouble = ""

    def __init__(
        self, settings: LiveSettings, begin_keeping: Callable[[], WatchKeeper] | None = None
    ) -> None:
        self.settings = settings
        self._begin_keeping = begin_keeping
        self._samples: deque[Sample] = deque(maxlen=KEPT)
        self._posterior: deque[tuple[float, Mapping[str, float]]] = deque(
            maxlen=round(KEPT_S / POSTERIOR_S)
        )
        self._starts: deque[float] = deque(maxlen=KEPT)
        self._lines: deque[str] = deque(maxlen=SHOWN_CHANGES)
        self._begun = 0
        self._seen_s = np.inf
        self._heard: datetime | None = None
        self._stopped = Event()
        motors = settings.known.robot.motor_names
        self._changes = Changes(motors)
        empty = Answer(0.0, "STALE", None)
        tile = Tile(settings.name, settings.known.robot.name, shown.WAITING, "", texts.NEVER, None)
        now = tuple(statuses(empty, motors))
        self.view = LiveView(tile, None, now, None, empty.alarm, ())
        self._thread = Thread(target=self._run, name=f"watch {settings.name}", daemon=True)

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def stop(self) -> None:
        """End the watch."""
        self._stopped.set()

    def wait(self, longest_s: float) -> None:
        """Wait until the watch has ended, and so what it keeps is stored."""
        if self._thread.is_alive():
            self._thread.join(longest_s)

    @property
    def tile(self) -> Tile:
        """The robot on the wall; it is stale if its watch hangs."""
        tile, silent_s = self.view.tile, time.monotonic() - self._seen_s
        if silent_s < HANGS_S or tile.state == shown.STALE:
            return tile
        return tile.silent

    def trace(self) -> Trace:
        """Return the motion of the last minutes."""
        while True:
            try:
                samples, posterior = list(self._samples), tuple(self._posterior)
                break
            except RuntimeError:  # the other thread has just added one
                continue
        known = [one for one in samples if one.command is not None]
        motors = len(self.settings.known.robot.motors)
        return Trace(
            self.settings.name,
            np.array([one.time for one in known]),
            np.array([one.command for one in known]).reshape(-1, motors),
            np.array([one.tool for one in known]).reshape(-1, 3),
            np.array(list(self._starts)),
            self.view.diagnosis,
            posterior,
            self._begun - len(self._starts) + 1,
            self.clock,
        )

    @property
    def clock(self) -> Clock | None:
        """Time of day of the stream of an arm that works now; None: it is a log."""
        own, seen = self.settings, self._samples
        if not seen or (own.faults is None and not own.place):
            return None
        first, last = seen[0], seen[-1]
        pace = (last.read - first.read) / (last.time - first.time) if last is not first else 1.0
        return Clock(first.read - pace * first.time, pace)

    def at(self, stream_s: float) -> str:
        """Return a time of the stream in words."""
        return shown.moment(self.clock, stream_s)

    def dated(self, text: str) -> str:
        """Return a verdict with times of day."""

        def told(found: re.Match[str]) -> str:
            since, *ends = (None if s is None else self.at(float(s)) for s in found.groups())
            return f"since {since}" + (f" ({' to '.join(map(str, ends))})" if ends[0] else "")

        return SINCE.sub(told, text)

    def put(self, item: Item) -> None:
        """Take what passes the shadow; its answers are read from the shadow itself."""

    def _run(self) -> None:
        try:
            with ExitStack() as stack:
                self._watch(self.settings.open_source(stack))
        except FailureTwinError as error:
            self._end(str(error))
        except Exception as error:  # whatever it was, nobody watches this robot any more
            self._end(texts.WATCH_FAILED.format(why=f"{type(error).__name__}: {error}"))
            raise

    def _watch(self, source: Source) -> None:
        own = self.settings
        shadow = Shadow(source, own.monitor, own.known.twin, [self], own.wait_s)
        keeper = None if self._begin_keeping is None else self._begin_keeping()
        begun_s, going = time.monotonic(), True
        while going and not self._stopped.is_set():
            going = shadow.step(POLL_S)
            troubles = troubles_of(shadow, time.monotonic() - begun_s)
            if keeper is not None and keeper.trouble:
                troubles += (keeper.trouble,)
            counts, jumps = shadow.counts, shadow.clock.jumps
            changes = self._changes.notice(shadow.snapshot, counts, jumps, troubles)
            changes = [replace(one, text=self.dated(one.text)) for one in changes]
            self._lines += [f"{self.at(one.stream_time)} {one.text}" for one in changes]
            if keeper is not None:
                keeper.keep(changes, self._dated_answer(shadow.snapshot.answer))
            self._remember(shadow)
        if keeper is not None:
            last = replace(shadow.snapshot, answer=self._dated_answer(shadow.snapshot.answer))
            keeper.end(last, decided=own.monitor.fit.seen > PROOF)
        self._end("")

    def _dated_answer(self, answer: Answer) -> Answer:
        """Return an answer as it is stored: with times of day."""
        found = answer.diagnosis
        if found is None:
            return answer
        return replace(answer, diagnosis=replace(found, verdict=self.dated(found.verdict)))

    def _remember(self, shadow: Shadow) -> None:
        """Take over the state of the shadow."""
        snapshot = shadow.snapshot
        answer, at = snapshot.answer, snapshot.stream_time
        command = self._reference(shadow, at)
        read, last = snapshot.residual, self.view.sample
        if command is not None and np.isfinite(read).all() and (last is None or at > last.time):
            tool = shadow.twin.path(command) + read
            last = Sample(at, time.time(), command, tool)
            self._samples.append(last)
            self._heard = datetime.now(UTC)
        diagnosis = answer.diagnosis
        due = not self._posterior or at >= self._posterior[-1][0] + POSTERIOR_S
        if due and answer.state == OK and diagnosis is not None and not diagnosis.undecided:
            self._posterior.append((at, diagnosis.posterior))
        self._seen_s = time.monotonic()
        now = tuple(statuses(answer, self.settings.known.robot.motor_names))
        self.view = LiveView(
            self._tile(shadow, now[0]),
            last,
            now,
            diagnosis,
            answer.alarm,
            tuple(self._lines),
        )

    def _reference(self, shadow: Shadow, at: float) -> np.ndarray | None:
        """Return the reference of the motors at a time of the stream [s]; note new movements."""
        ramp = shadow.reference.ramp
        if ramp is None:
            return None
        if np.isfinite(ramp.start) and (not self._starts or ramp.start > self._starts[-1]):
            self._starts.append(float(ramp.start))
            self._begun += 1
        return np.asarray(ramp.at(at))

    def _tile(self, shadow: Shadow, arm: Status) -> Tile:
        own, alarm = self.settings, shadow.snapshot.answer.alarm
        message = self.dated(arm.message)
        state, said = shown.STATES[arm.state], message
        if message.startswith(BEFORE):
            said = texts.LAST_WORD.format(said=message.removeprefix(BEFORE))
        waiting = shadow.snapshot.answer.diagnosis is None
        if waiting and self._heard is not None and arm.state == "STALE":
            silent = (datetime.now(UTC) - self._heard).total_seconds() > SILENCE_S
            state = shown.STALE if silent else shown.WAITING
        diagnosis = shadow.snapshot.answer.diagnosis
        remarks = [] if diagnosis is None else [diagnosis.undecided, *diagnosis.quality]
        doubt = own.monitor.set_up or set_up_doubt(remarks)
        mode = shown.modes_of([alarm.cause]) if alarm.cause else ""
        tile = Tile(own.name, own.known.robot.name, state, mode, printable(said), self._heard)
        return tile.doubted(printable(doubt))

    def _end(self, why: str) -> None:
        """Show the robot as stale, with its last word."""
        tile = self.view.tile if self.view.tile.state == shown.STALE else self.view.tile.silent
        said = f"{why}; {tile.said}" if why else tile.said
        self.view = replace(self.view, tile=replace(tile, said=printable(said)))
