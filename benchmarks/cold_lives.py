"""A robot that nobody has calibrated, run by run: what each is judged from is what came before it.

    python benchmarks/cold_lives.py FOLDER [--orders 16] [--robot armpi_fpv]

Runs are taken in random orders. No calibration is used, only what the kind of arm is like; no run
is judged by itself or by a later one. The truth is looked at when all has been said.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from telling import nats, right

import failuretwin as ft
from failuretwin.connection.tracked_diagnosis import History, begin, diagnose_tracked

FIRST = 10
"""Runs that are told apart: of these the robot is hardly known."""


def main() -> None:
    """Print the log score of each order."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--orders", type=int, default=16)
    parser.add_argument("--first", type=int, default=0, help="number of the first order")
    parser.add_argument("--robot", default="armpi_fpv")
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    runs = ft.read_runs(options.folder, robot, ft.ReadOptions(published_labels=True))
    diagnoser = ft.BayesDiagnoser(robot, "generic")
    scores = []
    for seed in range(options.first, options.first + options.orders):
        order = np.random.default_rng(seed).permutation(runs.sizes["run"])
        history = History(begin(diagnoser, cold=True), cold=True)
        told = diagnose_tracked(runs.isel(run=order), diagnoser, history).diagnoses
        score = nats(told)
        scores.append(score)
        alarms = sum(d.truth == "healthy" and d.diagnosis not in ("healthy", None) for d in told)
        print(
            f"order {seed:2d}: {right(told).sum()} of {len(told)} right, {score.mean():.4f} nats a "
            f"run, the first {FIRST} {score[:FIRST].mean():.3f}, the rest "
            f"{score[FIRST:].mean():.4f}; {alarms} healthy ones called faulty",
            flush=True,
        )
    means = np.mean(scores, axis=1)
    print(f"{len(means)} orders: {means.mean():.4f} nats on average, the worst {means.max():.4f}")


if __name__ == "__main__":
    main()
