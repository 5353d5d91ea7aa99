"""The digital shadow: from the events of a link to answers and messages."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.links.base import (
    OK,
    STALE,
    Answer,
    CommandSent,
    Event,
    LinkCounts,
    Reading,
    Sink,
    Source,
)
from failuretwin.connection.links.statuses import Status, is_sure, statuses
from failuretwin.connection.links.stream_time import LiveReference, ReorderBuffer, StreamClock
from failuretwin.core.hypothesis import CLEAR, RAISED, SUSPECTED, Alarm, Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.streaming.diagnoser import RobotStream
from failuretwin.decision.streaming.monitor import FaultMonitor
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import plain_name, with_reading_doubt

SILENCE_S = 5.0
"""Time without a reading, on our own clock, after which the answer is stale [s]."""
TOGETHER_S = 0.1
"""Maximum time between a reading of the motors and the reading of the tool it belongs to [s]."""
TICK_S = 0.5
"""Time without an event after which the diagnoser is updated without data [s]."""


@dataclass(frozen=True)
class Snapshot:
    """State of the shadow at one time.

    Attributes:
        answer: The diagnosis, by the robot's clock.
        stream_time: Time since the first event, without leaps [s].
        residual: Measured minus expected tool position, (axis,) [m]; NaN if not known.
        seconds: Time from the last sample to its answer [s].
    """

    answer: Answer
    stream_time: float
    residual: FloatArray
    seconds: float


class Shadow:
    """Feeds a diagnoser from a source and publishes events and answers.

    Commands may arrive `commands_late_s` [s] later than their stamps.

    Attributes:
        source: The source.
        sinks: The sinks.
        twin: The twin of the robot.
        monitor: The diagnoser if it is a `FaultMonitor`, else None.
        snapshot: The latest state.
        clock: The robot's clock.
        reference: The commanded angles over time.
    """

    def __init__(
        self,
        source: Source,
        diagnoser: RobotStream,
        twin: DigitalTwin,
        sinks: Sequence[Sink] = (),
        commands_late_s: float = 0.0,
    ) -> None:
        self.source = source
        self._diagnoser = diagnoser
        self.monitor = diagnoser if isinstance(diagnoser, FaultMonitor) else None
        self.twin = twin
        self.sinks = sinks
        self.clock = StreamClock()
        self._sequencer = ReorderBuffer(commands_late_s)
        self.reference = LiveReference()
        self._read_s = -np.inf
        self._fed_s = time.monotonic()
        self._newest = 0.0
        self._computed = False
        self._position: tuple[float, FloatArray | None] = (-np.inf, None)
        self.snapshot = Snapshot(
            Answer(self.clock.stamp(0.0), STALE, None), 0.0, np.full(3, np.nan), 0.0
        )

    @property
    def counts(self) -> LinkCounts:
        """Counts of the link; leaping stamps are counted as garbage."""
        counts, leaps = self.source.counts, self.clock.senseless
        if not leaps:
            return counts
        last = counts.last_garbage or "stamps that leap; such events count when they come"
        return replace(counts, garbage=counts.garbage + leaps, last_garbage=last)

    def step(self, timeout_s: float) -> bool:
        """Take one event, or see after a wait [s] that time goes on; return if more may come."""
        return self.hear(self.source.poll(min(timeout_s, TICK_S)))

    def hear(self, event: Event | None) -> bool:
        """Take an event that was polled elsewhere, None: none came; return if more may come."""
        if event is not None:
            self._take(event)
        elif self.source.ended:
            self._feed_all(np.inf)
            self._publish(self._diagnoser.conclude(), self.snapshot.residual)
            return False
        elif time.monotonic() - self._fed_s >= TICK_S:
            self._tick()
        return True

    def _take(self, event: Event) -> None:
        now_s = time.monotonic()
        for sink in self.sinks:
            sink.put(event)
        at = self.clock.to_stream_time(event.time, now_s, isinstance(event, Reading))
        self._newest = max(self._newest, at)
        self._sequencer.add(replace(event, time=at))
        self._feed_all(self._newest)
        self.snapshot = replace(self.snapshot, seconds=time.monotonic() - now_s)

    def _tick(self) -> None:
        """Tell the diagnoser that time goes on without data."""
        now_s = time.monotonic()
        self._fed_s = now_s
        at = self.clock.at(now_s)
        self._feed_all(at)
        self._publish(self._diagnoser.update(at, None, None), self.snapshot.residual)

    def _feed_all(self, until: float) -> None:
        for event in self._sequencer.ready(until):
            if isinstance(event, CommandSent):
                self.reference.add(event)
            else:
                self._feed(event)

    def _feed(self, reading: Reading) -> None:
        self._fed_s = time.monotonic()
        if reading.position is not None and np.isfinite(reading.position).all():
            self.reference.start_at(reading.position)
            self._position = reading.time, reading.position
            self._computed = bool(np.allclose(reading.tool, self.twin.path(reading.position)))
        seen = reading.tool if np.isfinite(reading.tool).all() else None
        command = None
        for at, angles in self.reference.corners_to(reading.time):
            if at < reading.time:
                self._diagnoser.update(at, angles, None)
            else:
                command = angles
        residual = self.snapshot.residual
        if seen is not None:
            expected = np.full(3, np.nan) if command is None else self.twin.path(command)
            residual = seen - expected
        read_at, position = self._position
        if abs(reading.time - read_at) > TOGETHER_S:
            position = None
        answer = self._diagnoser.update(reading.time, command, seen, position, reading.goal)
        self._fed_s = time.monotonic()  # what we take to think is no silence of the robot
        if seen is not None:
            self._read_s = self._fed_s
        self._publish(answer, residual)

    def _publish(self, answer: Answer, residual: FloatArray) -> None:
        silent = time.monotonic() - self._read_s > SILENCE_S
        state = STALE if silent or answer.state != OK else OK
        stamped = replace(answer, time=self.clock.stamp(answer.time), state=state)
        if self._computed and stamped.diagnosis is not None:
            said = with_reading_doubt(stamped.diagnosis, stamped.alarm.cause)
            stamped = replace(stamped, diagnosis=said)
        self.snapshot = Snapshot(stamped, answer.time, residual, self.snapshot.seconds)
        for sink in self.sinks:
            sink.put(stamped)


# Changes in words: faults, repairs, silence, trouble with the link.

KEPT = 1000
"""Maximum number of changes that are kept; the recording holds all of them."""
GARBAGE_AFTER_S, GARBAGE_EVERY_S = 10.0, 3600.0
"""Time between the first two reports of messages that make no sense, or of stamps that leap; it
doubles with each, up to the second [s]."""
RECURS, RECURS_WITHIN_S = 3, 3600.0
"""From so many alarms of one motor within that time [s] on, it is told that they come and go."""
FIGURE = re.compile(r"(?:over )?(?<!motor )[-+]?\b\d[\d.]*(?:, \d+)*")
"""Figures in a message, and lists of them; a message that differs only in them is no news."""


class _NowAndThen:
    """Times at which a trouble that goes on is reported again."""

    def __init__(self) -> None:
        self._due_s, self._wait_s = -np.inf, GARBAGE_AFTER_S

    def due(self, at: float) -> bool:
        """Return whether to report at a time of the stream [s]; if so, it counts as reported."""
        if at < self._due_s:
            return False
        self._due_s, self._wait_s = at + self._wait_s, min(2.0 * self._wait_s, GARBAGE_EVERY_S)
        return True


def _cleared(before: Alarm, now: Alarm) -> str:
    """Return what has ended in words: an alarm with its duration, or a suspicion."""
    cause = plain_name(Hypothesis.parse(before.cause))
    episode = now.episode
    if before.state == SUSPECTED or episode is None or episode.duration_s is None:
        return f"CLEARED: {cause} is no longer suspected"
    return f"CLEARED: the alarm for {cause} lasted {episode.duration_s:.0f} s"


class _Recurrence:
    """Alarms of each motor that followed a healthy spell."""

    def __init__(self) -> None:
        self._raised: dict[str, list[float]] = {}

    def count(self, alarm: Alarm, at: float) -> None:
        """Count an alarm that is raised at a time of the stream [s]."""
        motor = alarm.cause.partition(":")[0]
        times = self._raised.setdefault(motor, [])
        times[:] = [*(before for before in times if at - before <= RECURS_WITHIN_S), at]

    @property
    def told(self) -> list[str]:
        """What is to be said of motors whose alarms come and go."""
        return [
            f"{motor.replace('_', ' ')}: {len(times)} alarms within "
            f"{times[-1] - times[0]:.0f} s, each after a healthy spell: a fault that comes and goes"
            for motor, times in self._raised.items()
            if len(times) >= RECURS
        ]


@dataclass(frozen=True)
class Change:
    """Something that changed, in words, at a time of the stream [s]."""

    stream_time: float
    text: str

    def __str__(self) -> str:
        """Return it as a line."""
        return f"{self.stream_time:8.1f} s  {self.text}"


class Changes:
    """Notices changes from snapshot to snapshot."""

    def __init__(self, motors: list[str]) -> None:
        self.lines: deque[Change] = deque(maxlen=KEPT)
        self._motors = motors
        self._alarm: Alarm | None = None
        self._sure = False
        self._undecided = ""
        self._state = ""
        self._troubles: tuple[str, ...] = ()
        self._counts = LinkCounts()
        self._jumps = 0
        self._of_garbage, self._of_jumps = _NowAndThen(), _NowAndThen()
        self._recurrence = _Recurrence()

    @property
    def recurring(self) -> list[str]:
        """What is to be said of motors whose alarms come and go, a line each."""
        return self._recurrence.told

    def notice(
        self, snapshot: Snapshot, counts: LinkCounts, jumps: int, troubles: tuple[str, ...]
    ) -> list[Change]:
        """Return the changes since the last call."""
        texts = self._link(snapshot.stream_time, counts, jumps, troubles)
        texts += self._silence(snapshot)
        texts += self._diagnosis(snapshot)
        found = [Change(snapshot.stream_time, text) for text in texts]
        self.lines.extend(found)
        return found

    def add(self, stream_time: float, text: str) -> Change:
        """Note something else at a time of the stream [s], and return it."""
        found = Change(stream_time, text)
        self.lines.append(found)
        return found

    def _silence(self, snapshot: Snapshot) -> list[str]:
        before, self._state = self._state, snapshot.answer.state
        if not before or before == self._state:
            return []
        return [f"{STALE}: no data any more" if self._state == STALE else "data are coming"]

    def _diagnosis(self, snapshot: Snapshot) -> list[str]:
        answer = snapshot.answer
        if answer.state == STALE or answer.diagnosis is None:
            return []
        undecided, why, arm = self._undecided, answer.diagnosis.undecided, self._arm(answer)
        self._undecided = f"{arm.state}: {why}" if why else ""
        if why:
            same = FIGURE.sub("", self._undecided) == FIGURE.sub("", undecided)
            return [] if same else [self._undecided]
        before, now = self._alarm, answer.alarm
        same = before is not None and (before.state, before.cause) == (now.state, now.cause)
        sure = now.state == RAISED and is_sure(answer.diagnosis)
        told = same and not undecided and self._sure >= sure
        self._alarm, self._sure = now, sure or (same and self._sure)
        if told:
            return []
        if now.state == RAISED and (before is None or before.state != RAISED):
            self._recurrence.count(now, snapshot.stream_time)
            return [str(arm), *self.recurring]
        if before is None or same or now.state != CLEAR:
            return [str(arm)]
        return [f"{_cleared(before, now)}; {arm.message}"]

    def _arm(self, answer: Answer) -> Status:
        """Return the status of the whole arm."""
        return statuses(answer, self._motors)[0]

    def _link(
        self, at: float, counts: LinkCounts, jumps: int, troubles: tuple[str, ...]
    ) -> list[str]:
        before, texts = self._counts, []
        if counts.reconnects > before.reconnects:
            texts.append("the link is back")
        if counts.dropped > before.dropped:
            texts.append(f"{counts.dropped} events dropped so far: this computer is too slow")
        if jumps > self._jumps and self._of_jumps.due(at):
            self._jumps = jumps
            often = f", {jumps} times so far" if jumps > 1 else ""
            texts.append(f"the robot's clock jumped{often}; going on by our own")
        garbage = before.garbage
        if counts.garbage > garbage and self._of_garbage.due(at):
            garbage = counts.garbage
            texts.append(f"{garbage} messages made no sense so far: {counts.last_garbage}")
        texts += [trouble for trouble in troubles if trouble not in self._troubles]
        texts += [f"over: {old}" for old in self._troubles if old not in troubles]
        self._counts = LinkCounts(counts.received, garbage, counts.dropped, counts.reconnects)
        self._troubles = troubles
        return texts
