"""The pace at which recorded and emulated time passes."""

from __future__ import annotations

import time
from dataclasses import dataclass

from failuretwin.core.errors import InputError

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
