"""A sensor's frame against the arm's: the turn and shift that bring settled poses together.

    seen_i = R model_i + t + noise_i,    R, t = argmin sum_i w_i |seen_i - R model_i - t|^2
    w_i = 1 / (1 + |r_i|^2 / (2 c)^2),     c = median of |r_i|

The weighted problem has a closed form (Kabsch), so that no frame is too far
off; the weights take off poses that lost a command.

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray

ROUNDS = 8
"""Rounds in which weights and frame settle together."""
LEAST_M = 1e-9
"""Distances below this count as none: rounding [m]."""


@dataclass(frozen=True)
class Frame:
    """A frame in another one.

    Attributes:
        R: Its turn, (3, 3).
        origin: Its origin, (3,) [m].
        away: Median distance of the points that it was fitted to [m].
    """

    R: FloatArray
    origin: FloatArray
    away: float

    def apply(self, point: FloatArray) -> FloatArray:
        """Return points (..., 3) of this frame in the other one."""
        return np.asarray(point @ self.R.T + self.origin)

    @property
    def angle(self) -> float:
        """By how much it is turned [rad]."""
        return float(np.arccos(np.clip(0.5 * (np.trace(self.R) - 1.0), -1.0, 1.0)))


def align(model: FloatArray, seen: FloatArray, *, rounds: int = ROUNDS) -> Frame:
    """Return the frame in which points of a model are where they are seen, robustly.

    Args:
        model: Points in the model's frame, (pose, 3) [m].
        seen: The same points in the sensor's frame, (pose, 3).
        rounds: Rounds in which weights and frame settle together.
    """
    weight = np.ones(len(model))
    for _ in range(rounds):
        frame = _weighted(model, seen, weight)
        distance = np.linalg.norm(seen - frame.apply(model), axis=1)
        middle = float(np.median(distance))
        weight = 1.0 / (1.0 + (distance / max(2.0 * middle, LEAST_M)) ** 2)
    return Frame(frame.R, frame.origin, middle)


def _weighted(model: FloatArray, seen: FloatArray, weight: FloatArray) -> Frame:
    share = weight / weight.sum()
    middle, target = share @ model, share @ seen
    U, _, Vt = np.linalg.svd((seen - target).T @ (share[:, None] * (model - middle)))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * mirror) @ Vt
    return Frame(R, target - R @ middle, 0.0)


def offset(model: FloatArray, seen: FloatArray) -> tuple[FloatArray, float]:
    """Return the median shift from model to seen, (3,) [m], and how far points are then off [m]."""
    shift = np.median(seen - model, axis=0)
    return shift, float(np.median(np.linalg.norm(seen - model - shift, axis=1)))
