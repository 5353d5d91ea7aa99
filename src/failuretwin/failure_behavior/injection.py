"""Faults into runs: on the targets before the motors move, on the angles after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.modes import FaultMode, FaultValue


@dataclass(frozen=True)
class Injection:
    """The faults of many runs, ready to act.

    Attributes:
        faults: Faults of each run.
        motors: Names of the motors in chain order.
        modes: The modes by id.
    """

    faults: Sequence[Sequence[FaultValue]]
    motors: Sequence[str]
    modes: Mapping[str, FaultMode]

    def on_targets(self, movements: Movements) -> Movements:
        """Return the movements that the faulty motors follow; the given ones stay as they are."""
        if not any(value.offset.any() for values in self.faults for value in values):
            return movements
        target = movements.target.copy()
        for run, values in enumerate(self.faults):
            for value in values:
                target[run, :, self.motors.index(value.fault.motor)] += value.offset
        return replace(movements, target=target)

    def on_angles(self, position: FloatArray, time: FloatArray) -> FloatArray:
        """Return the angles (run, time, motor) [rad] as the faults leave them; a new array."""
        position = position.copy()
        for run, values in enumerate(self.faults):
            for value in values:
                motor = self.motors.index(value.fault.motor)
                mode = self.modes[value.fault.mode]
                position[run, :, motor] = mode.hold(position[run, :, motor], time, value.onset_s)
        return position

    def magnitudes(self, position: FloatArray) -> FloatArray:
        """Return each run's first magnitude, NaN when healthy; for stuck, the angle held."""
        magnitude = np.full(len(self.faults), np.nan)
        for run, values in enumerate(self.faults):
            for value in values[:1]:
                motor = self.motors.index(value.fault.motor)
                held = position[run, -1, motor]
                magnitude[run] = held if value.fault.mode == "stuck" else value.magnitude
        return magnitude
