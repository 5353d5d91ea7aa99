"""When the tool is at rest after an order: by what is read, not by a clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.links.base import Reading
from failuretwin.core.types import FloatArray
from failuretwin.inference.observation.evidence import SETTLING_S
from failuretwin.inference.observation.healthy_model import HealthyModel

QUIET_S = 0.5
"""The tool is at rest once it has been still for so long [s]."""
LEAST_READINGS = 3
"""And was read so often meanwhile."""
LATE_S = 0.3
"""A movement that begins late is waited for so much longer than arms of this kind need [s]."""
MOVED_FACTOR = 2.0
"""A tool that was to move by so many times what tells rest from motion is waited for to begin."""


@dataclass
class RestWatch:
    """Waits for the tool to come to rest after one order.

    Attributes:
        model: The arm: what tells rest from motion, how late it may start.
        sent_s: When the order was sent [s].
        ramp_s: Its longest ramp [s].
        before: Where the tool rested before, (3,) [m]; None: not known.
        travel_m: How far the tool is expected to go [m].
    """

    model: HealthyModel
    sent_s: float
    ramp_s: float
    before: FloatArray | None
    travel_m: float

    def __post_init__(self) -> None:
        self._recent: deque[Reading] = deque()

    def take(self, reading: Reading) -> FloatArray | None:
        """Take a reading; return where the tool is at rest, (3,) [m]; None: not yet.

        Args:
            reading: The latest reading.
        """
        if not np.isfinite(reading.tool).all():
            return None
        self._recent.append(reading)
        while reading.time - self._recent[0].time > QUIET_S + 1e-6:
            self._recent.popleft()
        since = reading.time - self.sent_s
        if since < self.ramp_s + SETTLING_S + self.model.lag_s or not self._long_enough():
            return None
        points = np.array([each.tool for each in self._recent])
        middle = np.median(points, axis=0)
        away = np.linalg.norm(points - middle, axis=1)
        if np.max(away) > self.model.settings.moving_spread_m + 4.0 * self.model.path_noise:
            return None
        if self._may_not_have_begun(middle, since):
            return None
        return np.asarray(middle)

    def _long_enough(self) -> bool:
        span = self._recent[-1].time - self._recent[0].time
        return len(self._recent) >= LEAST_READINGS and span >= 0.8 * QUIET_S

    def _may_not_have_begun(self, point: FloatArray, since: float) -> bool:
        """Return whether a tool that is where it was may yet start, late."""
        if self.before is None:
            return False
        near = self.model.settings.moving_spread_m * MOVED_FACTOR
        if np.linalg.norm(point - self.before) > near or self.travel_m < near:
            return False
        latest = self.ramp_s + SETTLING_S + self.model.imperfections.timing.late_s[1] + LATE_S
        return since < latest + QUIET_S
