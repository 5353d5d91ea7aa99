"""Events in the order of their times, where commands may arrive later than readings."""

from __future__ import annotations

import heapq
from itertools import count

from failuretwin.connection.links.values import CommandSent, Event

CAPACITY = 10_000
"""Events that are held back at most; beyond it the oldest go on without waiting."""


class Sequencer:
    """Holds events back for a time, so that those that come late can take their place.

    Args:
        hold_s: How long an event waits for others [s]; 0: not at all.
    """

    def __init__(self, hold_s: float = 0.0) -> None:
        self._hold_s = hold_s
        self._waiting: list[tuple[float, bool, int, Event]] = []
        self._number = count()

    def add(self, event: Event) -> None:
        """Take an event."""
        entry = (event.time, not isinstance(event, CommandSent), next(self._number), event)
        heapq.heappush(self._waiting, entry)

    def ready(self, now: float) -> list[Event]:
        """Return the events that have waited for long enough at a time [s] of the stream."""
        events = []
        while self._waiting and (
            self._waiting[0][0] <= now - self._hold_s or len(self._waiting) > CAPACITY
        ):
            events.append(heapq.heappop(self._waiting)[-1])
        return events
