"""How soon the course of a robot over its runs names the run in which a fault came.

    python benchmarks/lives.py [--robot armpi_fpv] [--calibration armpi_fpv|generic] [--lives 1000]

Simulated runs of each of the nine classes are diagnosed one by one; lives of thirty runs are drawn
from them, with one fault that comes at a random run and is repaired at a later one.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.decision.scoring import Share
from failuretwin.inference.together.fault_course import FaultCourse

RUNS, SHORTEST, OF_CLASS, NEAR = 30, 4, 60, 2


def main() -> None:
    """Print how many lives are told right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--calibration", default="armpi_fpv")
    parser.add_argument("--lives", type=int, default=1000)
    options = parser.parse_args()
    diagnoser = ft.BayesDiagnoser(options.robot, options.calibration)
    names = [str(hypothesis) for hypothesis in diagnoser.hypothesis_set]
    plan = ft.Plan(options.robot, names, OF_CLASS, seed=5, imperfections=options.robot)
    by_class: dict[str, list[Diagnosis]] = defaultdict(list)
    for diagnosis in diagnoser.diagnose(ft.simulate(plan)):
        by_class[diagnosis.truth or ""].append(diagnosis)
    rng = np.random.default_rng(1)
    told = np.array([_told(by_class, names[1:], rng) for _ in range(options.lives)])
    for title, right in zip(("run named within two", "and nothing else said"), told.T, strict=True):
        low, high = Share(int(right.sum()), len(right)).interval
        print(f"{title}: {right.mean():.1%} of {len(right)} ({low:.1%} to {high:.1%})")


def _told(
    by_class: dict[str, list[Diagnosis]], faults: Sequence[str], rng: np.random.Generator
) -> tuple[bool, bool]:
    """Return whether the run of a fault is named, and whether nothing else is said."""
    fault = faults[int(rng.integers(len(faults)))]
    first = int(rng.integers(0, RUNS - 2 * SHORTEST))
    last = int(rng.integers(first + SHORTEST, RUNS + 1))
    states = [fault if first <= run < last else "healthy" for run in range(RUNS)]
    runs = [by_class[state][rng.integers(len(by_class[state]))] for state in states]
    said = [e for e in FaultCourse.of(runs).episodes if not e.hypothesis.is_healthy]
    near = any(str(e.hypothesis) == fault and abs(e.first - first) <= NEAR for e in said)
    return near, near and len(said) == 1


if __name__ == "__main__":
    main()
