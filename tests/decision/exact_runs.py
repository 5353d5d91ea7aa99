"""Runs of known motion that can be seen by any sensor: at any rate, in any frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin import DigitalTwin
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.nonidealities import Imperfections

FINE_S = 0.005
"""Step at which motions are computed [s]."""
COUNT = 5
KINDS = ("healthy", "stuck", "steady_state_error")


@dataclass(frozen=True)
class Motion:
    """One run: what was commanded and what the motors did, every `FINE_S`.

    Attributes:
        truth: Hypothesis in text.
        commanded: Movements of one run.
        angles: (time, motor) [rad].
    """

    truth: str
    commanded: Movements
    angles: np.ndarray


def move(
    twin: DigitalTwin, imperfections: Imperfections, kind: str, motor: int, seed: int
) -> Motion:
    """Return a run whose healthy part settles as the imperfections say, scatter and all."""
    robot, rng = twin.robot, np.random.default_rng(seed)
    low, high = np.array([m.movement_range for m in robot.motors]).T
    initial = 0.5 * (low + high)
    target = rng.uniform(low, high, (COUNT, len(low)))
    ramp = np.full((1, COUNT, len(low)), 0.8)
    start = np.array([[0.05 + 2.03 * m for m in range(COUNT)]])
    commanded = Movements(initial[None], target[None], ramp, start)
    error = np.zeros_like(target)
    if kind == "steady_state_error":
        error[:, motor] = rng.choice([-1.0, 1.0], COUNT) * rng.uniform(0.1, 0.2, COUNT)
    settling = imperfections.settling
    goal = target + error
    reached = goal + np.array(settling.scatter) * rng.normal(size=target.shape)
    direction = np.sign(target - commanded.origin()[0])
    for _ in range(2):
        offset = settling.offset(robot, reached, direction)
        reached = goal + offset + 0.5 * np.array(settling.scatter) * rng.normal(size=target.shape)
    actual = Movements(initial[None], reached[None], ramp, start)
    time = FINE_S * np.arange(round((start[0, -1] + 2.0) / FINE_S))
    angles = twin.respond(actual.reference(time)[0], time)
    if kind == "stuck":
        onset = round(0.5 / FINE_S)
        angles[onset:, motor] = angles[onset, motor]
    name = "healthy" if kind == "healthy" else f"{robot.motor_names[motor]}:{kind}"
    return Motion(name, commanded, angles)


def seen(twin: DigitalTwin, motions: list[Motion], every: int = 20, grid: int = 2, first: int = 0):
    """Return the run set of a sensor that reads exactly.

    Args:
        twin: Kinematics.
        motions: The runs.
        every: Fine steps from one reading to the next.
        grid: Fine steps of the time grid.
        first: The first reading, in steps of the grid.
    """
    count = len(motions[0].angles)
    time = FINE_S * np.arange(0, count, grid)
    measured = np.full((len(motions), len(time), 3), np.nan)
    read = np.arange(first, len(time), every // grid)
    for run, motion in enumerate(motions):
        measured[run, read] = twin.path(motion.angles[::grid][read])
    parts = [m.commanded for m in motions]
    whole = Movements(
        *(np.concatenate([getattr(p, n) for p in parts])
          for n in ("initial", "target", "ramp_duration", "start"))
    )  # fmt: skip
    return RunTable(
        run=[f"{m.truth}/{i}" for i, m in enumerate(motions)],
        motor=twin.robot.motor_names,
        time=time,
        command=whole.reference(time),
        measured=measured,
        measured_rate_hz=1.0 / (every * FINE_S),
    ).to_dataset()


def drawn_out(runs, *, held=True):
    """Return the runs with straight lines between the readings.

    Args:
        runs: The runs.
        held: Whether the first and the last reading are held to the ends of the grid.
    """
    ends = {} if held else {"left": np.nan, "right": np.nan}
    runs = runs.copy(deep=True)
    time = runs["time"].values
    for path in runs["measured"].values:
        there = np.isfinite(path[:, 0])
        for axis in range(3):
            path[:, axis] = np.interp(time, time[there], path[there, axis], **ends)
    return runs
