"""Modes that spoil the way to the target: slow, lag, backlash, lost commands."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.course import RAMP, STEP
from failuretwin.failure_behavior.fault_value import FaultGroup, PerMovement
from failuretwin.failure_behavior.modes.base import MotorMotion, MotorOrders, Range
from failuretwin.failure_behavior.modes.sized import SizedMode

CHANCE, LOST = "chance", "lost"


@dataclass(frozen=True, kw_only=True)
class Slow(SizedMode):
    """The motor loses a share of its speed; movements cut short what they interrupt."""

    mode: ClassVar[str] = "slow"
    highest: ClassVar[float] = 0.99

    magnitude: Range = (0.3, 0.8)
    profiles: tuple[str, ...] = (STEP, RAMP)

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Draw out the ramps of movements that start after the onset."""
        speed = 1.0 - faults.effect(orders.start)
        return replace(orders, ramp_duration=orders.ramp_duration / speed)


@dataclass(frozen=True, kw_only=True)
class Lag(SizedMode):
    """The motor follows its reference late by a dead time [s].

    The default range lies above the 0.04 to 0.06 s by which healthy motors of the ArmPi FPV lag.
    """

    mode: ClassVar[str] = "lag"

    magnitude: Range = (0.1, 0.3)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Delay the reference; it waits where the dead time grows and never runs backwards."""
        step = (time[-1] - time[0]) / (len(time) - 1)
        place = np.arange(len(time)) - faults.effect(time) / step
        place = np.maximum.accumulate(np.maximum(place, 0.0), axis=1)
        low = place.astype(np.int64)
        before = np.take_along_axis(reference, low, axis=1)
        after = np.take_along_axis(reference, np.minimum(low + 1, len(time) - 1), axis=1)
        return before + (place - low) * (after - before)


@dataclass(frozen=True, kw_only=True)
class Backlash(SizedMode):
    """The joint has play [rad]: it keeps its place until the motor has turned through it.

    At the onset the motor stands in the middle of the play, so that the joint settles half of it
    short of each target, seen in the direction of travel.
    """

    mode: ClassVar[str] = "backlash"
    allowed_profiles: ClassVar[tuple[str, ...]] = (STEP, RAMP)

    magnitude: Range = (0.03, 0.12)
    profiles: tuple[str, ...] = (STEP, RAMP)
    episode_s: Range = field(init=False, default=(0.0, 0.0))
    episode_share: Range = field(init=False, default=(0.0, 0.0))

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Pass the reference through the play."""
        half = 0.5 * faults.effect(time).T
        low, high = reference.T - half, reference.T + half
        output = np.empty_like(low)
        here = reference[:, 0]
        for k in range(len(time)):
            here = np.minimum(np.maximum(here, low[k]), high[k])
            output[k] = here
        return output.T


@dataclass(frozen=True, kw_only=True)
class LostCommands(SizedMode):
    """A share of the commands never arrives: the motor stays where it is for that movement."""

    mode: ClassVar[str] = "lost_commands"
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.3, 0.8)

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        return {CHANCE: rng.random(movements)}

    def _lost(self, faults: FaultGroup, start: FloatArray) -> BoolArray:
        """Return which movements are lost, (run, movement)."""
        return np.asarray(faults.per_movement[CHANCE] < faults.effect(start))

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Lose commands beside those that get lost anyway."""
        return replace(orders, lost=orders.lost | self._lost(faults, orders.start))

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the movements that this fault has lost."""
        return replace(faults, per_movement={LOST: self._lost(faults, motion.start)})
