"""What step tests show without any model: how far a motor overshoots and when it has settled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from failuretwin.data_knowledge.step_tests import StepTest

BAND_SHARE, BAND_COUNTS = 0.02, 2.0
"""A motor has settled when it stays this near: 2 % of its travel, two counts at least."""


def overshoot(step: StepTest) -> float:
    """Return how far a motor goes beyond the level where it settles, as a share of its travel."""
    beyond = (step.position[step.time > 0.0] - step.settled) / step.travel
    return max(0.0, float(beyond.max()))


def settling_time(step: StepTest, rad_per_count: float) -> float:
    """Return the time from the end of the commanded ramp until a motor stays where it settles [s].

    Args:
        step: The step.
        rad_per_count: Size of a count [rad].
    """
    band = max(BAND_SHARE * abs(step.travel), BAND_COUNTS * rad_per_count)
    away = step.time[np.abs(step.position - step.settled) > 1.001 * band]
    return max(0.0, float(away[-1]) - step.duration) if len(away) else 0.0


def mean_interval(values: Sequence[float], blur: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean and the ends of its 95 % interval.

    Args:
        values: One value for each step.
        blur: Standard deviation of each by rounding.
    """
    mean, count = float(np.mean(values)), len(values)
    known = float(np.sum(np.square(blur))) / count**2
    if count == 1:
        half = 1.96 * float(np.sqrt(known))
        return mean, mean - half, mean + half
    seen = float(np.var(values, ddof=1)) / count
    factor = student.ppf(0.975, count - 1) if seen > known else 1.96
    half = float(factor * np.sqrt(max(seen, known)))
    return mean, mean - half, mean + half
