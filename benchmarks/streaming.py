"""What a streaming sample takes: of one robot, and of a thousand at 10 Hz.

Seconds are those of the processor on one core. Runs of the servo engine with all imperfections, in
the paper's nine states, are played at 10 Hz; one robot after another, then all together.
"""

from __future__ import annotations

import time

import numpy as np

from failuretwin import BayesDiagnoser, DigitalTwin, Plan, load_robot
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import simulate
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import Robot

RATE_HZ = 10.0
SECONDS = 10.0
ROBOTS = 1000
ALONE = 20
"""Robots that are timed one by one."""

Samples = list[tuple[float, FloatArray, FloatArray]]
"""Time [s], commands (robot, motor) [rad] and readings (robot, axis) [m]."""


def samples_of(robot: Robot) -> Samples:
    """Return what a thousand robots say, ten times a second."""
    classes = paper_hypotheses(robot.motor_names)
    imperfect = load_calibration(robot.name, robot).imperfections
    plan = Plan(robot, classes, -(-ROBOTS // len(classes)), imperfections=imperfect)
    order = np.random.default_rng(0).permutation(plan.size)[:ROBOTS]
    runs = simulate(plan).isel(run=order)
    command, measured = runs["command"].values, runs["measured"].values
    grid = runs["time"].values
    every = round(1.0 / (RATE_HZ * (grid[1] - grid[0])))
    found = []
    for stop in range(every, round(SECONDS * RATE_HZ) * every + 1, every):
        between = measured[:, stop - every : stop]
        seen = np.isfinite(between).all(axis=-1)
        newest = every - 1 - np.argmax(seen[:, ::-1], axis=1)
        points = between[np.arange(ROBOTS), newest]
        points[~seen.any(axis=1)] = np.nan
        found.append((float(grid[stop - 1]), command[:, stop - 1], points))
    return found


def play(fleet: StreamingFleet, samples: Samples, robots: slice) -> tuple[FloatArray, int]:
    """Return how long each sample of some of the robots took [s], and how often one was judged."""
    took, judged = [], 0
    for at, command, points in samples:
        begin = time.process_time()
        judged += len(fleet.update(at, command[robots], points[robots]))
        took.append(time.process_time() - begin)
    return np.array(took), judged


def main() -> None:
    """Print a table."""
    robot = load_robot("armpi_fpv")
    samples = samples_of(robot)
    for whole_run in (False, True):
        diagnoser = BayesDiagnoser(DigitalTwin(robot), whole_run=whole_run)
        play(StreamingFleet(diagnoser, 1, RATE_HZ), samples, slice(0, 1))  # warms up
        print("whole run" if whole_run else "settled poses")
        alone = [
            play(StreamingFleet(diagnoser, 1, RATE_HZ), samples, slice(k, k + 1))[0]
            for k in range(ALONE)
        ]
        each = 1000.0 * np.concatenate(alone)
        print(
            f"  one robot: {each.mean():.2f} ms a sample (median {np.median(each):.2f}, longest "
            f"{each.max():.0f}), {ALONE} robots one by one"
        )
        took, judged = play(StreamingFleet(diagnoser, ROBOTS, RATE_HZ), samples, slice(None))
        share = 100.0 * took.sum() / SECONDS
        print(
            f"  {ROBOTS} robots at {RATE_HZ:.0f} Hz: {share:.0f} % of a core, "
            f"{1e6 * took.mean() / ROBOTS:.0f} us a sample; judged {judged} times"
        )


if __name__ == "__main__":
    main()
