"""Networks of one arm and of four: several seeds, beside Bayes.

Trains what is missing in a folder and scores everything there on simulated runs of the physics
engine. With --arms, one motor-wise network for the four bundled arms is scored on each of them,
beside Bayes. With --real, all are scored on real runs: that is a look at them, and belongs into
looks.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from failuretwin import BayesDiagnoser, DigitalTwin, Plan, ReadOptions, load_robot, read_runs
from failuretwin.core.hypothesis import Diagnosis, paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import simulate
from failuretwin.decision.learned.log_pool import HybridDiagnoser
from failuretwin.decision.learned.storage import load_network, save_network
from failuretwin.decision.scoring import (
    log_score,
    log_score_gain,
    mcnemar,
    reliability,
)
from failuretwin.decision.training import ARMS, TrainingPlan, train_network
from failuretwin.decision.training_data import PopulationData
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibrated
from failuretwin.failure_behavior.registry import MODES

PER_CLASS = 223
"""Runs of each class by the physics engine: 2007 in all."""
POPULATION_RUNS, POPULATION_SEED = 600, 700_001
"""Runs of each arm by the physics engine, of faults of any onset, and their seed."""
KINDS = OWN, ALL = ("motorwise", "all_arms")
"""What is trained; all_arms: one network for four arms."""


def train_missing(
    folder: Path, known: CalibratedRobot, kinds: Sequence[str], seeds: int, iterations: int
) -> None:
    """Train every network for every seed that has no file yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(seeds):
        for name in kinds:
            path = folder / f"{name}_{seed}.npz"
            if not path.exists():
                plan = TrainingPlan(iterations, seed, all_arms=name == ALL)
                diagnoser, found, _ = train_network(plan, known)
                save_network(diagnoser, path)
                said = f"{found.accuracy:.4f} right, {found.log_score:.4f} nats a run"
                print(f"{name} seed {seed}: {said}", flush=True)


def judged(diagnoses: Sequence[Diagnosis]) -> tuple[float, float, float]:
    """Return the share right, the log score [nats a run] and the calibration error."""
    right = np.array([d.diagnosis == d.truth for d in diagnoses])
    stated = np.array([min(max(d.posterior.values()), 1.0) for d in diagnoses])
    nats = nats_of(diagnoses)
    error = reliability(stated, right).error
    return float(right.mean()), float(nats.mean()), float(error)


def nats_of(diagnoses: Sequence[Diagnosis]) -> FloatArray:
    """Return the log score of each run [nats]."""
    truth = [str(d.truth) for d in diagnoses]
    return log_score(truth, [d.posterior for d in diagnoses])


def print_networks(said: Mapping[str, Sequence[Diagnosis]], what: str) -> None:
    """Print every network and, over its seeds, the mean of every kind."""
    print(f"\n{what}\n{'':16s}{'right':>10s}{'nats':>8s}{'ECE':>8s}")
    rows = {name: judged(diagnoses) for name, diagnoses in said.items()}
    for name, (right, nats, error) in rows.items():
        print(f"{name:16s}{100 * right:8.1f} %{nats:8.3f}{error:8.3f}")
    for kind in KINDS:
        mine = np.array([row for name, row in rows.items() if name.startswith(f"{kind}_")])
        if len(mine):
            (right, nats, error), spread = mine.mean(axis=0), mine[:, 0].std(ddof=len(mine) > 1)
            print(
                f"{kind:16s}{100 * right:8.1f} %{nats:8.3f}{error:8.3f}   mean of {len(mine)} "
                f"seeds, sd {100 * spread:.1f} %"
            )


def intervals(diagnoses: Sequence[Diagnosis], runs: xr.Dataset) -> str:
    """Return how often the 90 % intervals of faults that were named rightly hold the truth."""
    truths = {"onset_90": runs["onset"].values, "magnitude_90": runs["magnitude"].values}
    said = []
    for mode, what in (("stuck", "held angle"), ("steady_state_error", "size")):
        some = [
            i
            for i, d in enumerate(diagnoses)
            if d.diagnosis == d.truth and str(d.truth).endswith(mode)
        ]
        for name, words in (("onset_90", "onset"), ("magnitude_90", what)):
            ends = [getattr(diagnoses[i], name) for i in some]
            pairs = [(e, truths[name][i]) for e, i in zip(ends, some, strict=True) if e is not None]
            held = sum(low - 1e-9 <= value <= high + 1e-9 for (low, high), value in pairs)
            said.append(f"{mode} {words} {held} of {len(pairs)}")
    return "; ".join(said)


def print_arms(folder: Path) -> None:
    """Print the networks for all arms beside Bayes, and beside those of one arm, on each arm."""
    modes = {name: MODES[name] for name in ("stuck", "steady_state_error")}
    for arm in ARMS:
        known = calibrated(arm)
        data = PopulationData((known,), modes, POPULATION_SEED, "physics", widening=(1.0,))
        runs = data.run_set(0, POPULATION_RUNS)
        files = [*folder.glob(f"{ALL}_*.npz"), *folder.glob(f"{arm}_*.npz")]
        if arm == "armpi_fpv":
            files += folder.glob(f"{OWN}_*.npz")
        said = {path.stem: load_network(path, known).diagnose(runs) for path in sorted(files)}
        said = {"bayes": BayesDiagnoser(known).diagnose(runs), **said}
        print_networks(said, f"{POPULATION_RUNS} runs of {arm}, faults of any onset")
        for name, diagnoses in said.items():
            print(f"{name}: {intervals(diagnoses, runs)}")


def compare(first: Sequence[Diagnosis], second: Sequence[Diagnosis], words: str) -> None:
    """Print by how much the second is better than the first on the same runs."""
    gain = log_score_gain(nats_of(first), nats_of(second), np.random.default_rng(0))
    right = [np.array([d.diagnosis == d.truth for d in said]) for said in (first, second)]
    test = mcnemar(*right)
    low, high = gain.interval
    print(
        f"{words}: {gain.mean:+.4f} nats a run (95 % {low:+.4f} to {high:+.4f}); right by one "
        f"alone {test.first_only} and {test.second_only}, p = {test.p:.2f}"
    )


@dataclass(frozen=True)
class Stored:
    """Says again what was said of some runs."""

    diagnoses: Sequence[Diagnosis]

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return it, whatever the runs."""
        return list(self.diagnoses)


def main() -> None:
    """Train, score, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the networks are kept")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=6000)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--arms", action="store_true", help="score each bundled arm and end")
    parser.add_argument("--real", type=Path, help="real runs whose folders end in _label_K")
    arguments = parser.parse_args()
    robot = load_robot("armpi_fpv")
    known = calibrated(robot)
    train_missing(arguments.folder, known, arguments.kinds, arguments.seeds, arguments.iterations)
    if arguments.arms:
        print_arms(arguments.folder)
        return
    files = [path for kind in KINDS for path in sorted(arguments.folder.glob(f"{kind}_*.npz"))]
    networks = {path.stem: load_network(path, robot) for path in files}
    bayes = BayesDiagnoser(DigitalTwin(robot))
    hypotheses = paper_hypotheses(robot.motor_names)
    figures = known.imperfections
    plan = Plan(robot, hypotheses, PER_CLASS, 500_002, figures, engine="physics")
    sets = {f"{plan.size} runs of the physics engine": simulate(plan)}
    if arguments.real is not None:
        options = ReadOptions(published_labels=True)
        real = read_runs(arguments.real, robot, options)
        sets[f"{len(real['run'])} real runs of {arguments.real.name}"] = real
    for what, runs in sets.items():
        said = {name: network.diagnose(runs) for name, network in networks.items()}
        model = bayes.diagnose(runs)
        print_networks({"bayes": model, **said}, what)
        for name, diagnoses in {"bayes": model, **said}.items():
            print(f"{name}: {intervals(diagnoses, runs)}")
        for name, network in networks.items():
            for form, weight in (("blended", network.weights_), ("gated", None)):
                both = HybridDiagnoser(Stored(model), Stored(said[name]), weight).diagnose(runs)
                compare(model, both, f"{form} with {name} against bayes")
                compare(said[name], both, f"{form} with {name} against {name}")
    print()
    for name, network in networks.items():
        print(f"{name}: temperature {network.temperature_:.2f}, {network.weights_}")


if __name__ == "__main__":
    main()
