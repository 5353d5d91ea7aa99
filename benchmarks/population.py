"""How robots that nobody has calibrated are judged by what others of their fleet are like.

    python benchmarks/population.py [--robots N]

Each robot makes two runs of three movements, of classes drawn by chance. They are judged with what
its class is like, and with populations of 2, 5 and 20 others, whose calibrations are off by as much
as they say. One fleet is narrow and unlike its class, the other is as its class. Simulated only.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from telling import nats, right

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.digital_model.nonidealities import Imperfections, Variation, vary
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.random_movements import RandomMovements

NARROW = Imperfections(
    "narrow",
    "made up",
    settling=Settling(
        (0.012, -0.012, 0.01, -0.01), (0.0, 0.15, 0.2, 0.45), (0.012,) * 4, (0.004,) * 4, 8.0
    ),
    variation=Variation((0.002,) * 4, (0.0, 0.1, 0.1, 0.1), (0.002,) * 4, (0.1,) * 4),
)
DOUBT = Variation((0.001,) * 4, (0.0, 0.05, 0.05, 0.05), (0.001,) * 4, (0.08,) * 4)
"""What calibrations of one or two sessions do not tell."""
SIZES = (0, 2, 5, 20)
"""Calibrated robots; none: the class."""
CLASSES = [f"motor_{i}:{mode}" for i in range(1, 5) for mode in ("stuck", "steady_state_error")]


def main() -> None:
    """Print a table of log scores for both fleets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=40)
    count = parser.parse_args().robots
    robot = ft.load_robot("armpi_fpv")
    usual = ft.load_calibration("generic", robot).imperfections
    for fleet in (NARROW, replace(usual, name="as its class")):
        judge(fleet, robot, count)


def judge(fleet: Imperfections, robot: ft.Robot, count: int) -> None:
    """Print how strangers of a fleet are judged by populations of several sizes."""
    rng = np.random.default_rng(0)
    known = [calibrated(fleet, number, rng) for number in range(max(SIZES))]
    priors = [ft.Population.fit(known[:size], robot) if size else None for size in SIZES]
    together: list[list[Diagnosis]] = [[] for _ in SIZES]
    alone: list[list[Diagnosis]] = [[] for _ in SIZES]
    for number in range(count):
        truths = list(rng.choice(["healthy", *CLASSES], 2, replace=False))
        plan = ft.Plan(robot, truths, 1, number, vary(fleet, rng), RandomMovements(count=3))
        runs = ft.simulate(plan)
        for place, prior in enumerate(priors):
            together[place] += ft.SelfCalibratingDiagnoser(robot, prior).diagnose(runs)
            figures = "generic" if prior is None else prior.imperfections
            alone[place] += ft.BayesDiagnoser(robot, figures).diagnose(runs)
    print(f"fleet: {fleet.name}; {2 * count} runs of {count} robots")
    for size, both, each in zip(SIZES, together, alone, strict=True):
        label = f"population of {size}" if size else "class"
        print(f"  {label:16}  together {told(both)}   alone {told(each)}", flush=True)


def calibrated(fleet: Imperfections, number: int, rng: np.random.Generator) -> Imperfections:
    """Return the calibration of one robot of the fleet, off by what it says of its own doubt."""
    seen = vary(replace(vary(fleet, rng), variation=DOUBT), rng)
    return replace(seen, name=f"robot {number}", protocol="P0c", variation=DOUBT)


def told(found: Sequence[Diagnosis]) -> str:
    """Return how many are right, and the mean log score with its standard error."""
    score = nats(found)
    error = np.std(score) / np.sqrt(len(score))
    return f"{right(found).sum():3d} right, {np.mean(score):.3f} +- {error:.3f} nats"


if __name__ == "__main__":
    main()
