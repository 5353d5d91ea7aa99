"""What changes, in words: faults found, repairs noticed, silence, trouble with the link."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from failuretwin.app.live.shadow import Moment
from failuretwin.connection.links.diagnostic_status import SURE, statuses
from failuretwin.connection.links.values import STALE, LinkCounts

KEPT = 1000
"""Changes that are remembered; the recording holds all of them."""
GARBAGE_EVERY_S = 10.0
"""Time between two reports of messages that make no sense [s]."""


@dataclass(frozen=True)
class Change:
    """Something that changed.

    Attributes:
        stream_time: When [s].
        text: What, in words.
    """

    stream_time: float
    text: str

    def __str__(self) -> str:
        """Return it as a line."""
        return f"{self.stream_time:8.1f} s  {self.text}"


class Changes:
    """Notices changes from moment to moment.

    Args:
        motors: Names of the robot's motors in chain order.
    """

    def __init__(self, motors: list[str]) -> None:
        self.lines: deque[Change] = deque(maxlen=KEPT)
        self._motors = motors
        self._alarm = ""
        self._state = ""
        self._troubles: tuple[str, ...] = ()
        self._counts = LinkCounts()
        self._jumps = 0
        self._garbage_at = -GARBAGE_EVERY_S

    def notice(
        self, moment: Moment, counts: LinkCounts, jumps: int, troubles: tuple[str, ...]
    ) -> list[Change]:
        """Return what has changed since the last call.

        Args:
            moment: What the shadow knows.
            counts: What the link has seen.
            jumps: How often the robot's clock was set.
            troubles: What keeps sinks from working.
        """
        texts = self._link(moment.stream_time, counts, jumps, troubles)
        texts += self._silence(moment)
        texts += self._diagnosis(moment)
        found = [Change(moment.stream_time, text) for text in texts]
        self.lines.extend(found)
        return found

    def _silence(self, moment: Moment) -> list[str]:
        before, self._state = self._state, moment.answer.state
        if not before or before == self._state:
            return []
        return ["no data any more" if self._state == STALE else "data are coming"]

    def _diagnosis(self, moment: Moment) -> list[str]:
        answer = moment.answer
        if answer.state == STALE or answer.diagnosis is None or answer.diagnosis.undecided:
            return []
        arm = statuses(answer, self._motors)[0]
        best, before = answer.diagnosis.ranked[0], self._alarm
        if best == before or answer.diagnosis.posterior[best] < SURE:
            return []
        self._alarm = best
        return [f"healthy again: {arm.message}" if before and best == "healthy" else arm.message]

    def _link(
        self, at: float, counts: LinkCounts, jumps: int, troubles: tuple[str, ...]
    ) -> list[str]:
        before, texts = self._counts, []
        if counts.reconnects > before.reconnects:
            texts.append("the link is back")
        if counts.dropped > before.dropped:
            texts.append(f"{counts.dropped} events dropped so far: this computer is too slow")
        if jumps > self._jumps:
            texts.append("the robot's clock jumped; going on by our own")
        garbage = before.garbage
        if counts.garbage > garbage and at >= self._garbage_at + GARBAGE_EVERY_S:
            self._garbage_at = at
            garbage = counts.garbage
            texts.append(f"{garbage} messages made no sense so far: {counts.last_garbage}")
        texts += [trouble for trouble in troubles if trouble not in self._troubles]
        texts += [f"over: {old}" for old in self._troubles if old not in troubles]
        self._counts = LinkCounts(counts.received, garbage, counts.dropped, counts.reconnects)
        self._jumps, self._troubles = jumps, troubles
        return texts
