"""The engine beside the diagnoser, on the same labelled runs: right, log score, time.

    python benchmarks/engine.py RUNS.nc [--calibration generic] [--robot armpi_fpv] [--factors]

RUNS is a run set with `fault`. Both judge each run alone, by settled positions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.numerics import log_sum
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.runs import RunsEvidence
from failuretwin.inference.engine.theta import layout_of, robot_components
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import log_prior

CHUNK = 30
"""Runs that the engine weighs at a time."""


def main() -> None:
    """Print a line for each of the two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs")
    parser.add_argument("--calibration", help="file or `generic`; default: that of the profile")
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--factors", action="store_true", help="scatter and noise are unknown")
    options = parser.parse_args()
    runs, robot = ft.read_runs(options.runs), ft.load_robot(options.robot)
    truth = truth_of(runs)
    if truth is None:
        raise SystemExit(f"{options.runs} has no `fault`. Expected labelled runs.")
    model = HealthyModel.of(load_calibration(options.calibration, robot))
    hypotheses = paper_hypotheses(model.motor_names)
    began = time.perf_counter()
    evidence = Evidence(runs, model.settings, model.sensors)
    found = engine_posterior(evidence, model, hypotheses, options.factors)
    print(_line("engine", hypotheses, found, list(truth), time.perf_counter() - began))
    began = time.perf_counter()
    says = ft.diagnose(runs, robot, options.calibration)
    table = np.array([[one.posterior[str(h)] for h in hypotheses] for one in says])
    print(_line("diagnose", hypotheses, table, list(truth), time.perf_counter() - began))


def engine_posterior(
    evidence: Evidence, model: HealthyModel, hypotheses: Sequence[Hypothesis], factors: bool
) -> FloatArray:
    """Return the posterior of each run, (run, hypothesis)."""
    settled, priors = evidence.sound.settled, ft.Priors()
    odds, parts = log_prior(hypotheses, priors), []
    for at in range(0, len(settled.usable), CHUNK):
        moments = moments_of(model, settled[slice(at, at + CHUNK)])
        layout = layout_of(model.without_doubt, moments)
        components = robot_components(model, layout, factors)
        covariance = components.covariance[0]
        scene = Scene.of(model.without_doubt, moments, priors, layout, covariance)
        parts.append(RunsEvidence(scene, hypotheses, components, odds).by_hypothesis)
    height = np.concatenate(parts) + odds
    return np.exp(height - log_sum(height, axis=1)[:, None])


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
