"""Which movement of an emulated robot is the first that can show a fault.

Told from the truth alone, not from any diagnosis: what the fault does is the difference to the
same life without it. It can be shown once it is expected to beat every other hypothesis by
`SHOWN_NATS`, in units of the declared scatter and of the declared chance of lost commands
(docs/isolability.md): a motor that stays where it was for one movement can as well have lost a
command.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin import DigitalTwin
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.runs import RunTable, Truth
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.failure_behavior.fault import STEP, Course, FaultValue
from failuretwin.failure_behavior.injection import ScheduledFault
from failuretwin.failure_behavior.modes import OFFSET, SteadyStateError
from failuretwin.inference.expected_bayes_factors import expected_log_bayes_factors

ERROR = SteadyStateError.mode
SHOWN_NATS = 5.0
MOST_MOVEMENTS = 8
"""Movements after an onset that are looked at."""
STEP_S = 0.01
REST_S = 0.5
"""How long before the next command a movement's end is read [s]."""


@dataclass(frozen=True)
class Life:
    """What an emulated robot was told, and where it was seen.

    Attributes:
        commands: In order.
        readings: In order.
    """

    commands: Sequence[CommandSent]
    readings: Sequence[Reading]

    @classmethod
    def of(cls, emulation: Emulation, seconds: float) -> Life:
        """Return the first seconds of a life."""
        commands: list[CommandSent] = []
        readings: list[Reading] = []
        arm = EmulatedArm(emulation, shifts=Shifts(break_s=0.0, duration_s=seconds))
        while (event := arm.poll(0.0)) is not None:
            if isinstance(event, CommandSent):
                commands.append(event)
            else:
                readings.append(event)
        return cls(commands, readings)

    @cached_property
    def starts(self) -> FloatArray:
        """When movements were commanded, (movement,) [s]."""
        return np.array([command.time for command in self.commands])

    @cached_property
    def times(self) -> FloatArray:
        """When readings were made, (reading,) [s]."""
        return np.array([reading.time for reading in self.readings])

    def rest(self, number: int) -> FloatArray:
        """Return the last angles read in a movement, (motor,) [rad]; NaN: none near its end."""
        end = self.starts[number + 1]
        near = np.flatnonzero((self.times > end - REST_S) & (self.times < end)).tolist()
        angles = [as_floats(self.readings[i].position) for i in near]
        seen = [one for one in angles if np.isfinite(one).all()]
        return seen[-1] if seen else np.full_like(self.commands[0].target, np.nan)


@dataclass(frozen=True)
class CanShow:
    """Finds the movements that can show the faults of an emulation.

    Attributes:
        emulation: The robot with its faults.
        seconds: How long it lives [s].
    """

    emulation: Emulation
    seconds: float

    @cached_property
    def _life(self) -> Life:
        return Life.of(self.emulation, self.seconds)

    @cached_property
    def _without(self) -> Life:
        return Life.of(replace(self.emulation, schedule=()), self.seconds)

    def movement(self, fault: ScheduledFault) -> int | None:
        """Return the first movement after the onset that can show a fault, from 1; None: none."""
        starts = self._life.starts[:-1]
        first = int(np.searchsorted(starts, fault.start_s))
        last = min(int(np.searchsorted(starts, fault.end_s)), first + MOST_MOVEMENTS)
        numbers = np.arange(first - 1, last)
        runs = self._prefixes(fault, numbers).to_dataset()
        twin = DigitalTwin(self.emulation.robot)
        ahead = expected_log_bayes_factors(twin, runs, self.emulation.imperfections).nearest
        shown = np.flatnonzero(ahead >= SHOWN_NATS)
        return int(shown[0]) + 1 if len(shown) else None

    def _prefixes(self, fault: ScheduledFault, numbers: np.ndarray) -> RunTable:
        """Return one run for each movement after the first: the same one, seen up to its end."""
        life, count = self._life, len(numbers) - 1
        zero = life.starts[numbers[0]]
        told = [life.commands[n] for n in numbers]
        movements = Movements(
            initial=life.commands[numbers[0] - 1].target[None],
            target=np.stack([one.target for one in told])[None],
            ramp_duration=np.stack([one.duration for one in told])[None],
            start=np.array([[one.time - zero for one in told]]),
        )
        many = stack_movements([movements] * count)
        ends = life.starts[numbers[1:] + 1] - zero
        time = np.arange(round(ends[-1] / STEP_S) + 1) * STEP_S
        measured = np.full((count, len(time), 3), np.nan)
        for at, reading in zip(life.times - zero, life.readings, strict=True):
            if 0.0 <= at < ends[-1] and np.isfinite(reading.tool).all():
                measured[at < ends, round(at / STEP_S)] = reading.tool
        onset = fault.start_s - zero
        drawn = {OFFSET: self._offsets(fault, numbers)} if fault.fault.mode == ERROR else {}
        value = FaultValue(fault.fault, np.nan, Course(STEP, onset), drawn)
        return RunTable(
            run=[f"seen for {k + 1}" for k in range(count)],
            motor=self.emulation.robot.motor_names,
            time=as_floats(time),
            command=many.reference(as_floats(time)),
            measured=measured,
            measured_rate_hz=10.0,
            movements=many,
            truth=Truth(
                [str(fault.fault)] * count,
                [{"faults": [value.detail("rad")]}] * count,
                np.full(count, onset),
                np.full(count, np.nan),
            ),
            attributes={"robot": self.emulation.robot.name},
        )

    def _offsets(self, fault: ScheduledFault, numbers: np.ndarray) -> FloatArray:
        """Return by how much the fault put the motor off in each movement [rad]."""
        motor = self.emulation.robot.motor_names.index(fault.fault.motor)
        off = [(self._life.rest(n) - self._without.rest(n))[motor] for n in numbers]
        return np.nan_to_num(np.array([0.0, *off[1:]]))
