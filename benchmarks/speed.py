"""Speed of the main jobs on one core, in seconds and relative to a fixed piece of numpy work.

Seconds are those of the processor, so others on the machine do not count. The ratio holds when the
machine's speed drifts: the reference is timed in the same run. What a user waits for before
anything begins is timed as whole processes.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from failuretwin import BayesDiagnoser, DigitalTwin, load_robot
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS

PUBLISHED_GENERATION_S = 8.0 * 3600.0
"""Time that the authors' generation of 3600 runs took [s]."""
DIAGNOSED = 180
"""Runs of five movements that are diagnosed: 10 s at 10 Hz, and what late starts add."""
STARTS = {
    "start of Python alone": ("-c", "pass"),
    "import failuretwin": ("-c", "import failuretwin"),
    "failuretwin --help": ("-m", "failuretwin", "--help"),
}
"""Arguments to Python, by the name of what they start."""


def best_of(work: Callable[[], object], times: int = 3) -> float:
    """Return the shortest of a few timings of `work` [s of the processor]."""
    timings = []
    for _ in range(times):
        start = time.process_time()
        work()
        timings.append(time.process_time() - start)
    return min(timings)


def process_seconds(arguments: Sequence[str]) -> float:
    """Return user and system time of a whole Python process [s of the processor]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def print_starts(times: int = 11) -> None:
    """Time what is to be there at once, and print the median of each."""
    print(f"\n{f'whole processes, median of {times}':55s} {'seconds':>8s}")
    for name, arguments in STARTS.items():
        seconds = statistics.median(process_seconds(arguments) for _ in range(times))
        print(f"{name:55s} {seconds:8.3f}")


def main() -> None:
    """Time everything and print a table."""
    robot = load_robot("armpi_fpv")
    twin = DigitalTwin(robot)
    imperfect = load_calibration("armpi_fpv", robot).imperfections
    rng = np.random.default_rng(0)
    poses = rng.uniform(-1.5, 1.5, (3_600_000, 4))
    classes = paper_hypotheses(robot.motor_names)
    runs = simulate(Plan(robot, classes, DIAGNOSED // len(classes), imperfections=imperfect))
    published = simulate(Plan(robot, classes, 400))
    command, grid = published["command"].values, published["time"].values
    del published
    diagnoser = BayesDiagnoser(twin)

    reference = best_of(lambda: np.sin(poses) + np.cos(poses))
    jobs: list[tuple[str, Callable[[], object]]] = [
        ("forward kinematics, 3.6 million poses", lambda: twin.path(poses)),
        (
            "position and Jacobian, 3.6 million poses",
            lambda: robot.chain.position_and_jacobian(poses),
        ),
        (
            "twin, 3600 runs of 1000 samples: responses and path",
            lambda: twin.path(twin.respond(command, grid)),
        ),
        (
            "generation, 3600 runs, no imperfections",
            lambda: simulate(Plan(robot, classes, 400, imperfections=NO_IMPERFECTIONS)),
        ),
        (
            "generation, 3600 runs, all imperfections",
            lambda: simulate(Plan(robot, classes, 400, imperfections=imperfect)),
        ),
        (f"diagnosis, {DIAGNOSED} runs, nine hypotheses", lambda: diagnoser.diagnose(runs)),
    ]
    print(f"reference: sine and cosine of 14.4 million numbers, {reference:.3f} s = 1\n")
    print(f"{'job':55s} {'seconds':>8s} {'ratio':>7s}")
    for name, work in jobs:
        seconds = best_of(work)
        note = ""
        if name.startswith("generation"):
            note = f"  {PUBLISHED_GENERATION_S / seconds:.0f} times the published 8.0 h"
        if name.startswith("diagnosis"):
            note = f"  {1000.0 * seconds / DIAGNOSED:.1f} ms a run"
        print(f"{name:55s} {seconds:8.3f} {seconds / reference:7.2f}{note}")
    print_starts()


if __name__ == "__main__":
    main()
