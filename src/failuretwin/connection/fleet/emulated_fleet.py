"""A fleet of emulated arms, second by second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links.base import Event


class EmulatedFleet:
    """Emulated arms that work at random, each with its own clock and seed.

    Args:
        arms: Name and settings of each arm.
        begin: Time of the robots' clocks at the start [s].
        seconds: How long they work [s].
    """

    def __init__(
        self, arms: Sequence[tuple[str, Emulation]], begin: float, seconds: float = math.inf
    ) -> None:
        shifts = Shifts(break_s=0.0, duration_s=seconds)
        self._arms = [(name, EmulatedArm(emulation, shifts=shifts)) for name, emulation in arms]
        self._next: list[Event | None] = [None] * len(arms)
        self._begin, self._now = begin, 0.0

    @property
    def names(self) -> list[str]:
        """Names of the arms."""
        return [name for name, _ in self._arms]

    def second(self) -> list[tuple[str, list[Event]]] | None:
        """Return the events of the next second of each arm; None: all have ended."""
        self._now += 1.0
        found = [(name, self._until_now(k)) for k, (name, _) in enumerate(self._arms)]
        ended = all(arm.ended for _, arm in self._arms)
        return None if ended and not any(events for _, events in found) else found

    def _until_now(self, number: int) -> list[Event]:
        arm, events = self._arms[number][1], list[Event]()
        while True:
            event = self._next[number] or arm.poll(0.0)
            self._next[number] = event
            if event is None or event.time > self._now:
                return events
            self._next[number] = None
            events.append(replace(event, time=event.time + self._begin))
