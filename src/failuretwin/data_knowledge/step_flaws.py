"""What keeps a step of a step test from telling of a healthy motor."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray

REST_S = 0.3
"""Time at the end of a step in which the motor should rest [s]."""
FEWEST, FEWEST_AT_REST = 20, 5
"""Readings below which nothing is said of a step, and of where it ends."""
SLOWEST_S, LONGEST_HOLE_S = 0.03, 0.06
"""Times between readings that are too long to follow a step of a tenth of a second [s]."""
SMALLEST_COUNTS = 10.0
"""Travel below which rounding hides the motion [counts]."""
MOVES, ARRIVES = 0.25, 0.8
"""Shares of its travel below which a motor does not move, or is held back."""
RESTLESS_COUNTS = 12.0
"""Largest wandering of a motor at rest [counts]."""


def flaw_of_readings(time: FloatArray, rest: FloatArray) -> str:
    """Return what keeps readings about a step from telling anything, or nothing.

    Args:
        time: Their times since the command, (reading,) [s].
        rest: Those at the end, (reading,) [counts].
    """
    if len(time) < FEWEST or len(rest) < FEWEST_AT_REST or time[0] > -REST_S:
        return "has too few readings before, during or after it"
    period = float(np.median(np.diff(time)))
    if period > SLOWEST_S:
        return f"was read every {period:.3f} s, expected {SLOWEST_S:g} s or faster"
    hole = float(np.diff(time[time > -SLOWEST_S]).max())
    if hole > LONGEST_HOLE_S:
        return f"has a gap of {hole:.2f} s in its readings"
    if np.ptp(rest) > RESTLESS_COUNTS:
        return "does not come to rest"
    return ""


def flaw_of_motion(start: float, settled: float, target: float) -> str:
    """Return why a motor is no healthy one, or nothing.

    Args:
        start: Where it rested before [counts].
        settled: Where it rested after [counts].
        target: Where it was sent [counts].
    """
    told = target - start
    if abs(told) < SMALLEST_COUNTS:
        return f"is told to move by {abs(told):.0f} counts only"
    share = (settled - start) / told
    if share < MOVES:
        return "does not move although commanded"
    if share < ARRIVES:
        return f"is held back: it covers {100.0 * share:.0f} % of its travel"
    if share > 2.0 - ARRIVES:
        return f"goes too far: {100.0 * share:.0f} % of its travel"
    return ""
