"""An emulated arm at which somebody works: random movements in shifts, and breaks between them.

In a break it does what it is told by others; who works there does not ask what they are doing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.commanded_arm import CommandedArm
from failuretwin.connection.emulated_arm import FIRST_COMMAND_S, STEP_S, Emulation
from failuretwin.connection.links.base import Event, Order
from failuretwin.connection.links.replay import Pace
from failuretwin.failure_behavior.random_movements import RandomMovements

OPERATOR = 1
"""Number of the chance of who works there, beside the arm's own."""


@dataclass(frozen=True)
class Shifts:
    """How somebody works with an arm.

    Attributes:
        movements: Movements of a shift.
        break_s: Time from the last of them to the next shift [s].
        duration_s: How long the arm is there [s].
    """

    movements: int = 12
    break_s: float = 30.0
    duration_s: float = math.inf


class OperatedArm(CommandedArm):
    """A commanded arm with somebody who works with it; the same seed is the same life.

    Args:
        emulation: What to emulate.
        shifts: When it is worked with.
        pace: How fast its time passes; None: as fast as possible.

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(
        self, emulation: Emulation, shifts: Shifts | None = None, pace: Pace | None = None
    ) -> None:
        super().__init__(emulation, pace)
        self.name = f"emulated {emulation.robot.name}, at work in shifts"
        self._shifts = shifts or Shifts()
        self._chance = np.random.default_rng([emulation.seed, OPERATOR])
        self._next_s, self._made = FIRST_COMMAND_S, 0

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if it is not due in time, or the arm's time is over."""
        if not self._queue and self._index * STEP_S >= self._shifts.duration_s:
            self.ended = True
            return None
        return super().poll(timeout_s)

    def _pass(self) -> None:
        if self._index * STEP_S >= self._next_s:
            self._work()
        super()._pass()

    def _work(self) -> None:
        """Order the next movement of a shift, once the one before has begun."""
        schedule, robot = self._imperfections.schedule, self._emulation.robot
        self._next_s = self._index * STEP_S + float(self._chance.uniform(*schedule.period_s))
        if self._waiting:
            return
        drawn = RandomMovements(count=1).draw(robot, schedule, self._chance, self._ordered)
        self.send(Order(drawn.target[0, 0], drawn.ramp_duration[0, 0]))
        self._made += 1
        if self._made % self._shifts.movements == 0:
            self._next_s += self._shifts.break_s
