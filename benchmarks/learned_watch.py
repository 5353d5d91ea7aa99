"""What do learned rates of faults add to what `watch` says, over simulated years?

    python benchmarks/learned_watch.py [--faults 300] [--healthy 300] [--fleets 3] [--robots 10]
                                       [--days 20] [--seed 0]

Fleets as in `learned_priors.py` teach the rates. Nearly all of a year is healthy, so its score has
two parts: runs of twelve movements in which a fault begins, drawn by the true rates, and healthy
runs, each of which counts for as many as lie between two faults. After each movement the
filter of `watch` is asked what is the case; the score is the log of the probability of the truth.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from learned_priors import DRAWN_COUNTS, SPREAD, learned

import failuretwin as ft
from failuretwin.connection.fault_rates import table_rates
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import RunSet, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.scoring import log_score_gain
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.faults.priors import priors_of
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.fault_filter import FaultFilter

MOVEMENTS = 12
"""Movements of a run."""
RUN_YEARS = 24.0 / 3600.0 / 8766.0
"""About how long such a run takes, in years of work."""


def scores(runs: RunSet, model: HealthyModel, priors: ft.Priors) -> FloatArray:
    """Return -log p(truth) after each movement, (run, movement) [nats]; 0 where there is none."""
    hypotheses = paper_hypotheses(model.motor_names)
    seen = Evidence(runs, model.settings, model.sensors).sound.settled
    one = FaultFilter(model, hypotheses, priors)
    says = one.evidence(RunLikelihood(seen, model))
    names, belief = [str(h) for h in hypotheses], one.begin(runs.sizes["run"])
    truth = [names.index(name) for name in truth_of(runs) or []]
    healthy, onset = names.index("healthy"), runs["onset"].values
    found = np.zeros(seen.usable.shape)
    for m in range(seen.usable.shape[1]):
        belief = one.advance(belief, says, m)
        begun = ~np.isnan(onset) & (onset < seen.begin[:, m])
        case = np.where(begun, truth, healthy)
        right = one.posterior(belief)[np.arange(len(case)), case]
        found[:, m] = np.where(seen.usable[:, m], -np.log(np.maximum(right, 1e-300)), 0.0)
    return found


def drawn(
    factors: Mapping[str, float], hypotheses: Sequence[Hypothesis], count: int, seed: int
) -> list[tuple[Hypothesis, int]]:
    """Return faults drawn by their true rates, and how many runs of each."""
    table = table_rates(hypotheses)
    faults = [h for h in hypotheses if str(h) in table]
    rate = np.array([table[str(h)] * factors[str(h)] for h in faults])
    some = np.random.default_rng(seed).choice(len(faults), count, p=rate / rate.sum())
    return [(faults[i], times) for i, times in sorted(Counter(some.tolist()).items())]


def main() -> None:
    """Let fleets live, follow new runs movement by movement and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=300)
    parser.add_argument("--healthy", type=int, default=300)
    parser.add_argument("--fleets", type=int, default=3)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--days", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng, robot = np.random.default_rng(given.seed), ft.load_robot("armpi_fpv")
    hypotheses = paper_hypotheses(robot.motor_names)
    known = load_calibration("armpi_fpv", robot).imperfections
    model, motion = HealthyModel.of(robot, known), RandomMovements(count=MOVEMENTS)
    found = list[tuple[float, dict[str, tuple[FloatArray, FloatArray]]]]()
    for _ in range(given.fleets):
        factors = {name: float(np.exp(SPREAD * rng.normal())) for name in table_rates(hypotheses)}
        clean, _ = learned(factors, hypotheses, given.robots, given.days, rng)
        print(clean.line, flush=True)
        each, seed = given.faults // given.fleets, int(rng.integers(1 << 30))
        states = drawn(factors, hypotheses, each, seed)
        faulty = [ft.simulate(ft.Plan(robot, [h], n, seed, known, motion)) for h, n in states]
        count = given.healthy // given.fleets
        well = ft.simulate(ft.Plan(robot, ["healthy"], count, seed + 1, known, motion))
        per_hour = sum(rate * factors[name] for name, rate in table_rates(hypotheses).items())
        runs_of_fault = 3600.0 / (per_hour * float(well["duration"].mean()))
        by = {}
        for name, rates in (("stated", {}), ("learned", clean.factors), ("true", factors)):
            priors = replace(priors_of(robot, DRAWN_COUNTS, None), fault_factors=rates)
            score = [scores(one, model, priors).sum(axis=1) for one in faulty]
            by[name] = np.concatenate(score), scores(well, model, priors).sum(axis=1)
        found.append((runs_of_fault, by))
    years = sum(given.faults // given.fleets * n for n, _ in found) * RUN_YEARS
    for name in ("learned", "true"):
        gains = [by["stated"][0] - by[name][0] for _, by in found]
        between = [n * (by["stated"][1] - by[name][1]) for n, by in found]
        print(f"{name} rates, {years:.1f} years: {told(gains)} a fault, {told(between)} before it")


def told(gains: Sequence[FloatArray]) -> str:
    """Return the mean of what rates gain, with its 95 % interval."""
    every = np.concatenate(gains)
    gain = log_score_gain(every, np.zeros(len(every)), np.random.default_rng(0))
    low, high = gain.interval
    return f"{gain.mean:+.3f} nats ({low:+.3f} to {high:+.3f})"


if __name__ == "__main__":
    main()
