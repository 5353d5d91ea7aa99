"""Modes whose magnitude is drawn from a range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from failuretwin.failure_behavior.modes.base import FaultMode, Range


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
