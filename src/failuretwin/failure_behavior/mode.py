"""What every fault mode is: distributions of its parameters, and stages at which it may act.

A mode never touches the twin. Each stage below does nothing unless a mode says otherwise, and
works on all runs at once that have the mode at the same motor.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.fault import (
    INTERMITTENT,
    PROFILES,
    RAMP,
    STEP,
    Course,
    FaultGroup,
    FaultValue,
    PerMovement,
    draw_episodes,
)

Range = tuple[float, float]


@dataclass(frozen=True)
class MotorOrders:
    """What one motor is told in many runs.

    Attributes:
        target: Where to go, (run, movement) [rad].
        ramp_duration: Time from start to target, (run, movement) [s].
        start: When movements begin, (run, movement) [s].
        lost: Commands that do not arrive, (run, movement).
    """

    target: FloatArray
    ramp_duration: FloatArray
    start: FloatArray
    lost: BoolArray


@dataclass(frozen=True)
class MotorMotion:
    """What one motor did in many runs.

    Attributes:
        position: Its angles, (run, time) [rad].
        time: Grid of all runs, (time,) [s].
        start: When movements were commanded, (run, movement) [s].
    """

    position: FloatArray
    time: FloatArray
    start: FloatArray


@dataclass(frozen=True, kw_only=True)
class FaultMode(ABC):
    """A fault mode with the distributions of its parameters.

    All ranges are drawn from uniformly, anew for each run; equal ends fix the value. A mode that
    has no use for one of them makes it a field that cannot be set, so that nobody sets it in vain.

    Attributes:
        onset_s: Range of the onset [s]; no later than the end of the run.
        profiles: Time profiles that occur, each equally often.
        rise_s: Range of the time that a ramp takes from the onset to full severity [s].
        episode_s: Range of the lengths of intermittent episodes [s].
        episode_share: Range of the share of the time after the onset that episodes fill.

    Raises:
        InputError: If a range is out of order or out of bounds, or the mode does not know a
            profile.
    """

    mode: ClassVar[str]
    """Id of the mode."""
    allowed_profiles: ClassVar[tuple[str, ...]] = PROFILES
    """Time profiles that make sense for it."""
    needs_compliance: ClassVar[bool] = False
    """Whether it shows only at a motor that gives way under load."""

    onset_s: Range = (0.0, 5.0)
    profiles: tuple[str, ...] = (STEP,)
    rise_s: Range = (2.0, 8.0)
    episode_s: Range = (0.5, 2.0)
    episode_share: Range = (0.3, 0.7)

    def __post_init__(self) -> None:
        self._check_range("onset_s", 0.0, math.inf)
        if not self.profiles:
            raise InputError(f"{self.mode}: profiles is empty. Give at least one.")
        for profile in self.profiles:
            if profile not in self.allowed_profiles:
                raise InputError(
                    f"{self.mode}: {unknown_name('profile', profile, self.allowed_profiles)}"
                )
        if RAMP in self.profiles:
            self._check_range("rise_s", 1e-3, math.inf)
        if INTERMITTENT in self.profiles:
            self._check_range("episode_s", 1e-3, math.inf)
            self._check_range("episode_share", 0.0, 1.0)

    def _check_range(self, name: str, lowest: float, highest: float) -> None:
        """Refuse a range that is out of order, not finite or not within its bounds."""
        low, high = getattr(self, name)
        if not (lowest <= low <= high <= highest and math.isfinite(high)):
            raise InputError(
                f"{self.mode}: {name} is [{low:g}, {high:g}], expected two numbers in order, "
                f"between {lowest:g} and {highest:g}."
            )

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Return the fault as it strikes one run.

        Args:
            motor: Name of the motor.
            movements: Number of movements in the run.
            duration: Length of the run [s].
            rng: The run's own generator.
        """
        magnitude = self._draw_magnitude(rng)
        per_movement = self._draw_per_movement(movements, rng)
        onset = min(float(rng.uniform(*self.onset_s)), duration)
        course = self._draw_course(magnitude, onset, duration, rng)
        return FaultValue(Fault(motor, self.mode), magnitude, course, per_movement)

    @abstractmethod
    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        """Draw the size in the mode's unit; NaN where it follows from the motion."""

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        """Draw what differs from movement to movement, (movement,), by name."""
        return {}

    def _draw_course(
        self, magnitude: float, onset_s: float, end_s: float, rng: np.random.Generator
    ) -> Course:
        """Draw a time profile and its parameters."""
        profile = self.profiles[0]
        if len(self.profiles) > 1:
            profile = self.profiles[int(rng.integers(len(self.profiles)))]
        if profile == RAMP:
            return Course(profile, onset_s, rise_s=float(rng.uniform(*self.rise_s)))
        if profile == INTERMITTENT:
            share = float(rng.uniform(*self.episode_share))
            episodes = draw_episodes(onset_s, end_s, share, self.episode_s, rng)
            return Course(profile, onset_s, episodes=episodes)
        return Course(profile, onset_s)

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Return the orders that the motor follows; the same object where none changes."""
        return orders

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Return the reference (run, time) [rad] that the servo loop follows.

        Args:
            faults: The faults of these runs.
            reference: As the orders have it, (run, time) [rad]; the same object is returned
                where nothing changes.
            time: Uniform grid, (time,) [s].
        """
        return reference

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray | None:
        """Return when the gear holds the motor, (run, time) at `time` (time,) [s]; None: never."""
        return None

    def weakness(self, faults: FaultGroup, time: FloatArray) -> FloatArray | None:
        """Return the share of stiffness lost, (run, time) at `time` (time,) [s]; None: none."""
        return None

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with what only the motion tells: held angles, movements hit."""
        return faults


# Modes whose magnitude is drawn from a range.


@dataclass(frozen=True, kw_only=True)
class SizedMode(FaultMode):
    """A fault mode whose magnitude is drawn.

    Attributes:
        magnitude: Range of the magnitude, in the mode's unit.
    """

    lowest: ClassVar[float] = 0.0
    """Smallest magnitude that makes sense."""
    highest: ClassVar[float] = math.inf
    """Largest magnitude that makes sense."""

    magnitude: Range

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_range("magnitude", self.lowest, self.highest)

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(*self.magnitude))


@dataclass(frozen=True, kw_only=True)
class SignedMode(SizedMode):
    """A fault mode whose magnitude has a sign.

    Attributes:
        both_signs: Whether half of the magnitudes change their sign; otherwise they are drawn
            from the range as it stands, which may be negative.
    """

    lowest: ClassVar[float] = -math.inf

    both_signs: bool = True

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        size = super()._draw_magnitude(rng)
        return -size if self.both_signs and rng.random() < 0.5 else size
