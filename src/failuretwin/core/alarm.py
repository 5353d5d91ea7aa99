"""Whether to call somebody: the state of a watch, and the fault episodes behind it."""

from __future__ import annotations

from dataclasses import dataclass

CLEAR, SUSPECTED, RAISED = "clear", "suspected", "alarm"
"""States of an alarm, from the best to the worst."""


@dataclass(frozen=True)
class Episode:
    """A fault from the alarm that told of it to its end.

    Attributes:
        number: Which of the stream it is, from 1.
        cause: The hypothesis that was named.
        raised_s: When the alarm was raised, by the time of the stream [s].
        cleared_s: When it was over [s]; None while it lasts.
    """

    number: int
    cause: str
    raised_s: float
    cleared_s: float | None = None

    @property
    def duration_s(self) -> float | None:
        """How long it lasted [s]; None while it does."""
        return None if self.cleared_s is None else self.cleared_s - self.raised_s


@dataclass(frozen=True)
class Alarm:
    """What to do about what is believed: one rule for all who are told.

    Attributes:
        state: `CLEAR`, `SUSPECTED` or `RAISED`.
        cause: The most probable fault; empty while all is clear.
        episode: The last fault that an alarm told of; None before the first.
    """

    state: str = CLEAR
    cause: str = ""
    episode: Episode | None = None

    def concerns(self, motor: str) -> bool:
        """Return whether it is about a motor."""
        return any(part.partition(":")[0] == motor for part in self.cause.split("+"))


ALL_CLEAR = Alarm()
"""Nothing is suspected, and nothing was."""
