"""Sampled references as few straight lines: rounding and uneven sampling leave no false corners."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray

ROUNDING_RAD = 2e-3
"""Logged references are taken as few straight lines, off by no more than this [rad], a tenth of
a degree: half a count of a coarse servo, well below any fault that can be found."""


def simplify(
    time: FloatArray, value: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a polyline that stays within `tolerance` of the samples.

    Douglas and Peucker's algorithm (1973), then lines that rise by less than the tolerance are
    made level, so that a plateau is a plateau.

    Args:
        time: Increasing times, (sample,) [s].
        value: Samples, (sample,); NaN where there is none.
        tolerance: Largest distance from the samples, in the unit of `value`.

    Returns:
        Times and values of the corners, (corner,).
    """
    known = np.isfinite(value)
    time, value = time[known], value[known]
    kept = np.zeros(len(time), dtype=bool)
    kept[[0, -1]] = True
    stack = [(0, len(time) - 1)]
    while stack:
        first, last = stack.pop()
        inner = slice(first + 1, last)
        line = np.interp(time[inner], time[[first, last]], value[[first, last]])
        distance = np.abs(value[inner] - line)
        if len(distance) and distance.max() > tolerance:
            worst = first + 1 + int(np.argmax(distance))
            kept[worst] = True
            stack += [(first, worst), (worst, last)]
    return time[kept], _level(value[kept], tolerance)


def _level(value: FloatArray, tolerance: float) -> FloatArray:
    """Return corner values with each almost level line made level, at the value it begins with."""
    value = value.copy()
    for i in range(1, len(value)):
        if abs(value[i] - value[i - 1]) <= tolerance:
            value[i] = value[i - 1]
    return value
