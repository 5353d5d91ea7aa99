"""Readings, commands and answers, and the links that carry them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from importlib import import_module
from threading import Condition
from typing import Protocol, Self, cast

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import ALL_CLEAR, Alarm, Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot

OK, STALE = "OK", "STALE"
"""States of an answer: data keep coming, or they have stopped."""


@dataclass(frozen=True)
class Reading:
    """Sensor values at one time.

    Attributes:
        time: Time by the robot's clock [s].
        tool: Tool position in the base frame, (axis,) [m]; NaN where there is none.
        position: Motor angles in the log's sense, (motor,) [rad], NaN where one is missing; None
            if the robot does not report them.
        goal: Goals that the motors report as received, (motor,) [rad], NaN where one is missing;
            None if the robot does not report them.
    """

    time: float
    tool: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    position: FloatArray | None = None
    goal: FloatArray | None = None


@dataclass(frozen=True)
class CommandSent:
    """A command: all motors start together, ramp to their targets and hold them.

    Attributes:
        time: Time by the robot's clock [s].
        target: Target angles, (motor,) [rad].
        duration: Ramp durations, (motor,) [s].
    """

    time: float
    target: FloatArray
    duration: FloatArray


Event = Reading | CommandSent


@dataclass(frozen=True)
class Order:
    """A movement to be made: all motors start together and ramp to their targets.

    Attributes:
        target: Target angles in the sense of commands, (motor,) [rad].
        duration: Ramp durations, (motor,) [s].
    """

    target: FloatArray
    duration: FloatArray


@dataclass(frozen=True)
class Answer:
    """Diagnosis and alarm at one time.

    Attributes:
        time: Time by the robot's clock [s].
        state: ``OK``, or ``STALE`` if data have stopped; then the present state is unknown.
        diagnosis: Current diagnosis, or the last one before data stopped; None before the first.
        alarm: State of the alarm.
    """

    time: float
    state: str
    diagnosis: Diagnosis | None
    alarm: Alarm = ALL_CLEAR


Item = Reading | CommandSent | Answer


@dataclass(frozen=True)
class LinkCounts:
    """Counters of a link since it was opened.

    Attributes:
        received: Readings and commands.
        garbage: Invalid messages, which were left out.
        dropped: Readings and commands dropped because they were not fetched in time.
        reconnects: Times that the far side went away and came back.
        last_garbage: Error of the last invalid message.
    """

    received: int = 0
    garbage: int = 0
    dropped: int = 0
    reconnects: int = 0
    last_garbage: str = ""


class Source(Protocol):
    """Source of readings and commands; implement it to watch a robot of your own.

    The constructor opens the source. One thread uses it in one ``with`` statement: it calls `poll`
    repeatedly and reads `ended` and `counts` in between. A source with a thread of its own can be a
    `Link`. Times are by the robot's clock and need not be in order. `failuretwin watch
    MODULE:CLASS` watches such a class. The class is called with the robot, and with the text after
    a second colon if there is one, such as an address::

        class Replayed(Source):
            name, ended, counts = "ten readings at rest", False, LinkCounts()

            def __init__(self, robot: Robot) -> None:
                self._left = iter([Reading(0.1 * i, np.zeros(3)) for i in range(10)])

            def poll(self, timeout_s: float) -> Event | None:
                event = next(self._left, None)
                self.ended = event is None
                return event
    """

    @property
    def name(self) -> str:
        """Name for messages to the user, such as a file or an address."""
        ...

    @property
    def ended(self) -> bool:
        """Whether the source is finished; a robot that is silent has not ended."""
        ...

    @property
    def counts(self) -> LinkCounts:
        """Counters since the source was opened."""
        ...

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none comes within `timeout_s` [s] or the source ended."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the source; by default there is nothing to close."""
        return


class Commander(Source, Protocol):
    """A source that also takes orders; implement it to act on a robot of your own.

    An order that is sent comes back as a `CommandSent` if other programs on the network can hear
    it. The safety gate has checked every order before it is sent.
    """

    @property
    def standing(self) -> FloatArray | None:
        """Last target of the motors, (motor,) [rad]; None if it is not known."""
        ...

    def send(self, order: Order) -> None:
        """Send an order to the motors; returns at once."""
        ...


class Sink(Protocol):
    """Consumer of items: a recording, a network, a log of your own.

    Used in one ``with`` statement. One thread calls `put` with every reading, command and answer
    in the order of the stream. `put` must not block: an answer comes with every reading. After
    each call `trouble` is read, and the user is told when it changes::

        class Printed(Sink):
            trouble = ""

            def put(self, item: Item) -> None:
                if isinstance(item, Answer) and item.diagnosis is not None:
                    print(item.time, item.diagnosis.verdict)
    """

    @property
    def trouble(self) -> str:
        """Reason why items do not arrive at present; empty if they do."""
        ...

    def put(self, item: Item) -> None:
        """Take an item. If the far side is gone, set `trouble` and raise nothing."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the sink; by default there is nothing to close."""
        return


CAPACITY = 1000
"""Maximum number of waiting events: 100 s of a robot that is read at 10 Hz."""


class Link(Source):
    """Source that other threads fill, and that its consumer may poll slowly.

    A full link drops its oldest reading: a lost reading costs little, but a lost command would
    make a healthy robot look faulty.
    """

    name, ended = "", False

    def __init__(self, name: str, capacity: int = CAPACITY) -> None:
        self.name = name
        self._capacity = capacity
        self._waiting: deque[Event] = deque()
        self._changed = Condition()
        self._counts = LinkCounts()

    @property
    def counts(self) -> LinkCounts:
        """Counters since the link was opened."""
        return self._counts

    def put(self, event: Event) -> None:
        """Add an event; never blocks."""
        with self._changed:
            counts, full = self._counts, len(self._waiting) >= self._capacity
            if full:
                readings = (i for i, kept in enumerate(self._waiting) if isinstance(kept, Reading))
                del self._waiting[next(readings, 0)]
            self._waiting.append(event)
            self._counts = replace(
                counts, received=counts.received + 1, dropped=counts.dropped + full
            )
            self._changed.notify()

    def put_garbage(self, error: str) -> None:
        """Count an invalid message, which is left out."""
        with self._changed:
            garbage = self._counts.garbage + 1
            self._counts = replace(self._counts, garbage=garbage, last_garbage=error)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the oldest event; None if none comes within `timeout_s` [s]."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout_s)
            return self._waiting.popleft() if self._waiting else None


# Sources that users have written.

SOURCE_PARTS = ("name", "ended", "counts", "poll", "__enter__", "__exit__")
"""Members of `Source`."""


def source_from_text(text: str, robot: Robot) -> Source:
    """Return an instance of a source class that the user names.

    Args:
        text: ``module:Class``, or ``module:Class:ADDRESS`` for a class that takes an address; the
            module must be on Python's path.
        robot: The robot, the first argument of the class.

    Raises:
        InputError: If there is no such class, its instance is not a source, or it finds nothing at
            its address.
    """
    module, _, rest = text.partition(":")
    name, *address = rest.split(":", 1)
    try:
        made = getattr(import_module(module), name)(robot, *address)
        lacking = [part for part in SOURCE_PARTS if not hasattr(made, part)]
        if lacking:
            raise AttributeError(f"lacks {', '.join(lacking)}")
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"source {text!r}: {error}. Expected MODULE:CLASS, a class such as the docstring of "
            "failuretwin.connection.links.base.Source shows, in a module that Python finds."
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"source {text!r} could not be opened: {error}. Check what follows its class."
        ) from error
    return cast(Source, made)
