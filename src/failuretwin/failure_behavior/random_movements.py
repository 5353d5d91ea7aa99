"""The paper's random movements: uniform targets, ramps of three lengths, plateaus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.robot import Robot

SPEED_CAP_RAD_S = np.deg2rad(272.0)
"""Largest speed of a reference in the published generator: 2.72 deg in 10 ms [rad/s]."""


@dataclass(frozen=True)
class RandomMovements:
    """Distribution of random movements.

    Attributes:
        count: Movements in a run.
        period_s: Nominal time from one movement to the next [s].
        ramp_shares: Possible shares of the nominal period for a ramp.
    """

    count: int = 5
    period_s: float = 2.0
    ramp_shares: tuple[float, ...] = (0.3, 0.4, 0.5)

    @property
    def duration_s(self) -> float:
        """Nominal length of a run [s]."""
        return self.count * self.period_s

    def draw(
        self,
        robot: Robot,
        schedule: Schedule,
        rng: np.random.Generator,
        initial: FloatArray | None = None,
    ) -> Movements:
        """Return the movements of one run, with a leading run axis of 1.

        Ramps beyond the speed cap take longer.

        Args:
            robot: The robot.
            schedule: Times of commands.
            rng: The run's own generator.
            initial: Start of the arm, (motor,) [rad]; None: its zero pose.
        """
        low, high = np.array([motor.movement_range for motor in robot.motors]).T
        target = rng.uniform(low, high, (self.count, len(low)))
        if schedule.whole_counts:
            units = robot.servo_units
            target = units.to_rad(np.round(units.to_counts(target)))
        ramp = rng.choice(self.ramp_shares, (self.count, len(low))) * self.period_s
        initial = np.zeros(len(low)) if initial is None else initial
        return Movements(
            initial=initial[None],
            target=target[None],
            ramp_duration=_cap_speed(initial, target, ramp)[None],
            start=self._starts(schedule, rng)[None],
        )

    def _starts(self, schedule: Schedule, rng: np.random.Generator) -> FloatArray:
        first = rng.uniform(*schedule.first_start_s)
        periods = rng.uniform(*schedule.period_s, self.count - 1)
        return np.concatenate([[first], first + np.cumsum(periods)])


def _cap_speed(initial: FloatArray, target: FloatArray, ramp: FloatArray) -> FloatArray:
    travel = np.abs(np.diff(target, axis=0, prepend=initial[None]))
    return np.maximum(ramp, travel / SPEED_CAP_RAD_S)
