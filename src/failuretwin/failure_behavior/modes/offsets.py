"""Modes that put the motor beside its target: steady-state error, encoder faults, drift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.fault_value import FaultGroup, PerMovement
from failuretwin.failure_behavior.modes.base import MotorMotion, MotorOrders, Range
from failuretwin.failure_behavior.modes.sized import SignedMode, SizedMode

PUBLISHED_ERROR_RAD = (float(np.deg2rad(10 * 0.24)), float(np.deg2rad(50 * 0.24)))
"""Bounds of the paper's steady-state errors: 10 and 50 counts of 0.24 deg [rad]."""

OFFSET = "offset_rad"


@dataclass(frozen=True, kw_only=True)
class SteadyStateError(SizedMode):
    """Every target is missed by an error of random size and sign, drawn anew for each movement.

    The magnitude of a run is the rms of its errors over the movements that start after the onset.

    Attributes:
        magnitude: Range of the size of one error [rad]; the default is the paper's.
    """

    mode: ClassVar[str] = "steady_state_error"

    magnitude: Range = PUBLISHED_ERROR_RAD
    onset_s: Range = (0.0, 0.0)

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return np.nan

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        sign = np.where(rng.random(movements) < 0.5, -1.0, 1.0)
        return {OFFSET: sign * rng.uniform(*self.magnitude, movements)}

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Add its error to every target."""
        offset = faults.per_movement[OFFSET] * faults.severity(orders.start)
        return replace(orders, target=orders.target + offset)

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the errors as severe as they were, and their rms."""
        severity = faults.severity(motion.start)
        offset = faults.per_movement[OFFSET] * severity
        hit = np.maximum(np.count_nonzero(severity, axis=1), 1)
        rms = np.sqrt(np.sum(offset**2, axis=1) / hit)
        return replace(faults, magnitude=rms, per_movement={OFFSET: offset})


@dataclass(frozen=True, kw_only=True)
class EncoderBias(SignedMode):
    """The position sensor is off by an angle [rad], and so is the motor, everywhere."""

    mode: ClassVar[str] = "encoder_bias"

    magnitude: Range = PUBLISHED_ERROR_RAD

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference."""
        return reference + faults.effect(time)


@dataclass(frozen=True, kw_only=True)
class EncoderScale(SignedMode):
    """The position sensor is off in proportion to the angle: the motor goes (1 + magnitude) as far.

    Seen from the motor's zero angle. The default range is nearly that of runs recorded in 2024
    with a proportional error, which had shares from -0.63 to 0.73.
    """

    mode: ClassVar[str] = "encoder_scale"
    lowest: ClassVar[float] = -1.0
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.05, 0.7)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Stretch the reference about zero."""
        return reference * (1.0 + faults.effect(time))


@dataclass(frozen=True, kw_only=True)
class Drift(SignedMode):
    """The motor slips away from its target at a rate [rad/s]; what has slipped stays slipped."""

    mode: ClassVar[str] = "drift"

    magnitude: Range = (0.01, 0.05)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference by what has slipped so far."""
        return reference + faults.accumulated(time)
