"""Do probabilities and intervals mean what they say, on runs of our own twin?

    python benchmarks/honesty.py [--runs 10000] [--seed 0] [--imperfections armpi_fpv]

Hypotheses, onsets and sizes are drawn from what the diagnoser believes beforehand; onsets fall
anywhere in the run or before it. Told are the calibration error of the probabilities, how often
90 % intervals hold the truth, and whether the truth's rank in its posterior is uniform.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from ranks import check_ranks, rank_of_truth
from rich.progress import track
from telling import share

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, paper_hypotheses
from failuretwin.core.numerics import Weighted
from failuretwin.core.types import FloatArray
from failuretwin.decision.scoring import (
    calibrated_error,
    reliability,
)
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.fault import FaultValue
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.priors import OnsetPrior, Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.settings import InferenceSettings
from failuretwin.inference.posterior import marginal_likelihood_of

EARLY = 0.5
ERROR_RANGES = InferenceSettings.of(ft.load_robot("armpi_fpv")).error_ranges
PRIORS = Priors(OnsetPrior(prior_before_run=EARLY, free=0.01), ERROR_RANGES)
"""Half of the faults were there before the run; held angles come from where the motor was."""
CHUNK = 500
DRAWS = 199
FIRST_RAMP_S, LATEST_S = 0.8, 12.0
"""End of the first ramp, on average, and the latest onset drawn [s]. Runs whose fault begins after
the last movement cannot show it; they are left out, as the diagnoser does not consider them."""
EARLY_DRAWN = 0.43
"""Share of early onsets drawn, so that a half is left once those runs are out."""


@dataclass(frozen=True, kw_only=True)
class PriorStuck(Stuck):
    """Stuck with the onsets that the diagnoser believes in."""

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Return the fault as it strikes one run."""
        value = super().draw(motor, movements, duration, rng)
        early, first = rng.random() < EARLY_DRAWN, rng.random() < 0.5
        late = rng.uniform(FIRST_RAMP_S, LATEST_S)
        onset = (0.0 if first else rng.uniform(0.05, FIRST_RAMP_S)) if early else late
        return replace(value, course=replace(value.course, onset_s=onset))


@dataclass(frozen=True, kw_only=True)
class PriorError(SteadyStateError):
    """Steady-state errors with the onsets and the run-level ranges that it believes in."""

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Return the fault as it strikes one run."""
        low, high = ERROR_RANGES[int(rng.integers(len(ERROR_RANGES)))]
        value = super().draw(motor, movements, duration, rng)
        sizes = rng.uniform(low, high, movements) * rng.choice([-1.0, 1.0], movements)
        onset = 0.0 if rng.random() < EARLY_DRAWN else float(rng.uniform(0.0, LATEST_S))
        course = replace(value.course, onset_s=onset)
        return replace(value, course=course, per_movement={"offset_rad": sizes})


def main() -> None:
    """Draw runs, diagnose them and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--imperfections", default="armpi_fpv")
    options = parser.parse_args()
    known = load_calibration(options.imperfections, ft.load_robot(options.robot))
    robot, imperfections = known.robot, known.imperfections
    diagnoser = ft.BayesDiagnoser(known.twin, imperfections, priors=PRIORS)
    hypotheses = paper_hypotheses(robot.motor_names)
    modes = {**MODES, "stuck": PriorStuck(), "steady_state_error": PriorError()}
    per_class = -(-options.runs // (len(hypotheses) * max(1, options.runs // CHUNK)))
    found: list[Outcome] = []
    for seed in track(range(max(1, options.runs // CHUNK)), description="runs"):
        plan = ft.Plan(
            robot, hypotheses, per_class, 1000 * options.seed + seed, imperfections, modes=modes
        )
        found += outcomes(_showing(ft.simulate(plan)), diagnoser, np.random.default_rng(seed))
    report(found, np.random.default_rng(options.seed))


def _showing(runs: xr.Dataset) -> xr.Dataset:
    """Return the runs whose fault begins in time to show, and no more healthy ones than of each."""
    last = runs["movement_start"].values[:, -1]
    stuck = np.char.find(runs["fault"].values.astype(str), "stuck") >= 0
    last = last + np.where(stuck, runs["ramp_duration"].values[:, -1].max(axis=-1), 0.0)
    shows = ~(runs["onset"].values > last)
    healthy = np.flatnonzero(runs["fault"].values == "healthy")
    faulty = len(shows) - len(healthy)
    kept = round(len(healthy) * (np.count_nonzero(shows) - len(healthy)) / faulty)
    shows[healthy[kept:]] = False
    return runs.isel(run=np.flatnonzero(shows))


@dataclass(frozen=True)
class Outcome:
    """What came of one run."""

    truth: str
    diagnosis: Diagnosis
    onset_s: float
    size: float
    onset_draws: FloatArray | None
    size_draws: FloatArray | None


def outcomes(
    runs: xr.Dataset, diagnoser: ft.BayesDiagnoser, rng: np.random.Generator
) -> Iterator[Outcome]:
    """Diagnose runs, and draw onset and size from their posterior given the true hypothesis."""
    diagnoses = diagnoser.diagnose(runs)
    sound = Evidence(runs).sound
    evidence = sound.settled
    moving = sound.transient.where(diagnoser.transient_mask(evidence.usable))
    names = runs["fault"].values
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(names == name)
        first, stop = int(rows[0]), int(rows[-1]) + 1
        likelihood = RunLikelihood(
            evidence[first:stop], diagnoser.healthy_model, moving[first:stop]
        )
        weight = marginal_likelihood_of(likelihood, Hypothesis.parse(str(name)), PRIORS)
        for row in rows:
            estimate = weight.estimate(int(row) - first)
            yield Outcome(
                truth=str(name),
                diagnosis=diagnoses[row],
                onset_s=float(runs["onset"].values[row]),
                size=float(runs["magnitude"].values[row]),
                onset_draws=_draws(estimate.onset, rng),
                size_draws=_draws(estimate.size, rng),
            )


def _draws(values: Weighted | None, rng: np.random.Generator) -> FloatArray | None:
    return None if values is None else values.draw(DRAWS, rng)


def report(found: list[Outcome], rng: np.random.Generator) -> None:
    """Print what was found."""
    told = [o for o in found if o.diagnosis.diagnosis is not None]
    right = np.array([o.diagnosis.diagnosis == o.truth for o in told])
    sure = np.array([o.diagnosis.probability for o in told])
    nats = [-np.log(max(o.diagnosis.posterior[o.truth], 1e-300)) for o in found]
    print(f"{len(found)} runs, {len(found) - len(told)} without a verdict")
    correct = share(int(right.sum()), len(right))
    print(f"right {correct}, log score {np.mean(nats):.4f} nats a run")
    bins = reliability(sure, right)
    error = bins.error
    chance = calibrated_error(sure, rng)
    print(f"calibration error {error:.4f} (a perfect one shows {np.mean(chance):.4f} by chance)")
    for count, hits, mean in zip(bins.count, bins.right, bins.confidence, strict=True):
        if count:
            print(f"  said {mean:.3f}: right {share(int(hits), int(count))}")
    for mode in ("stuck", "steady_state_error"):
        cases = [o for o, r in zip(told, right, strict=True) if r and mode in o.truth]
        everyone = [o for o in found if mode in o.truth]
        for what in ("onset", "size"):
            inside = sum(_inside(o, what) for o in cases)
            draws = np.array([getattr(o, f"{what}_draws") for o in everyone])
            truth = np.array([o.onset_s if what == "onset" else o.size for o in everyone])
            known = np.isfinite(truth)
            check = check_ranks(rank_of_truth(draws[known], truth[known], rng), DRAWS, rng)
            held = share(inside, len(cases))
            print(f"{mode}, {what}: 90 % intervals hold the truth in {held}")
            print(f"  ranks: chi2 p = {check.chi2_p:.3f}, Kolmogorov-Smirnov p = {check.ks_p:.3f}")
            print(f"  share of each bin over its due: {np.round(check.count / check.expected, 2)}")


def _inside(outcome: Outcome, what: str) -> bool:
    found = outcome.diagnosis
    interval = found.onset_90 if what == "onset" else found.magnitude_90
    truth = outcome.onset_s if what == "onset" else outcome.size
    return interval is not None and interval[0] - 1e-6 <= truth <= interval[1] + 1e-6


if __name__ == "__main__":
    main()
