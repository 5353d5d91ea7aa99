"""Straight-line approximation of a sampled reference; rest levels stay exact.

Lines between two rests may deviate by a tolerance, which removes rounding and curves. At rest the
reference keeps the commanded value, however small the step from the previous rest.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.types import BoolArray, FloatArray, IntArray

Corner = tuple[float, float]
"""Time and value."""

LEAST_STEPS = 10
"""Smallest number of changes that determine a quantum; fewer may share one by chance."""

TURN_RAD = 1e-5
"""Smallest change of a reference that is motion [rad]; less is noise."""
REST_S = 0.3
"""Shortest rest of all motors in a reference guided by hand [s]: twice the 0.15 s by which such an
arm lags, so that the arm is measured at rest too."""
STAIR_QUANTA = 4.0
"""Largest step of a staircase, in quanta; a larger step is a ramp or a jump."""
SAME = 1e-9
"""Largest difference that is level, whatever the tolerance."""
CREEP = 10.0
"""Largest sum of noise within a rest, in `TURN_RAD`."""


def simplify(
    time: FloatArray, value: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a polyline within `tolerance` of the samples.

    Douglas and Peucker's algorithm (1973) between the rests, which stay unchanged. Other lines that
    rise by less than twice the tolerance become level; rounding leaves no false corners.

    Args:
        time: Increasing times, (sample,) [s].
        value: Samples, (sample,); NaN = none.
        tolerance: Largest distance from the samples, in the unit of `value`.

    Returns:
        Times and values of the corners, (corner,).
    """
    known = np.isfinite(value)
    time, value = time[known], value[known].copy()
    quantum = resolution(value)
    rests = _rests(time, value) if quantum < tolerance else []
    for first, last in rests:
        value[first : last + 1] = np.median(value[first : last + 1])
    tolerance = max(tolerance, 0.75 * quantum)
    fixed = np.zeros(len(time), dtype=bool)
    fixed[[end for rest in rests for end in rest]] = True
    kept = fixed.copy()
    kept[[0, -1]] = True
    _keep_corners(time, value, tolerance, kept)
    times, values, fixed = _sharpen(np.flatnonzero(kept), time, value, fixed)
    return times, _level(values, fixed, 2.0 * tolerance)


@compiled
def _keep_corners(time: FloatArray, value: FloatArray, tolerance: float, kept: BoolArray) -> None:
    """Mark the corners between those that are `kept`, (sample,): each the farthest off its line."""
    ends = np.flatnonzero(kept)
    for k in range(len(ends) - 1):
        stack = [(ends[k], ends[k + 1])]
        while stack:
            first, last = stack.pop()
            slope = (value[last] - value[first]) / (time[last] - time[first])
            worst, farthest = first, tolerance
            for i in range(first + 1, last):
                off = abs(value[i] - (slope * (time[i] - time[first]) + value[first]))
                if off > farthest:
                    worst, farthest = i, off
            if worst > first:
                kept[worst] = True
                stack.append((first, worst))
                stack.append((worst, last))


def simplify_motors(
    time: FloatArray, value: FloatArray, tolerance: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the corners of each motor's reference; see `simplify`.

    Values rounded more coarsely than the tolerance form staircases, in which bends and steps look
    alike. Each motor then moves on a straight line from one common rest to its own last step before
    the next, if this stays within a quantum and a stair and needs fewer lines. Samples are (sample,
    motor) [rad], NaN = none, at increasing times (sample,) [s].
    """
    quantum = max(resolution(column) for column in value.T)
    alone = [simplify(time, column, tolerance) for column in value.T]
    if quantum > tolerance and np.isfinite(value).all():
        lines = [_between_rests(time, column, value) for column in value.T]
        path = np.stack([np.interp(time, *line) for line in lines], axis=-1)
        steps = np.abs(np.diff(value, axis=0, prepend=value[:1], append=value[-1:]))
        sample = np.minimum(np.maximum(steps[:-1], steps[1:]), STAIR_QUANTA * quantum)
        fewer = sum(len(corner) for corner, _ in lines) < sum(len(corner) for corner, _ in alone)
        if (np.abs(path - value) <= quantum + sample).all() and fewer:
            return lines
    return alone


def _between_rests(
    time: FloatArray, value: FloatArray, together: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return corners of straight lines between the common rests.

    References are those of one motor, (sample,) [rad], and of all `together`, (sample, motor)
    [rad].
    """
    moves = np.abs(np.diff(together, axis=0)).max(axis=1) > TURN_RAD
    edges = np.flatnonzero(np.concatenate([[True], moves, [True]]))
    level = [(first, stop - 1) for first, stop in pairwise(edges.tolist())]
    inner = [(a, b) for a, b in level[1:-1] if time[b] - time[a] >= REST_S]
    ends = [end for rest in (level[0], *inner, level[-1]) for end in rest][1:-1]
    corners = {0, *ends, len(time) - 1}
    for last, following in zip(ends[::2], ends[1::2], strict=True):
        steps = np.flatnonzero(np.abs(np.diff(value[last : following + 1])) > TURN_RAD)
        corners |= {last + 1 + int(step) for step in steps[-1:]}
    kept = np.array(sorted(corners))
    return time[kept], value[kept]


def _rests(time: FloatArray, value: FloatArray) -> list[tuple[int, int]]:
    """Return first and last sample of every stretch of `REST_S` or more without motion."""
    moves = np.abs(np.diff(value)) > TURN_RAD
    edges = [0, *(np.flatnonzero(moves) + 1).tolist(), len(value)]
    stretches = [(first, stop - 1) for first, stop in pairwise(edges)]
    return [
        (first, last)
        for first, last in stretches
        if time[last] - time[first] >= REST_S
        and np.ptp(value[first : last + 1]) <= CREEP * TURN_RAD
    ]


def resolution(value: FloatArray) -> float:
    """Return the quantum of rounded samples; 0 if none is visible."""
    steps = np.abs(np.diff(value))
    steps = steps[steps > 1e-9]
    if len(steps) < LEAST_STEPS:
        return 0.0
    multiples = steps / steps.min()
    return float(steps.min()) if np.all(np.abs(multiples - np.rint(multiples)) < 0.02) else 0.0


def _sharpen(
    kept: IntArray, time: FloatArray, value: FloatArray, fixed: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return times and values of the corners `kept`, and which of them belong to rests.

    A corner between two samples lies where the lines beside them meet, if both are lines: they have
    a sample between their ends, or are rests, whose starts and ends `fixed` marks. Samples of a
    curve are the corners themselves.
    """

    def is_line(first: int) -> bool:
        ends = kept[first : first + 2]
        return bool(ends[1] - ends[0] > 1 or fixed[ends].all())

    corners = [(float(time[i]), float(value[i])) for i in kept]
    sharp, rests, i = corners[:1], [bool(fixed[kept[0]])], 1
    while i < len(corners):
        between = i + 2 < len(corners) and kept[i + 1] - kept[i] == 1
        between = between and is_line(i - 1) and is_line(i + 1)
        met = _meet(sharp[-1], corners[i], corners[i + 1], corners[i + 2]) if between else None
        sharp.append(met or corners[i])
        rests.append(bool(fixed[kept[i]] or (met is not None and fixed[kept[i + 1]])))
        i += 2 if met else 1
    times, values = np.array(sharp).T
    return times, values, np.array(rests)


def _meet(a: Corner, b: Corner, c: Corner, d: Corner) -> Corner | None:
    """Return the intersection of the lines a-b and c-d; None unless it lies between b and c."""
    before = (b[1] - a[1]) / (b[0] - a[0])
    after = (d[1] - c[1]) / (d[0] - c[0])
    if before == after:
        return None
    at = (c[1] - b[1] + before * b[0] - after * c[0]) / (before - after)
    slack = 0.05 * (c[0] - b[0])
    if not b[0] - slack <= at <= c[0] + slack:
        return None
    return at, b[1] + before * (at - b[0])


def _level(value: FloatArray, fixed: BoolArray, tolerance: float) -> FloatArray:
    """Return corner values with each almost level line set to the value at its start.

    Values and which of them change only by rounding are (corner,).
    """
    value = value.copy()
    for i in range(1, len(value)):
        if abs(value[i] - value[i - 1]) <= (SAME if fixed[i] else tolerance):
            value[i] = value[i - 1]
    return value
