"""Modes in which the gear holds the motor: stuck, intermittent."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.course import INTERMITTENT, STEP, Course, draw_episodes
from failuretwin.failure_behavior.fault_value import FaultGroup
from failuretwin.failure_behavior.modes.base import FaultMode, MotorMotion, Range
from failuretwin.failure_behavior.modes.sized import SizedMode

PUBLISHED_ONSET_S = 0.49
"""Onset of stuck faults in the published data: frozen from 0-based sample 49 of 100 Hz on [s]."""


@dataclass(frozen=True, kw_only=True)
class Stuck(FaultMode):
    """The motor keeps the angle that it has at the onset; its magnitude is that angle [rad].

    Intermittent, it is held in episodes, and the magnitude is the angle of the first.
    """

    mode: ClassVar[str] = "stuck"
    allowed_profiles: ClassVar[tuple[str, ...]] = (STEP, INTERMITTENT)

    onset_s: Range = (PUBLISHED_ONSET_S, PUBLISHED_ONSET_S)
    rise_s: Range = field(init=False, default=(0.0, 0.0))

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return np.nan

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray:
        """Return when the motor is held: wherever the fault is there."""
        return faults.severity(time) > 0.0

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the angle at the first instant that the motor is held."""
        held = self.held(faults, motion.time)
        first = np.argmax(held, axis=1)
        angle = motion.position[np.arange(len(first)), first]
        return replace(faults, magnitude=np.where(held.any(axis=1), angle, np.nan))


@dataclass(frozen=True, kw_only=True)
class Intermittent(SizedMode):
    """The motor is held in episodes; its magnitude is their share of the time from the onset on."""

    mode: ClassVar[str] = "intermittent"
    allowed_profiles: ClassVar[tuple[str, ...]] = (INTERMITTENT,)
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.2, 0.6)
    profiles: tuple[str, ...] = (INTERMITTENT,)
    rise_s: Range = field(init=False, default=(0.0, 0.0))
    episode_share: Range = field(init=False, default=(0.0, 0.0))

    def _draw_course(
        self, magnitude: float, onset_s: float, end_s: float, rng: np.random.Generator
    ) -> Course:
        """Draw episodes that fill the share that the magnitude says."""
        episodes = draw_episodes(onset_s, end_s, magnitude, self.episode_s, rng)
        return Course(INTERMITTENT, onset_s, episodes=episodes)

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray:
        """Return when the motor is held: in every episode."""
        return faults.severity(time) > 0.0
