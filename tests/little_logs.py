"""A short log as plain numbers, to be sent through any link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LittleLog:
    """A log as servo counts of the log columns motor_6 to motor_3, by a clock of 2023."""

    zero: float
    command_time: np.ndarray
    target: np.ndarray
    duration_ms: np.ndarray
    reading_time: np.ndarray
    counts: np.ndarray


LOG_COLUMNS = ("motor_6", "motor_5", "motor_4", "motor_3")


def make_log():
    rng = np.random.default_rng(5)
    command_time = 1677764088.0 + np.array([0.55, 2.55, 4.55])
    return LittleLog(
        zero=1677764088.0,
        command_time=command_time,
        target=rng.integers(300, 700, (3, 4)).astype(float),
        duration_ms=rng.choice([600.0, 800.0, 1000.0], (3, 4)),
        reading_time=1677764088.0 + np.arange(60) * 0.1,
        counts=rng.integers(300, 700, (60, 4)).astype(float),
    )
