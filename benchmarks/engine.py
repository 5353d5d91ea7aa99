"""The engine beside the diagnoser, on the same labelled runs: right, log score, time.

    python benchmarks/engine.py RUNS.nc [--calibration generic] [--robot armpi_fpv]

RUNS is a run set with `fault`. Both judge each run alone, by settled positions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.engine.unknown_robots import unknown_robot_posterior
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel


def main() -> None:
    """Print a line for each of the two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs")
    parser.add_argument("--calibration", help="file or `generic`; default: that of the profile")
    parser.add_argument("--robot", default="armpi_fpv")
    options = parser.parse_args()
    runs, robot = ft.read_runs(options.runs), ft.load_robot(options.robot)
    truth = truth_of(runs)
    if truth is None:
        raise SystemExit(f"{options.runs} has no `fault`. Expected labelled runs.")
    model = HealthyModel.of(load_calibration(options.calibration, robot))
    hypotheses = paper_hypotheses(model.motor_names)
    began = time.perf_counter()
    settled = Evidence(runs, model.settings, model.sensors).sound.settled
    found = unknown_robot_posterior(RunLikelihood(settled, model), hypotheses, ft.Priors())
    posterior = np.exp(found.log_posterior)
    print(_line("engine", hypotheses, posterior, list(truth), time.perf_counter() - began))
    began = time.perf_counter()
    says = ft.diagnose(runs, robot, options.calibration)
    table = np.array([[one.posterior[str(h)] for h in hypotheses] for one in says])
    print(_line("diagnose", hypotheses, table, list(truth), time.perf_counter() - began))


def _line(
    name: str, hypotheses: Sequence[Hypothesis], table: FloatArray, truth: list[str], seconds: float
) -> str:
    names = [str(h) for h in hypotheses]
    at = np.array([names.index(one) for one in truth])
    right = int((table.argmax(axis=1) == at).sum())
    nats = float(-np.log(np.maximum(table[np.arange(len(at)), at], 1e-300)).mean())
    each = 1e3 * seconds / len(at)
    return f"{name}: {right} of {len(at)} right, {nats:.4f} nats, {each:.0f} ms a run"


if __name__ == "__main__":
    main()
