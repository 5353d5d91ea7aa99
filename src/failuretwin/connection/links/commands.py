"""Commands out of references that are only known as samples, as controllers stream them."""

from __future__ import annotations

import numpy as np

from failuretwin.connection.links.values import CommandSent
from failuretwin.core.types import FloatArray

STILL_RAD = 1e-9
"""Samples closer than this are the same [rad]."""
FIRST_S = 0.0
"""Time that the first sample gives to get there [s]: it only says where the reference stands."""


class SampledCommands:
    """Turns samples of a reference into commands that draw the same line.

    Between two samples the reference runs straight, which is known only when the second has come:
    each command bears the time of the sample before it.
    """

    def __init__(self) -> None:
        self._before: tuple[float, FloatArray] | None = None

    def add(self, time: float, value: FloatArray) -> CommandSent | None:
        """Return the command that a sample completes, None while the reference stands still.

        Args:
            time: Time of the sample [s].
            value: The reference, (motor,) [rad].
        """
        before, self._before = self._before, (time, value)
        if before is None:
            return CommandSent(time, value, np.full(len(value), FIRST_S))
        if time <= before[0] or np.abs(value - before[1]).max() < STILL_RAD:
            return None
        return CommandSent(before[0], value, np.full(len(value), time - before[0]))
