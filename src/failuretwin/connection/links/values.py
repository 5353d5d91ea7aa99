"""What passes along a link: readings and commands one way, answers the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.types import FloatArray

OK, STALE = "OK", "STALE"
"""States of an answer: data keep coming, or they have stopped."""


@dataclass(frozen=True)
class Reading:
    """What the sensors say at one time.

    Attributes:
        time: By the robot's clock [s].
        tool: Tool position in the base frame, (axis,) [m]; NaN where there is none.
        position: Angles of the motors in the log's sense, (motor,) [rad], NaN where one is
            missing; None where the robot does not tell. No diagnosis looks at them.
    """

    time: float
    tool: FloatArray
    position: FloatArray | None = None


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
    """

    time: float
    state: str
    diagnosis: Diagnosis | None


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
    """Where readings and commands come from. Used in a ``with`` statement, fetched one by one."""

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
    """Where items go: a recording, a network. Used in a ``with`` statement."""

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
