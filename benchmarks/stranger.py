"""Diagnosis of runs that another engine made than the one it knows.

    python benchmarks/stranger.py [--runs-per-class 100] [--healthy 1000] [--seed 0]

The physics engine moves the arm, with the imperfections of a real one; its sag, its gears that
stick and its servos are not those that the diagnoser reckons with. Faults strike as published
(stuck from 0.49 s on, errors of 10 to 50 counts from the start), then with onsets anywhere in the
first eight seconds. Separable are the runs whose truth beats the nearest other hypothesis by
5 nats or more, in units of the declared scatter (docs/isolability.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from telling import calibration, nats, right, share

import failuretwin as ft
from failuretwin.core.hypothesis import HEALTHY, Diagnosis, Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.decision.scoring import IntervalCase, coverage_by_mode
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.expected_bayes_factors import expected_log_bayes_factors

SEPARABLE_NATS = 5.0
ALARMS = (0.99, 0.999)
"""Probabilities of any fault above which an alarm may be raised."""
ONSETS_S = (0.0, 8.0)
EDGE = 1e-9


@dataclass(frozen=True)
class Stranger:
    """The robot as the physics engine moves it, and the diagnoser that knows the servo engine."""

    robot: Robot
    imperfections: Imperfections
    diagnoser: ft.BayesDiagnoser

    def runs(
        self,
        hypotheses: Sequence[Hypothesis],
        per_class: int,
        seed: int,
        modes: Mapping[str, FaultMode] = MODES,
    ) -> xr.Dataset:
        """Return runs of the physics engine."""
        return ft.simulate(
            ft.Plan(
                self.robot,
                hypotheses,
                per_class,
                seed,
                self.imperfections,
                modes=modes,
                engine="physics",
            )
        )

    def ahead(self, runs: xr.Dataset) -> FloatArray:
        """Return by how much the truth of each run beats the nearest other, (run,) [nats]."""
        return expected_log_bayes_factors(self.diagnoser.twin, runs, self.imperfections).nearest


def main() -> None:
    """Make runs, diagnose them and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs-per-class", type=int, default=100)
    parser.add_argument("--healthy", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    imperfections = load_calibration("armpi_fpv", robot).imperfections
    diagnoser = ft.BayesDiagnoser(ft.DigitalTwin(robot), imperfections)
    stranger = Stranger(robot, imperfections, diagnoser)
    nine = paper_hypotheses(robot.motor_names)
    per_class, seed = options.runs_per_class, options.seed
    anywhere = {
        name: replace(MODES[name], onset_s=ONSETS_S) for name in ("stuck", "steady_state_error")
    }
    for title, modes in (
        ("faults as published", MODES),
        ("onset anywhere", {**MODES, **anywhere}),
    ):
        runs = stranger.runs(nine, per_class, seed, modes)
        tell_faults(title, runs, diagnoser.diagnose(runs), stranger.ahead(runs), seed)
    runs = stranger.runs([HEALTHY], options.healthy, seed + 1)
    tell_alarms(diagnoser.diagnose(runs))


def tell_faults(
    title: str, runs: xr.Dataset, found: Sequence[Diagnosis], ahead: FloatArray, seed: int
) -> None:
    """Print how good the diagnoses of runs of all classes are."""
    print(f"{title}: {len(found)} runs")
    good, score = right(found), nats(found)
    for name, some in (
        ("all", np.full(len(found), True)),
        (f"{SEPARABLE_NATS:g} nats or more apart", ahead >= SEPARABLE_NATS),
    ):
        rows = np.flatnonzero(some).tolist()
        correct = share(int(good[rows].sum()), len(rows))
        print(f"  {name}: right {correct}, log score {score[rows].mean():.4f} nats a run")
        chosen = [found[i] for i in rows]
        print(f"    {calibration(chosen, np.random.default_rng(seed))}")
    untold = sum(d.diagnosis is None for d in found)
    print(f"  without a verdict: {untold}")
    for group in coverage_by_mode(_intervals(runs, found)):
        print(
            f"  {group.mode}, {group.quantity}: 90 % intervals hold "
            f"{share(group.inside.count, group.inside.total)}; "
            f"{group.below} below, {group.above} above"
        )


def _intervals(runs: xr.Dataset, found: Sequence[Diagnosis]) -> list[IntervalCase]:
    """Return the intervals of the faults that were diagnosed right."""
    cases = []
    for i, diagnosis in enumerate(found):
        if diagnosis.diagnosis != diagnosis.truth or diagnosis.truth == str(HEALTHY):
            continue
        mode = Hypothesis.parse(str(diagnosis.truth)).faults[0].mode
        for quantity, ends, truth in (
            ("onset", diagnosis.onset_90, runs["onset"].values[i]),
            ("size", diagnosis.magnitude_90, runs["magnitude"].values[i]),
        ):
            if ends is not None and np.isfinite(truth):
                low, high = ends
                cases.append(IntervalCase(mode, quantity, low - EDGE, high + EDGE, float(truth)))
    return cases


def tell_alarms(found: Sequence[Diagnosis]) -> None:
    """Print what is said of healthy runs."""
    faulty = sum(d.diagnosis not in (str(HEALTHY), None) for d in found)
    print(f"healthy: {len(found)} runs, {sum(d.diagnosis is None for d in found)} untold")
    print(f"  called faulty: {share(faulty, len(found))}")
    for threshold in ALARMS:
        alarms = sum(1.0 - d.posterior[str(HEALTHY)] > threshold for d in found)
        print(f"  P(fault) > {threshold}: {share(alarms, len(found))}")


if __name__ == "__main__":
    main()
