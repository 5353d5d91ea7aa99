"""The physics engine's arm, told from outside where to go: a `Commander` without a robot.

Time passes when it is polled, in slices, none before it is due. An order is carried out at once,
unless the bus stalls: then readings stop, and what was ordered waits until it comes back. A motor
that is told nothing new keeps the place that it has.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from failuretwin.connection.emulated_arm import MEMORY_S, STEP_S, EmulatedArm, Emulation
from failuretwin.connection.links.base import CommandSent, Event, LinkCounts, Order, Reading
from failuretwin.connection.links.replay import AS_FAST_AS_POSSIBLE, Pace
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.disturbances import Disturbances, sense, stack

SLICE_S, PACED_SLICE_S = 0.1, 0.05
"""Time that passes at a time, as fast as possible and by a clock: so long an order may wait [s]."""
UNMOVED_RAD = 1e-9
"""Commands nearer than this are the same [rad]."""


@dataclass(frozen=True)
class _Ramp:
    """What the motors are told from a time on.

    Attributes:
        start_s: When it begins [s].
        origin: Where they were told to be, (motor,) [rad].
        aim: Where they go, bias, scatter and faults of their orders included, (motor,) [rad].
        duration: Time to get there, (motor,) [s].
    """

    start_s: float
    origin: FloatArray
    aim: FloatArray
    duration: FloatArray

    def at(self, time: FloatArray) -> FloatArray:
        """Return what the motors are told, (time, motor) [rad]."""
        since = time[:, None] - self.start_s
        share = np.clip(since / np.maximum(self.duration, STEP_S), 0.0, 1.0)
        return np.asarray(self.origin + share * (self.aim - self.origin))


class CommandedArm(EmulatedArm):
    """An emulated arm that does what it is told; the same seed gives the same arm and bad luck.

    Bad luck is drawn for each slice of time, so it is another by a clock than as fast as possible.

    Args:
        emulation: What to emulate.
        pace: How fast its time passes; None: as fast as possible.

    Raises:
        InputError: If mujoco is missing.
    """

    ended = False

    def __init__(self, emulation: Emulation, pace: Pace | None = None) -> None:
        super().__init__(emulation)
        self.name = f"emulated {emulation.robot.name}, commanded"
        self._pace = pace or Pace(AS_FAST_AS_POSSIBLE)
        self._slice_s = SLICE_S if self._pace.speed == AS_FAST_AS_POSSIBLE else PACED_SLICE_S
        self._queue: deque[Event] = deque()
        self._given = 0
        self._waiting: list[Order] = []
        self._ordered = self._commanded
        self._ramp = _Ramp(0.0, self._told[-1], self._told[-1], np.full(len(self._commanded), 1.0))
        self._silent = (np.inf, np.inf)

    @property
    def counts(self) -> LinkCounts:
        """How many events have been given."""
        return LinkCounts(received=self._given)

    @property
    def standing(self) -> FloatArray:
        """What the motors were told last, (motor,) [rad]."""
        return self._ordered

    @property
    def angle(self) -> FloatArray:
        """Where the motors really stand, (motor,) [rad]; nobody but a judge may look."""
        return self._arm.angle

    def send(self, order: Order) -> None:
        """Take an order; it begins with the next slice, or when the bus comes back."""
        self._waiting.append(order)
        self._ordered = order.target

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if it is not due in time."""
        while not self._queue:
            if not self._pace.due(self._index * STEP_S, timeout_s):
                return None
            self._pass()
        if not self._pace.due(self._queue[0].time, timeout_s):
            return None
        self._given += 1
        return self._queue.popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to be closed."""

    def _pass(self) -> None:
        """Let one slice of time pass."""
        steps = round(self._slice_s / STEP_S)
        time = as_floats(np.arange(self._index, self._index + steps + 1) * STEP_S)
        now = float(time[0])
        if self._waiting and not self._silent[0] <= now < self._silent[1]:
            self._begin(self._waiting.pop(0), now)
        drawn = self._draw()
        faults = self._injection(now - MEMORY_S, float(time[-1]))
        position = self._follow(self._ramp.at(time), time, self._lag, faults)
        self._read(position, time, drawn)

    @property
    def _lag(self) -> FloatArray:
        return np.asarray(self._self.lag)[None]

    def _begin(self, order: Order, now: float) -> None:
        """Carry out an order; from here on its luck decides."""
        drawn = self._draw()
        movement = Movements(
            self._commanded[None],
            order.target[None, None],
            order.duration[None, None],
            np.array([[now]]),
        )
        faults = self._injection(now, now + 1.0)
        faulty, lost = faults.on_movements(movement, drawn.lost[None, 1:])
        here = self._ramp.at(np.array([now]))[0]
        aim = faulty.target[0, 0] + self._self.bias + drawn.scatter[2]
        stays = lost[0, 0] | (np.abs(order.target - self._commanded) < UNMOVED_RAD)
        duration = faulty.ramp_duration[0, 0] * (1.0 - self._self.shortening)
        self._ramp = _Ramp(
            now + float(self._self.delay), here, np.where(stays, here, aim), duration
        )
        self._commanded = np.where(lost[0, 0], self._commanded, order.target)
        self._queue.append(CommandSent(now, order.target, order.duration))
        late, period = float(drawn.late[1]), self._imperfections.schedule.period_s
        if late > 0.0:
            begin = now + float(drawn.gap_start[1])
            self._silent = begin, max(begin, now + 0.5 * sum(period)) + late

    def _read(self, position: FloatArray, time: FloatArray, drawn: Disturbances) -> None:
        """Put the readings of a slice into the queue."""
        local = time - time[0]
        chance = stack([self._with_readings(drawn, time)])
        chance = replace(chance, stalled=np.array([False]), late=np.zeros((1, 1)),
                         gap_start=np.zeros((1, 1)))  # fmt: skip
        measured, angle = sense(
            self._twin, self._imperfections.readings, position[None], local,
            np.zeros((1, 1)), chance,
        )  # fmt: skip
        seen = np.isfinite(angle[0]).any(axis=1) & (local > 0.0)
        seen &= ~((time >= self._silent[0]) & (time < self._silent[1]))
        for k in np.flatnonzero(seen):
            self._queue.append(Reading(float(time[k]), measured[0, k], angle[0, k]))
