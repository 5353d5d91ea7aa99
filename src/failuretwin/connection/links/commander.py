"""How an arm is told to move: a source of readings that also takes orders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

from failuretwin.connection.links.base import Event, LinkCounts
from failuretwin.core.types import FloatArray


@dataclass(frozen=True)
class Order:
    """One movement: every motor ramps to its target, all starting together.

    Attributes:
        target: Where to, in the sense of commands, (motor,) [rad].
        duration: Time to get there, (motor,) [s].
    """

    target: FloatArray
    duration: FloatArray


class Commander(Protocol):
    """An arm that can be told to move; implement this to act on a robot of your own.

    It is a `Source` that also sends. Orders come back as `CommandSent` where others can hear them,
    so that who listens knows who moves the arm. What is sent has passed the safety gate.
    """

    @property
    def name(self) -> str:
        """What to call it."""
        ...

    @property
    def ended(self) -> bool:
        """Whether nothing can ever come any more."""
        ...

    @property
    def counts(self) -> LinkCounts:
        """What it has seen so far."""
        ...

    @property
    def standing(self) -> FloatArray | None:
        """What the motors were told last, as far as is known, (motor,) [rad]; None: it is not."""
        ...

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next reading or command; None if none came within `timeout_s` [s]."""
        ...

    def send(self, order: Order) -> None:
        """Tell the motors to move; returns at once."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...
