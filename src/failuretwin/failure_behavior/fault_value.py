"""Faults as they strike: one in one run, and those of one mode at one motor over many runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.course import Course, exposures, severities

PerMovement = NDArray[np.float64 | np.bool_]
"""Something drawn for each movement: a number, or yes or no."""


@dataclass(frozen=True)
class FaultValue:
    """One fault as it strikes one run.

    Attributes:
        fault: Motor and mode.
        magnitude: Size at full severity in the mode's unit; NaN where it is not known, or not
            before the motion is.
        course: Onset and severity over time.
        per_movement: What was drawn for each movement, (movement,), by its name in the truth.
    """

    fault: Fault
    magnitude: float
    course: Course
    per_movement: Mapping[str, PerMovement] = field(default_factory=dict)

    @property
    def onset_s(self) -> float:
        """When it begins [s]."""
        return self.course.onset_s

    def detail(self) -> dict[str, Any]:
        """Return the full truth as a JSON object; what is not known is None."""
        return {
            "motor": self.fault.motor,
            "mode": self.fault.mode,
            "magnitude": None if np.isnan(self.magnitude) else self.magnitude,
            "unit": self.fault.magnitude_unit,
            "onset_s": self.onset_s,
            "profile": self.course.detail(),
            **{name: values.tolist() for name, values in self.per_movement.items()},
        }


@dataclass(frozen=True)
class FaultGroup:
    """Faults of one mode at one motor, over the runs that have them.

    Attributes:
        magnitude: Size in the mode's unit, (run,).
        courses: Onset and severity over time, one for each run.
        per_movement: What was drawn for each movement, (run, movement), by name.
    """

    magnitude: FloatArray
    courses: Sequence[Course]
    per_movement: Mapping[str, PerMovement] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Sequence[FaultValue]) -> FaultGroup:
        """Return the faults of several runs as one value."""
        return cls(
            magnitude=np.array([value.magnitude for value in values]),
            courses=[value.course for value in values],
            per_movement={
                name: np.stack([value.per_movement[name] for value in values])
                for name in values[0].per_movement
            },
        )

    def severity(self, time: FloatArray) -> FloatArray:
        """Return the severity (run, time) at `time`, (time,) or (run, time) [s]."""
        return severities(self.courses, time)

    def effect(self, time: FloatArray) -> FloatArray:
        """Return magnitude times severity, (run, time), at `time`, (time,) or (run, time) [s]."""
        return self.magnitude[:, None] * self.severity(time)

    def accumulated(self, time: FloatArray) -> FloatArray:
        """Return the integral of `effect` up to `time` (time,) [s]: (run, time)."""
        return self.magnitude[:, None] * exposures(self.courses, time)
