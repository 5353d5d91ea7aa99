"""Alarms: the state of monitoring, and fault episodes."""

from __future__ import annotations

from dataclasses import dataclass

CLEAR, SUSPECTED, RAISED = "clear", "suspected", "alarm"
"""States of an alarm, from best to worst."""


@dataclass(frozen=True)
class Episode:
    """A fault from its alarm to its end.

    Attributes:
        number: Its number in the stream, from 1.
        cause: The diagnosed hypothesis.
        raised_s: Time of the alarm in the stream [s].
        cleared_s: End of the fault [s]; None while it lasts.
    """

    number: int
    cause: str
    raised_s: float
    cleared_s: float | None = None

    @property
    def duration_s(self) -> float | None:
        """Its duration [s]; None while it lasts."""
        return None if self.cleared_s is None else self.cleared_s - self.raised_s


@dataclass(frozen=True)
class Alarm:
    """Result of the alarm rule, the same for all outputs.

    Attributes:
        state: `CLEAR`, `SUSPECTED` or `RAISED`.
        cause: The most probable fault; empty if the state is `CLEAR`.
        episode: The latest fault with an alarm; None before the first.
    """

    state: str = CLEAR
    cause: str = ""
    episode: Episode | None = None

    def concerns(self, motor: str) -> bool:
        """Return whether its cause includes a motor."""
        return any(part.partition(":")[0] == motor for part in self.cause.split("+"))


ALL_CLEAR = Alarm()
"""No fault is or was suspected."""
