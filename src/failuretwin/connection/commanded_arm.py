"""Emulated arms that take orders: a `Commander` without a robot, and one that works in shifts.

Time passes in slices when the arm is polled. An order is carried out at once, unless the bus
stalls: then readings stop, and the order waits until the bus answers. A motor whose target does not
change keeps its place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.emulated_arm import (
    FIRST_COMMAND_S,
    MEMORY_S,
    STEP_S,
    EmulatedArm,
    Emulation,
)
from failuretwin.connection.links.base import CommandSent, Event, Order, Reading
from failuretwin.connection.links.replay import AS_FAST_AS_POSSIBLE, Pace, PacedSource, Wait
from failuretwin.connection.links.stream_time import Ramp
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.disturbances import Disturbances, sense, stack
from failuretwin.failure_behavior.random_movements import RandomMovements

SLICE_S, PACED_SLICE_S = 0.1, 0.05
"""Length of a slice, as fast as possible and by a clock; an order may wait this long [s]."""
UNMOVED_RAD = 1e-9
"""Largest difference of targets that count as equal [rad]."""
OPERATOR = 1
"""Number of the operator's random stream, apart from the arm's own."""


class CommandedArm(EmulatedArm, PacedSource):
    """Emulated arm that takes orders; the same seed gives the same arm and disturbances.

    Disturbances are drawn per slice, so they differ by a clock and as fast as possible.

    Args:
        emulation: Settings of the arm.
        pace: Clock of its time; None: as fast as possible.

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(self, emulation: Emulation, pace: Pace | None = None) -> None:
        EmulatedArm.__init__(self, emulation)
        pace = pace or Pace(AS_FAST_AS_POSSIBLE)
        name = f"emulated {emulation.robot.name}, commanded"
        PacedSource.__init__(self, name, self._slices(), pace)
        self._slice_s = SLICE_S if pace.speed == AS_FAST_AS_POSSIBLE else PACED_SLICE_S
        self._waiting: list[Order] = []
        self._ordered = self._commanded
        self._ramp = Ramp(0.0, self._told[-1], self._told[-1], np.zeros(len(self._commanded)))
        self._silent = (np.inf, np.inf)

    @property
    def standing(self) -> FloatArray:
        """Last target of the motors, (motor,) [rad]."""
        return self._ordered

    @property
    def angle(self) -> FloatArray:
        """True angles of the motors, (motor,) [rad]; for judging results only."""
        return self._arm.angle[0]

    def send(self, order: Order) -> None:
        """Take an order; it begins with the next slice, or when the bus answers again."""
        self._waiting.append(order)
        self._ordered = order.target

    def _slices(self) -> Iterator[Event | Wait]:
        """Yield the events of slices, each of which passes when it is due."""
        while True:
            yield Wait(self._index * STEP_S)
            yield from self._pass()

    def _pass(self) -> list[Event]:
        """Let one slice of time pass, and return its events."""
        steps = round(self._slice_s / STEP_S)
        time = as_floats(np.arange(self._index, self._index + steps + 1) * STEP_S)
        now, events = float(time[0]), list[Event]()
        if self._waiting and not self._silent[0] <= now < self._silent[1]:
            events.append(self._begin(self._waiting.pop(0), now))
        drawn = self._draw()
        faults = self._injection(now - MEMORY_S, float(time[-1]))
        position = self._follow(self._ramp.at(time), time, self._lag, faults)
        return [*events, *self._read(position, time, drawn)]

    @property
    def _lag(self) -> FloatArray:
        return np.asarray(self._self.lag)[None]

    def _begin(self, order: Order, now: float) -> CommandSent:
        """Begin an order, with its disturbances and faults; return it as it was sent."""
        drawn = self._draw()
        movement = Movements(
            self._commanded[None],
            order.target[None, None],
            order.duration[None, None],
            np.array([[now]]),
        )
        faults = self._injection(now, now + 1.0)
        faulty, lost = faults.on_movements(movement, drawn.lost[None, 1:])
        here = self._ramp.at(now)
        aim = faulty.target[0, 0] + self._self.bias + drawn.scatter[2]
        stays = lost[0, 0] | (np.abs(order.target - self._commanded) < UNMOVED_RAD)
        duration = faulty.ramp_duration[0, 0] * (1.0 - self._self.shortening)
        self._ramp = Ramp(now + float(self._self.delay), here, np.where(stays, here, aim), duration)
        self._commanded = np.where(lost[0, 0], self._commanded, order.target)
        late, period = float(drawn.late[1]), self._imperfections.schedule.period_s
        if late > 0.0:
            begin = now + float(drawn.gap_start[1])
            self._silent = begin, max(begin, now + 0.5 * sum(period)) + late
        return CommandSent(now, order.target, order.duration)

    def _read(
        self, position: FloatArray, time: FloatArray, drawn: Disturbances
    ) -> Iterator[Reading]:
        """Yield the readings of a slice."""
        local, zero = time - time[0], np.zeros((1, 1))
        chance = stack([self._with_readings(drawn, time)])
        chance = replace(chance, stalled=np.array([False]), late=zero, gap_start=zero)
        readings = self._imperfections.readings
        measured, angle = sense(self._twin, readings, position[None], local, zero, chance)
        seen = np.isfinite(angle[0]).any(axis=1) & (local > 0.0)
        seen &= ~((time >= self._silent[0]) & (time < self._silent[1]))
        for k in np.flatnonzero(seen):
            yield Reading(float(time[k]), measured[0, k], angle[0, k])


# Work in shifts.


@dataclass(frozen=True)
class Shifts:
    """Working hours of an arm.

    Attributes:
        movements: Movements of a shift.
        break_s: Time from the last of them to the next shift [s].
        duration_s: Time after which the arm ends [s].
    """

    movements: int = 12
    break_s: float = 30.0
    duration_s: float = math.inf


class OperatedArm(CommandedArm):
    """Commanded arm that also moves at random, in shifts; the same seed gives the same life.

    In the breaks it is free for the orders of others, which the operator does not notice.

    Args:
        emulation: Settings of the arm.
        shifts: Its working hours; None: the default.
        pace: Clock of its time; None: as fast as possible.

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

    def _slices(self) -> Iterator[Event | Wait]:
        while self._index * STEP_S < self._shifts.duration_s:
            yield Wait(self._index * STEP_S)
            if self._index * STEP_S >= self._next_s:
                self._work()
            yield from self._pass()

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
