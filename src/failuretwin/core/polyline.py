"""Sampled references as few straight lines: rounding and uneven sampling leave no false corners."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray, IntArray

Corner = tuple[float, float]
"""Time and value."""

ROUNDING_RAD = 2e-3
"""Logged references are taken as few straight lines, off by no more than this [rad], a tenth of
a degree: half a count of a coarse servo, well below any fault that can be found."""

LEAST_STEPS = 10
"""Changes from which a quantum can be read; fewer may share one by chance."""


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
    tolerance = max(tolerance, 0.75 * resolution(value))
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
    time, value = _sharpen(np.flatnonzero(kept), time, value)
    return time, _level(value, 2.0 * tolerance)


def resolution(value: FloatArray) -> float:
    """Return the quantum that samples are rounded to, 0 if there is none to be seen."""
    steps = np.abs(np.diff(value))
    steps = steps[steps > 1e-9]
    if len(steps) < LEAST_STEPS:
        return 0.0
    multiples = steps / steps.min()
    return float(steps.min()) if np.all(np.abs(multiples - np.rint(multiples)) < 0.02) else 0.0


def _sharpen(kept: IntArray, time: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return corners with those that lie between two samples put where their lines meet.

    Args:
        kept: Samples that are corners of the polyline, (corner,).
        time: Times of all samples, (sample,) [s].
        value: All samples, (sample,).
    """
    corners = [(float(time[i]), float(value[i])) for i in kept]
    sharp, i = corners[:1], 1
    while i < len(corners):
        between = i + 2 < len(corners) and kept[i + 1] - kept[i] == 1
        met = _meet(sharp[-1], corners[i], corners[i + 1], corners[i + 2]) if between else None
        sharp.append(met or corners[i])
        i += 2 if met else 1
    return np.array(sharp).T[0], np.array(sharp).T[1]


def _meet(a: Corner, b: Corner, c: Corner, d: Corner) -> Corner | None:
    """Return where the lines a-b and c-d meet, None unless that is between b and c."""
    before = (b[1] - a[1]) / (b[0] - a[0])
    after = (d[1] - c[1]) / (d[0] - c[0])
    if before == after:
        return None
    at = (c[1] - b[1] + before * b[0] - after * c[0]) / (before - after)
    slack = 0.05 * (c[0] - b[0])
    if not b[0] - slack <= at <= c[0] + slack:
        return None
    return at, b[1] + before * (at - b[0])


def _level(value: FloatArray, tolerance: float) -> FloatArray:
    """Return corner values with each almost level line made level, at the value it begins with."""
    value = value.copy()
    for i in range(1, len(value)):
        if abs(value[i] - value[i - 1]) <= tolerance:
            value[i] = value[i - 1]
    return value
