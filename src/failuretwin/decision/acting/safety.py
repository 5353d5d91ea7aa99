"""What may be sent to an arm at all: limits, speed, floor, and links that keep apart.

    |travel| / duration <= share of the speed limit,    4 |travel| / duration^2 <= acceleration
    gap, height >= margin at every pose of the way

A way is straight in joint space. Each order is looked at twice: as the arm would follow it healthy,
and as it is believed to; it must be safe both ways, for the belief may be wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import numpy as np

from failuretwin.connection.links.base import Order
from failuretwin.core.config import Bounded, Bounds
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.clearance import Clearance
from failuretwin.digital_model.inverse_kinematics import usable_limits
from failuretwin.digital_model.robot import Robot

STEP_RAD = 0.02
"""Poses of a way are looked at so close to each other, travels of all motors added up [rad]."""
ROUNDING = 1e-9
RISE_S = 0.2
"""Time that a motor needs from rest to its speed limit [s]; with it acceleration."""
LEAST_RAMP_S = 0.4
"""Shortest ramp [s]."""

Way = tuple[FloatArray, FloatArray]
"""Pose at the start and at the end, (motor,) [rad]."""


class UnsafeOrderError(FailureTwinError):
    """An order that must not be sent; nothing was sent."""


@dataclass(frozen=True)
class SafetyLimits(Bounded):
    """What orders must keep to.

    Attributes:
        speed_share: Share of each motor's speed limit that may be used.
        radius_m: Radius of the links [m]; None: by the reach.
        floor_m: Height of the floor in the base frame [m]; None: that of the base.
    """

    speed_share: Annotated[float, Bounds(1e-6, 1.0)] = 0.5
    radius_m: float | None = None
    floor_m: float | None = None


@dataclass(frozen=True)
class SafetyGate:
    """Lets through what is safe and says in words what is not.

    Attributes:
        robot: The robot.
        limits: What orders must keep to.
    """

    robot: Robot
    limits: SafetyLimits = SafetyLimits()

    @cached_property
    def clearance(self) -> Clearance:
        """Gaps between its links and to the floor."""
        return Clearance.of(self.robot, self.limits.radius_m, self.limits.floor_m)

    @cached_property
    def margin_m(self) -> float:
        """Gap that poses looked at must have, so that none between them has less than 0 [m]."""
        return STEP_RAD * self.robot.reach / 2.0

    @cached_property
    def speed(self) -> FloatArray:
        """Largest speed of each motor, (motor,) [rad/s]."""
        own = np.array([motor.speed_limit for motor in self.robot.motors])
        return np.asarray(self.limits.speed_share * own)

    @cached_property
    def acceleration(self) -> FloatArray:
        """Largest acceleration of each motor, (motor,) [rad/s2]."""
        own = np.array([motor.speed_limit for motor in self.robot.motors])
        return np.asarray(own / RISE_S)

    def pose_limits(self, usual: bool) -> tuple[FloatArray, FloatArray]:
        """Return lowest and highest pose, (motor,) [rad]: of the joints, or of usual movements."""
        low, high = usable_limits(self.robot)
        if usual:
            own = np.array([motor.movement_range for motor in self.robot.motors]).T
            low, high = np.maximum(low, own[0]), np.minimum(high, own[1])
        return low, high

    def least_duration(self, travel: FloatArray) -> float:
        """Return the shortest time for travels (motor,) [rad] that all motors share [s].

        By constant speed, and by an acceleration up to the middle and down again.
        """
        return max(float(self._needed_s(travel).max()) * (1.0 + 1e-6), LEAST_RAMP_S)

    def _needed_s(self, travel: FloatArray) -> FloatArray:
        """Return the shortest time of each motor for its travel, (motor,) [s]."""
        away = np.abs(travel)
        return np.maximum(away / self.speed, 2.0 * np.sqrt(away / self.acceleration))

    def wrong(self, order: Order, ways: Sequence[Way]) -> str:
        """Return why an order must not be sent, empty if it may.

        Of the ways that the arm may take, the first is as the motors are told.
        """
        if not (np.isfinite(order.target).all() and np.isfinite(order.duration).all()):
            return "the order holds a value that is not finite"
        low, high = usable_limits(self.robot)
        beyond = (order.target < low - ROUNDING) | (order.target > high + ROUNDING)
        if beyond.any():
            return f"{self._names(beyond)} would leave its limits"
        fast = order.duration < self._needed_s(order.target - ways[0][0]) * (1.0 - ROUNDING)
        if fast.any():
            return f"{self._names(fast)} would be faster than is allowed"
        return self.in_the_way(ways)

    def in_the_way(self, ways: Sequence[Way]) -> str:
        """Return what an arm would come too near to on some ways, empty if to nothing.

        An arm that stands too near already may go where it comes no nearer.
        """
        poses = [way_between(start, end) for start, end in ways]
        first = np.cumsum([0, *(len(way) for way in poses)])
        gap, height = self.clearance.gap_and_height(np.concatenate(poses))
        for begin, end in pairwise(first.tolist()):
            for margin, what in ((gap, "its own links"), (height, "the floor")):
                allowed = min(self.margin_m, float(margin[begin]) - ROUNDING)
                if margin[begin:end].min() < allowed:
                    return f"the arm would come within {1e3 * self.margin_m:.0f} mm of {what}"
        return ""

    def _names(self, which: BoolArray) -> str:
        names = self.robot.motor_names
        return ", ".join(names[k] for k in np.flatnonzero(which))


def way_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the poses of a straight way in joint space, both ends included, (pose, motor)."""
    steps = max(1, int(np.ceil(np.abs(end - start).sum() / STEP_RAD)))
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return np.asarray(start + share * (end - start))
