"""Short logs: as plain numbers, to be sent through any link, and as a run without any error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.runs import RunTable
from failuretwin.digital_model.twin import DigitalTwin


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


def exact_run(robot, command, followed, step_s=0.01):
    """One run of an arm that does exactly what `followed` says, its tool read at 10 Hz.

    The command and what is followed are (time, motor) [rad].
    """
    measured = np.full((len(command), 3), np.nan)
    measured[::10] = DigitalTwin(robot).path(followed[::10])
    table = RunTable(
        run=["run"],
        motor=robot.motor_names,
        time=step_s * np.arange(len(command)),
        command=command[None],
        measured=measured[None],
        measured_rate_hz=10.0,
        attributes={"robot": robot.name, "source": "simulated"},
    )
    return table.to_dataset()
