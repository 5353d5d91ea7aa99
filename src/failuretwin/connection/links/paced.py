"""Sources whose events are known or made here: replayed logs and the emulated robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from failuretwin.connection.links.pace import Pace
from failuretwin.connection.links.values import Event, LinkCounts


class PacedSource:
    """Gives events when they are due. Nothing is dropped: a slow consumer gets them later.

    Args:
        name: What to call it.
        events: Events in the order of their times.
        pace: How fast time passes.
    """

    def __init__(self, name: str, events: Iterator[Event], pace: Pace) -> None:
        self.name = name
        self._events = events
        self._pace = pace
        self._next: Event | None = None
        self._ended = False
        self._received = 0

    @property
    def ended(self) -> bool:
        """Whether all events have been given."""
        return self._ended

    @property
    def counts(self) -> LinkCounts:
        """How many events have been given."""
        return LinkCounts(received=self._received)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if it is not due within `timeout_s` [s] or there is none."""
        if self._next is None and not self._ended:
            self._next = next(self._events, None)
            self._ended = self._next is None
        event = self._next
        if event is None or not self._pace.due(event.time, timeout_s):
            return None
        self._next = None
        self._received += 1
        return event

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to be closed."""
