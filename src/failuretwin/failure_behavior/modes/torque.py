"""The mode in which the motor cannot carry its load: torque loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.course import RAMP, STEP
from failuretwin.failure_behavior.fault_value import FaultGroup
from failuretwin.failure_behavior.modes.base import Range
from failuretwin.failure_behavior.modes.sized import SizedMode


@dataclass(frozen=True, kw_only=True)
class TorqueLoss(SizedMode):
    """The motor loses a share of its stiffness: it sags 1 / (1 - magnitude) times as far."""

    mode: ClassVar[str] = "torque_loss"
    highest: ClassVar[float] = 0.99
    needs_compliance: ClassVar[bool] = True

    magnitude: Range = (0.3, 0.7)
    profiles: tuple[str, ...] = (STEP, RAMP)

    def weakness(self, faults: FaultGroup, time: FloatArray) -> FloatArray:
        """Return the share of stiffness lost."""
        return faults.effect(time)
