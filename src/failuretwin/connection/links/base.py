"""What passes along a link: readings and commands one way, answers the other."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from threading import Condition
from typing import Protocol, Self, cast

from failuretwin.core.alarm import ALL_CLEAR, Alarm
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot

OK, STALE = "OK", "STALE"
"""States of an answer: data keep coming, or they have stopped."""


@dataclass(frozen=True)
class Reading:
    """What the sensors say at one time.

    Attributes:
        time: By the robot's clock [s].
        tool: Tool position in the base frame, (axis,) [m]; NaN where there is none.
        position: Angles of the motors in the log's sense, (motor,) [rad], NaN where one is
            missing; None where the robot does not tell.
        goal: Goals that the motors report to have received, (motor,) [rad], NaN where one is
            missing; None where the robot does not tell.
    """

    time: float
    tool: FloatArray
    position: FloatArray | None = None
    goal: FloatArray | None = None


@dataclass(frozen=True)
class CommandSent:
    """A command: every motor shall ramp to its target, all starting together, and stay there.

    Attributes:
        time: By the robot's clock [s].
        target: Where to go, (motor,) [rad].
        duration: Time to get there, (motor,) [s].
    """

    time: float
    target: FloatArray
    duration: FloatArray


Event = Reading | CommandSent


@dataclass(frozen=True)
class Answer:
    """What is believed at one time.

    Attributes:
        time: By the robot's clock [s].
        state: ``OK``, or ``STALE`` where data have stopped; then nothing is known of the present.
        diagnosis: The diagnosis as it stands, or stood when data stopped; None: there was none yet.
        alarm: Whether to call somebody.
    """

    time: float
    state: str
    diagnosis: Diagnosis | None
    alarm: Alarm = ALL_CLEAR


Item = Reading | CommandSent | Answer


@dataclass(frozen=True)
class LinkCounts:
    """What a link has seen since it was opened.

    Attributes:
        received: Readings and commands.
        garbage: Messages that made no sense and were left out.
        dropped: Readings and commands given up because they were not fetched in time.
        reconnects: How often the far side went away and came back.
        last_garbage: What was wrong with the last message that made no sense.
    """

    received: int = 0
    garbage: int = 0
    dropped: int = 0
    reconnects: int = 0
    last_garbage: str = ""


class Source(Protocol):
    """Where readings and commands come from; implement this to watch a robot of your own.

    It is opened by its constructor and used in one ``with`` statement, by one thread, which calls
    `poll` again and again and looks at `ended` and `counts` in between. A source that listens in a
    thread of its own puts what it hears into an `EventQueue`. Times are by the robot's clock, and
    need not be in order. `failuretwin watch MODULE:CLASS` watches such a class; it is called with
    the robot, and with the text after a second colon if there is one, such as an address::

        class Replayed:
            name, ended, counts = "ten readings at rest", False, LinkCounts()

            def __init__(self, robot: Robot) -> None:
                self._left = iter([Reading(0.1 * i, np.zeros(3)) for i in range(10)])

            def poll(self, timeout_s: float) -> Event | None:
                event = next(self._left, None)
                self.ended = event is None
                return event

            def __enter__(self) -> Self:
                return self

            def __exit__(self, *_: object) -> None:
                pass
    """

    @property
    def name(self) -> str:
        """What to call it, such as its file or address."""
        ...

    @property
    def ended(self) -> bool:
        """Whether nothing can ever come any more; a robot that is silent has not ended."""
        ...

    @property
    def counts(self) -> LinkCounts:
        """What it has seen so far."""
        ...

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event, waiting for it if need be.

        Args:
            timeout_s: Longest time to wait [s].

        Returns:
            The event; None if none came in time or the source has ended.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class Sink(Protocol):
    """Where items go: a recording, a network, a log of your own.

    Used in one ``with`` statement. `put` is called by one thread with every reading, command and
    answer in the order of the stream, and must not wait: an answer comes with every reading. After
    it `trouble` is looked at, and told to the user whenever it changes::

        class Printed:
            name, trouble = "printed", ""

            def put(self, item: Item) -> None:
                if isinstance(item, Answer) and item.diagnosis is not None:
                    print(item.time, item.diagnosis.verdict)

            def __enter__(self) -> Self:
                return self

            def __exit__(self, *_: object) -> None:
                pass
    """

    @property
    def name(self) -> str:
        """What to call it, such as its file or address."""
        ...

    @property
    def trouble(self) -> str:
        """What keeps items from arriving just now; empty if nothing does."""
        ...

    def put(self, item: Item) -> None:
        """Take an item. A far side that is gone makes trouble, but no error."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


# The queue between a link's own thread and a consumer that may be slow.

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


# The pace at which recorded and emulated time passes.

AS_FAST_AS_POSSIBLE = 0.0
"""The speed at which nothing is waited for."""


@dataclass
class Pace:
    """Waits until events are due.

    Attributes:
        speed: Seconds of the robot's time in each of ours; 0: as fast as possible.

    Raises:
        InputError: If the speed is negative or not finite.
    """

    speed: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.speed < float("inf"):
            raise InputError(
                f"speed is {self.speed:g}, expected a factor above 0, such as 1 (as recorded) or "
                "10; 0 means as fast as possible."
            )
        self._zero: tuple[float, float] | None = None

    def due(self, event_time: float, timeout_s: float) -> bool:
        """Wait for an event and return whether it is due by now.

        Args:
            event_time: When it happens by the robot's clock [s]; the first one is due at once.
            timeout_s: Longest time to wait [s].
        """
        if self.speed == AS_FAST_AS_POSSIBLE:
            return True
        now = time.monotonic()
        if self._zero is None:
            self._zero = event_time, now
        first, began = self._zero
        left = began + (event_time - first) / self.speed - now
        if left > 0.0:
            time.sleep(min(left, timeout_s))
        return left <= timeout_s


# Sources whose events are known or made here: replayed logs and the emulated robot.


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


# Sources of other people, by their names.

SOURCE_PARTS = ("name", "ended", "counts", "poll", "__enter__", "__exit__")
"""What `Source` asks for."""


def source_from_text(text: str, robot: Robot) -> Source:
    """Return the source of a class that the user names.

    Args:
        text: ``module:Class``, or ``module:Class:ADDRESS`` for a class that takes an address; the
            module is imported from where Python finds modules.
        robot: The robot, given to the class before the address.

    Raises:
        InputError: If there is no such class, or what it makes is no source.
    """
    module, _, rest = text.partition(":")
    name, *address = rest.split(":", 1)
    try:
        made = getattr(import_module(module), name)(robot, *address)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"source {text!r}: {error}. Expected MODULE:CLASS, a class such as the docstring of "
            "failuretwin.connection.links.base.Source shows, in a module that Python finds."
        ) from error
    lacking = [part for part in SOURCE_PARTS if not hasattr(made, part)]
    if lacking:
        raise InputError(
            f"source {text!r}: lacks {', '.join(lacking)}. Expected a class such as the docstring "
            "of failuretwin.connection.links.base.Source shows."
        )
    return cast(Source, made)
