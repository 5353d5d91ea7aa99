"""The physics engine of the ArmPi FPV: error of the time step and time for 3600 runs of 10 s.

The error is the largest difference of any angle at any time of any run from the same runs at a ten
times finer step. `--full` times all 3600 runs at the default step; otherwise time is extrapolated.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from failuretwin import load_robot
from failuretwin.core.movements import stack_movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.physics.engine import STEP_S, PhysicsEngine
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import Drive
from failuretwin.failure_behavior.random_movements import RandomMovements

RUNS = 3600
SAMPLED_RUNS = 384
JUDGED_RUNS = 32
STEPS_S = (0.005, 0.0025, 0.002)
COUNT_RAD = np.deg2rad(0.24)
TIME = as_floats(np.arange(1001) * 0.01)


def references(robot: Robot, runs: int) -> FloatArray:
    """Return the references of random movements, (run, time, motor) [rad] on `TIME`."""
    draws = (np.random.default_rng([0, run]) for run in range(runs))
    schedule = Schedule()
    parts = [RandomMovements().draw(robot, schedule, rng) for rng in draws]
    return stack_movements(parts).reference(TIME)


def step_error(robot: Robot, step_s: float) -> float:
    """Return the largest error of a step [rad]."""
    drive = Drive(references(robot, JUDGED_RUNS))
    coarse, fine = (
        PhysicsEngine(robot, threads=2, step_s=step).angles(drive, TIME)
        for step in (step_s, step_s / 10.0)
    )
    return float(np.abs(coarse - fine).max())


def seconds(robot: Robot, runs: int, step_s: float = STEP_S, threads: int = 2) -> float:
    """Return the time that the engine takes for `runs` runs [s]."""
    engine = PhysicsEngine(robot, threads=threads, step_s=step_s)
    drive = Drive(references(robot, runs))
    start = time.perf_counter()
    engine.angles(drive, TIME)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="time all 3600 runs")
    full = parser.parse_args().full
    robot = load_robot("armpi_fpv")
    print(f"{'step ms':>8s} {'error rad':>10s} {'counts':>7s} {'3600 runs on 2 threads, s':>26s}")
    for step in STEPS_S:
        error = step_error(robot, step)
        took = min(seconds(robot, SAMPLED_RUNS, step) for _ in range(3)) / SAMPLED_RUNS * RUNS
        print(f"{step * 1e3:8.1f} {error:10.2e} {error / COUNT_RAD:7.3f} {took:26.1f}")
    if full:
        print(f"all {RUNS} runs at {STEP_S * 1e3:.1f} ms: {seconds(robot, RUNS):.1f} s")


if __name__ == "__main__":
    main()
