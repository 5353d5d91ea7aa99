"""Array types, and the count scale of position servos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from failuretwin.core.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def frozen_array(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def as_floats(values: Any) -> FloatArray:
    """Return `values` as a float64 array, copied only if necessary."""
    return np.asarray(values, dtype=np.float64)


# Conversion at the border: servo units, degrees and milliseconds to SI and radians.

MS_PER_S = 1000.0
LARGEST_SCALE = 2e7
"""Largest value in a count scale: encoders of 24 bits count to 1.7e7."""


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

    def __post_init__(self) -> None:
        values = (self.zero_deg, self.deg_per_count, self.low, self.high)
        sane = all(abs(value) <= LARGEST_SCALE for value in values)  # which NaN is not
        if not sane or self.deg_per_count == 0.0 or not self.low < self.high:
            raise InputError(
                f"servo_units are zero_deg {values[0]:g}, deg_per_count {values[1]:g}, low "
                f"{values[2]:g}, high {values[3]:g}. Expected low below high, a count that is not "
                f"0 deg, and nothing beyond {LARGEST_SCALE:g}."
            )

    @property
    def rad_per_count(self) -> float:
        """Size of one count [rad], always positive."""
        return abs(self.deg_per_count) * np.pi / 180.0

    def to_rad(self, counts: ArrayLike) -> FloatArray:
        """Return joint angles [rad] of `counts`, clamped to the valid range."""
        clamped = np.clip(as_floats(counts), self.low, self.high)
        return (self.zero_deg - self.deg_per_count * clamped) * np.pi / 180.0

    def to_counts(self, angle: ArrayLike) -> FloatArray:
        """Return unrounded counts of joint angles [rad]."""
        return (self.zero_deg - np.rad2deg(as_floats(angle))) / self.deg_per_count

    def valid(self, counts: ArrayLike) -> np.ndarray:
        """Return which `counts` a healthy servo can report; NaN is not valid."""
        values = as_floats(counts)
        return (values >= self.low) & (values <= self.high)
