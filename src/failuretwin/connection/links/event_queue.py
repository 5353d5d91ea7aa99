"""The queue between a link's own thread and a consumer that may be slow."""

from __future__ import annotations

from collections import deque
from threading import Condition

from failuretwin.connection.links.values import Event, Reading

CAPACITY = 1000
"""Events that wait at most: 100 s of a robot that reads at 10 Hz."""


class EventQueue:
    """Holds a limited number of events and counts those that it had to give up.

    When it is full the oldest reading goes: a lost reading costs little, a lost command would make
    a healthy robot look faulty.

    Args:
        capacity: Events that it can hold.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._events: deque[Event] = deque()
        self._filled = Condition()
        self.dropped = 0
        self.received = 0

    def put(self, event: Event) -> None:
        """Add an event; never waits."""
        with self._filled:
            if len(self._events) >= self._capacity:
                self._drop_one()
            self._events.append(event)
            self.received += 1
            self._filled.notify()

    def get(self, timeout_s: float) -> Event | None:
        """Return the oldest event, None if none comes within `timeout_s` [s]."""
        with self._filled:
            if not self._events:
                self._filled.wait(timeout_s)
            return self._events.popleft() if self._events else None

    def __len__(self) -> int:
        """Return how many events wait."""
        return len(self._events)

    def _drop_one(self) -> None:
        readings = (i for i, event in enumerate(self._events) if isinstance(event, Reading))
        del self._events[next(readings, 0)]
        self.dropped += 1
