"""Do rates of faults by the age of the motor foretell faults better than one rate for all ages?

    python benchmarks/fault_ages.py [--fleets 400] [--seed 0]

Times between faults of a motor are Weibull with a shape (1: the rate is constant), and a mean of
that of the table times a log-normal factor (deviation 0.7). A fleet teaches the rate of one fault
mode; the faults of one more motor within 1000 h are scored by the Poisson process of these rates.
Each fault is repaired and the repair stated.
"""

from __future__ import annotations

import argparse
from math import gamma

import numpy as np

from failuretwin.connection.fault_rates import FaultRate, table_rates
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.records.fleet import AGE_BANDS_H
from failuretwin.decision.scoring import log_score_gain

SPREAD = 0.7
NEXT_H = 1000.0
FLEETS = ((5, 480.0), (30, 2000.0))
"""Robots of a fleet, and the time that each was watched [h]."""


def main() -> None:
    """Simulate fleets and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fleets", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    for shape in (0.5, 1.0, 2.0, 3.0):
        for robots, hours in FLEETS:
            scores = [scored(shape, robots, hours, rng) for _ in range(options.fleets)]
            by_age, constant = np.array(scores).T
            gain = log_score_gain(by_age, constant, np.random.default_rng(0))
            low, high = gain.interval
            told = f"shape {shape:g}, {robots} robots for {hours:g} h"
            print(f"{told}: {gain.mean:+.3f} nats a fault ({low:+.3f} to {high:+.3f})", flush=True)


def scored(
    shape: float, robots: int, hours: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the log score by age and by one rate, for each fault of one more motor [nats]."""
    table = table_rates(paper_hypotheses(["motor_1"]))["motor_1:stuck"]
    scale = float(np.exp(SPREAD * rng.normal())) / table / gamma(1.0 + 1.0 / shape)
    seen = np.sum([life(shape, scale, hours, rng) for _ in range(robots)], axis=0)
    count, risk = life(shape, scale, NEXT_H, rng)
    by_age = [FaultRate("", table, int(n), t).mean_per_h for n, t in zip(*seen, strict=True)]
    constant = FaultRate("", table, int(seen[0].sum()), float(seen[1].sum())).mean_per_h

    def score(rate: FloatArray) -> float:
        return float((count * np.log(rate) - rate * risk).sum() / max(1.0, count.sum()))

    return score(np.array(by_age)), score(np.full(len(count), constant))


def life(shape: float, scale: float, hours: float, rng: np.random.Generator) -> FloatArray:
    """Return faults and time at risk [h] of a motor in each band of age, (2, band)."""
    found, left = np.zeros((2, len(AGE_BANDS_H) - 1)), hours
    while left > 0.0:
        age = scale * rng.weibull(shape)
        found[1] += np.diff(np.minimum(AGE_BANDS_H, min(age, left)))
        if age < left:
            found[0] += np.histogram(age, AGE_BANDS_H)[0]
        left -= age
    return found


if __name__ == "__main__":
    main()
