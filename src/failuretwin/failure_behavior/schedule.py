"""Faults on a schedule: which motor fails how, from when, and when it is repaired."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.failure_behavior.course import INTERMITTENT, STEP, Course

FORM = "MOTOR:MODE@START or MOTOR:MODE@START-END with times in seconds, such as motor_3:stuck@40-80"


@dataclass(frozen=True)
class ScheduledFault:
    """A fault that comes, and may go.

    Attributes:
        fault: Motor and mode.
        start_s: When it begins [s].
        end_s: When it is repaired [s]; infinity: never.
    """

    fault: Fault
    start_s: float
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < self.end_s:
            raise InputError(
                f"fault {self.fault} lasts from {self.start_s:g} to {self.end_s:g} s, expected a "
                "start of 0 or more and an end after it."
            )

    @property
    def course(self) -> Course:
        """Its severity over time: none or all."""
        if math.isinf(self.end_s):
            return Course(STEP, self.start_s)
        return Course(INTERMITTENT, self.start_s, episodes=((self.start_s, self.end_s),))

    def overlaps(self, begin_s: float, end_s: float) -> bool:
        """Return whether it is there at any time between two times [s]."""
        return self.start_s < end_s and begin_s < self.end_s

    @classmethod
    def parse(cls, text: str, motors: Sequence[str]) -> ScheduledFault:
        """Read the text form.

        Args:
            text: Such as ``motor_3:stuck@40-80``.
            motors: Names of the robot's motors in chain order.

        Raises:
            InputError: If the text does not follow the form or names an unknown motor or mode.
        """
        match = re.fullmatch(r"([^@]+)@([\d.]+)(?:-([\d.]+))?", text.strip())
        try:
            name, *times = match.groups() if match else ()
            start, end = (math.inf if value is None else float(value) for value in times)
        except ValueError:
            raise InputError(f"fault {text!r} is not of the form {FORM}.") from None
        hypothesis = Hypothesis.parse(name, motors)
        if len(hypothesis.faults) != 1:
            raise InputError(f"fault {text!r} names no single fault. Expected {FORM}.")
        return cls(hypothesis.faults[0], start, end)


def state_at(schedule: Iterable[ScheduledFault], time_s: float, motors: Sequence[str]) -> str:
    """Return the true hypothesis at a time [s], as text."""
    there = [f.fault for f in schedule if f.start_s <= time_s < f.end_s]
    return str(Hypothesis(tuple(sorted(there, key=lambda fault: motors.index(fault.motor)))))
