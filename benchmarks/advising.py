"""Cost of deciding by least expected cost, beside simple rules and an oracle, on simulated runs.

    python benchmarks/advising.py [--runs-per-class 32]

Runs of the nine classes, five movements each, are diagnosed with faults taken to be rare (30 : 1).
The costs are invented: 30 for missing every target, inspect 3, replace 10, stop 15, compensate 1.
"""

from __future__ import annotations

import argparse

import numpy as np

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.decision.expected_cost import Costs, Missed, cost_table
from failuretwin.inference.faults.priors import MONITORING

COSTS = Costs(
    targets=10.0, missed_target=3.0, compensate=1.0, slow_down=1.0, inspect=3.0, replace=10.0,
    stop=15.0,
    missed={
        "stuck": Missed(0.95, 0.4, 0.95),
        "steady_state_error": Missed(0.8, 0.1, 0.8),
    },
)  # fmt: skip


def main() -> None:
    """Print the mean cost of a run by rule."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs-per-class", type=int, default=32)
    parser.add_argument("--seed", type=int, default=3)
    told = parser.parse_args()
    diagnoser = ft.BayesDiagnoser("armpi_fpv", priors=MONITORING)
    hypotheses = list(diagnoser.hypothesis_set)
    names = [str(hypothesis) for hypothesis in hypotheses]
    plan = ft.Plan(
        "armpi_fpv", names, told.runs_per_class, seed=told.seed, imperfections="armpi_fpv"
    )
    found = diagnoser.diagnose(ft.simulate(plan))
    actions, table = cost_table(hypotheses, COSTS)
    paid: dict[str, list[float]] = {}

    def pay(rule: str, action: tuple[str, str], truth: int) -> None:
        paid.setdefault(rule, []).append(float(table[actions.index(action), truth]))

    for diagnosis in found:
        truth = names.index(diagnosis.truth or "healthy")
        p = np.array([diagnosis.posterior[name] for name in names])
        pay("oracle", actions[int(np.argmin(table[:-1, truth]))], truth)
        pay("always continue", ("continue", ""), truth)
        pay("stop if P(fault) > 0.5", ("stop" if p[0] < 0.5 else "continue", ""), truth)
        best = Hypothesis.parse(names[int(np.argmax(p))])
        replaced = ("replace", best.faults[0].motor) if best.faults else ("continue", "")
        pay("replace the most probable", replaced, truth)
        pay("least expected cost", actions[int(np.argmin(table @ p))], truth)
    oracle = float(np.mean(paid["oracle"]))
    for rule, costs in paid.items():
        print(f"{rule:28s} {np.mean(costs):6.2f} a run, {np.mean(costs) / oracle - 1:+.1%}")


if __name__ == "__main__":
    main()
