"""What do learned rates of faults add to diagnoses, and what do wrong confirmations break?

    python benchmarks/learned_priors.py [--runs 1002] [--robots 10] [--days 20] [--fleets 3]
                                        [--movements 5] [--seed 0]

The true rate of each fault is that of the table times a log-normal factor (deviation 1). Robots of
a fleet live with them; each fault is diagnosed, confirmed and repaired in a store. The states of
new runs are drawn by the same rates, and each run is diagnosed once, by the stated priors; the
learned ones reweigh its posterior, which is exact. Then one confirmation in twenty is wrong: a
motor and mode at random.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from telling import nats, share

import failuretwin as ft
from failuretwin.connection.fault_rates import LearnedRates, reweighted, table_rates
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, paper_hypotheses, state_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.decision.scoring import log_score, log_score_gain
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import priors_of

SPREAD = 1.0
"""Deviation of the logarithm of true rates about those of the table."""
WRONG_SHARE = 0.05
DRAWN_COUNTS = (10.0, 50.0)
"""Range of the simulated steady-state errors [servo counts]."""
START = datetime(2026, 1, 1, tzinfo=UTC)


def main() -> None:
    """Let fleets live, diagnose new runs and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1002)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--days", type=float, default=20.0)
    parser.add_argument("--fleets", type=int, default=3)
    parser.add_argument("--movements", type=int, default=5, help="of each run")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, robot = np.random.default_rng(options.seed), ft.load_robot("armpi_fpv")
    hypotheses = paper_hypotheses(robot.motor_names)
    scores: list[FloatArray] = []
    changed, states, verdicts = 0, 0, 0
    for fleet in range(options.fleets):
        factors = {name: float(np.exp(SPREAD * rng.normal())) for name in table_rates(hypotheses)}
        clean, wrong = learned(factors, hypotheses, options.robots, options.days, rng)
        count = options.runs // options.fleets
        found = runs_of(factors, hypotheses, count, options.movements, rng)
        plain = [one.posterior for one in found]
        by_clean, by_wrong, by_truth = (
            [reweighted(one, each) for one in plain]
            for each in (clean.factors, wrong.factors, factors)
        )
        truth = [str(one.truth) for one in found]
        scores.append(np.stack([nats(found), *(log_score(truth, p) for p in (by_clean, by_truth))]))
        changed += sum(named(a) != named(b) for a, b in zip(by_clean, by_wrong, strict=True))
        states += sum(state_of(a) != state_of(b) for a, b in zip(by_clean, by_wrong, strict=True))
        verdicts += len(found)
        print(f"fleet {fleet}: {clean.line}", flush=True)
    stated, taught, known = np.concatenate(scores, axis=1)
    for name, score in (("learned", taught), ("true", known)):
        gain = log_score_gain(score, stated, np.random.default_rng(0))
        low, high = gain.interval
        print(f"{name} rates: {gain.mean:+.4f} nats a run ({low:+.4f} to {high:+.4f})")
    print(f"5 % wrong confirmations: another hypothesis in {share(changed, verdicts)}")
    print(f"  another state (healthy, faulty, cannot tell) in {share(states, verdicts)}")


def learned(
    factors: Mapping[str, float],
    hypotheses: Sequence[Hypothesis],
    robots: int,
    days: float,
    rng: np.random.Generator,
) -> tuple[LearnedRates, LearnedRates]:
    """Return the rates that a fleet teaches, without and with wrong confirmations."""
    table, robot = table_rates(hypotheses), ft.load_robot("armpi_fpv")
    with tempfile.TemporaryDirectory() as folder:
        store = ft.open_store(Path(folder) / "robots.db", create=True)
        count = 0
        for number in range(robots):
            hours = 24.0 * days
            faults = [n for n in table for _ in range(rng.poisson(table[n] * factors[n] * hours))]
            count += len(faults)
            live(store, f"arm_{number}", rng.permutation(faults).tolist(), (0.0, days))
        clean = LearnedRates.of(store.fleet_faults(robot.name), hypotheses)
        mistaken = rng.choice(list(table), rng.binomial(count, WRONG_SHARE)).tolist()
        live(store, "arm_0", mistaken, (days, days + 0.01))
        seen = store.fleet_faults(robot.name)
        assert sum(seen.confirmed.values()) == count + len(mistaken)
        return clean, LearnedRates.of(seen, hypotheses)


def live(store: ft.Store, name: str, faults: Sequence[str], days: tuple[float, float]) -> None:
    """Store some days of a robot: healthy at both ends, and confirmed faults between."""
    robot = ft.load_robot("armpi_fpv")
    seen = ["healthy", *(one for fault in faults for one in (fault, "healthy")), "healthy"]
    for day, said in zip(np.linspace(*days, len(seen)), seen, strict=True):
        log = LogFile(f"{name} {day}", f"{name} {day}", 1, START + timedelta(days=float(day)))
        done = store.remember([Diagnosis("run", {said: 1.0})], name, log=log, profile=robot)
        for one in done.episodes:
            if one.until is None:
                store.found(name, one.number, "confirmed")


def runs_of(
    factors: Mapping[str, float],
    hypotheses: Sequence[Hypothesis],
    count: int,
    movements: int,
    rng: np.random.Generator,
) -> list[Diagnosis]:
    """Return diagnoses of runs whose states are drawn by true rates, by the stated priors."""
    robot = ft.load_robot("armpi_fpv")
    known = load_calibration("armpi_fpv", robot).imperfections
    weight = np.exp(log_prior(hypotheses, ft.Priors(fault_factors=factors)))
    drawn = Counter(rng.choice(len(hypotheses), count, p=weight).tolist())
    # As drawn: with small errors in the prior too, healthy runs would be paid for them.
    priors = priors_of(robot, DRAWN_COUNTS, None)
    diagnoser, found = ft.BayesDiagnoser(robot, known, priors=priors), list[Diagnosis]()
    for state, times in sorted(drawn.items()):
        seed, motion = int(rng.integers(1 << 30)), RandomMovements(count=movements)
        plan = ft.Plan(robot, [hypotheses[state]], times, seed, known, motion)
        found += diagnoser.diagnose(ft.simulate(plan))
    return found


def named(posterior: Mapping[str, float]) -> str:
    """Return the most probable hypothesis."""
    return max(posterior, key=posterior.__getitem__)


if __name__ == "__main__":
    main()
