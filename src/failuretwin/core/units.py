"""Conversion at the border: servo units, degrees and milliseconds to SI and radians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.types import FloatArray, as_floats

MS_PER_S = 1000.0


@dataclass(frozen=True)
class ServoUnits:
    """The count scale of a position servo: angle = (zero_deg - deg_per_count * counts) in degrees.

    Attributes:
        zero_deg: Joint angle at zero counts [deg].
        deg_per_count: Degrees per count; positive means that counts run against the angle.
        low: Smallest valid count.
        high: Largest valid count.
    """

    zero_deg: float
    deg_per_count: float
    low: float
    high: float

    @property
    def rad_per_count(self) -> float:
        """Size of one count [rad], always positive."""
        return abs(self.deg_per_count) * np.pi / 180.0

    def to_rad(self, counts: ArrayLike) -> FloatArray:
        """Return joint angles [rad] of `counts`, clamped to the valid range; same shape."""
        clamped = np.clip(as_floats(counts), self.low, self.high)
        return (self.zero_deg - self.deg_per_count * clamped) * np.pi / 180.0

    def to_counts(self, angle: ArrayLike) -> FloatArray:
        """Return unrounded counts of joint angles [rad]; same shape."""
        return (self.zero_deg - np.rad2deg(as_floats(angle))) / self.deg_per_count

    def valid(self, counts: ArrayLike) -> np.ndarray:
        """Return which `counts` a healthy servo can report; NaN is not valid."""
        values = as_floats(counts)
        return (values >= self.low) & (values <= self.high)
