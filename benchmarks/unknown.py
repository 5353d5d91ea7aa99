"""Is what is not in the set of hypotheses called `unknown`, and what does that cost?

    python benchmarks/unknown.py [--runs 40] [--known 40] [--seed 0] [--engine servo]
                                 [--forget]

Offered are the paper's nine hypotheses and `unknown`; true are faults of other modes, two faults
at once, and two kinds of fault that no law describes: a gear that runs eccentrically, and a stop
that cuts off the ends of a motor's range. A run is foreign if its truth beats every one of the
nine by 5 nats or more, as docs/isolability.md reckons it; of two faults and of those without a law,
at sizes and an onset that explain the run exactly. The loss is that on runs of the nine, with
`unknown` in the set and without. With --forget, `unknown` does without the law of the mode that is
true, as if nobody had thought of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import ClassVar
from unittest.mock import patch

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from telling import nats, right, share

import failuretwin as ft
from failuretwin.core.hypothesis import (
    HEALTHY,
    UNKNOWN,
    Diagnosis,
    Fault,
    Hypothesis,
    paper_hypotheses,
    single_faults,
)
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.scoring import log_score_gain
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.fault import FaultGroup
from failuretwin.failure_behavior.mode import Range, SizedMode
from failuretwin.failure_behavior.registry import register_mode
from failuretwin.inference.expected_bayes_factors import (
    ExpectedLogBayesFactor,
    expected_log_bayes_factors,
    truth_and_faults,
)
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import unlisted as unlisted_in_full

FOREIGN_NATS = 5.0
DISTANCES = (FOREIGN_NATS, 15.0, 40.0, np.inf)
OTHERS = "[a motor that is faulty, another motor, healthy, no verdict]"
LEFT_OUT = (
    "encoder_scale",
    "encoder_bias",
    "slow",
    "lag",
    "backlash",
    "drift",
    "intermittent",
    "torque_loss",
    "lost_commands",
)
ALIEN = ("eccentric", "end_stop")
PAIRS = (("stuck", "stuck"), ("stuck", "encoder_scale"), ("stuck", "encoder_bias"))


@dataclass(frozen=True, kw_only=True)
class Eccentric(SizedMode):
    """A gear runs eccentrically: the motor is off by so much [rad], back and forth twice a turn."""

    mode: ClassVar[str] = "eccentric"
    unit: ClassVar[str] = "rad"

    magnitude: Range = (0.05, 0.2)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference."""
        return reference + faults.effect(time) * np.sin(4.0 * reference + 1.0)


@dataclass(frozen=True, kw_only=True)
class EndStop(SizedMode):
    """Something is in the way: the motor loses this share of its 80 degrees to either side."""

    mode: ClassVar[str] = "end_stop"
    unit: ClassVar[str] = "ratio"
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.6, 0.95)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Hold the reference within the stops."""
        limit = np.deg2rad(80.0) * (1.0 - faults.effect(time))
        return np.clip(reference, -limit, limit)


def main() -> None:
    """Make runs, diagnose them and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="of each mode that is left out")
    parser.add_argument("--known", type=int, default=40, help="of each of the nine")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", default="servo", help="what moves the arm")
    parser.add_argument("--forget", action="store_true", help="the law of the mode that is true")
    options = parser.parse_args()
    register_mode(Eccentric())
    register_mode(EndStop())
    robot = ft.load_robot("armpi_fpv")
    healthy = load_calibration("armpi_fpv", robot).imperfections
    twin, nine = ft.DigitalTwin(robot), paper_hypotheses(robot.motor_names)
    diagnoser = ft.BayesDiagnoser(twin, healthy, [*nine, UNKNOWN])
    print(f"{'left out':24s} {'foreign':>8s}   of the foreign: called unknown; others: {OTHERS}")
    parts = []
    for name, true in unlisted(robot):
        per_class = -(-options.runs // len(true))
        plan = ft.Plan(robot, true, per_class, options.seed, healthy, engine=options.engine)
        runs = ft.simulate(plan)
        forgotten = name in ALIEN or options.forget
        others = partial(_other_hypotheses, name if forgotten else "")
        with patch("failuretwin.inference.posterior.unlisted", others):
            said = np.array([_kind(d) for d in diagnoser.diagnose(runs)])
        nats_ahead = ahead(diagnoser, runs, nine, healthy)
        tell(name, said, nats_ahead >= FOREIGN_NATS)
        if name not in ALIEN:
            parts.append((said, nats_ahead))
    said, nats_ahead = (np.concatenate(values) for values in zip(*parts, strict=True))
    tell("all that have a law", said, nats_ahead >= FOREIGN_NATS)
    for low, high in pairwise(DISTANCES):
        tell(f"  {low:g} to {high:g} nats", said, (nats_ahead >= low) & (nats_ahead < high))
    plan = ft.Plan(robot, nine, options.known, options.seed, healthy, engine=options.engine)
    tell_loss(ft.simulate(plan), diagnoser)


def _other_hypotheses(
    forgotten: str, likelihood: RunLikelihood, known: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Return the single faults that are not offered, but for those of a mode that is forgotten."""
    others = unlisted_in_full(likelihood, known)
    return [h for h in others if h.faults[0].mode != forgotten]


def _kind(diagnosis: Diagnosis) -> str:
    """Return what was said: unknown, nothing, healthy, a faulty motor, another motor."""
    if diagnosis.diagnosis in (None, str(UNKNOWN), str(HEALTHY)):
        return str(diagnosis.diagnosis)
    faulty = {fault.motor for fault in Hypothesis.parse(str(diagnosis.truth)).faults}
    said = Hypothesis.parse(str(diagnosis.diagnosis)).faults[0].motor
    return "faulty" if said in faulty else "other"


def tell(name: str, said: NDArray[np.str_], some: BoolArray) -> None:
    """Print what was said of some of the runs of a kind, if there are any."""
    chosen = said[some]
    if not len(chosen):
        return
    unknown, *others = (
        int(np.count_nonzero(chosen == kind))
        for kind in (str(UNKNOWN), "faulty", "other", str(HEALTHY), str(None))
    )
    foreign = f"{len(chosen):3d}/{len(said):3d}"
    print(f"{name:24s} {foreign:>8s}   {share(unknown, len(chosen))}; {others}", flush=True)


def unlisted(robot: Robot) -> Iterator[tuple[str, list[Hypothesis]]]:
    """Return what is true, by kind: every motor, or neighbouring pairs of motors."""
    for mode in (*LEFT_OUT, *ALIEN):
        motors = robot.motor_names
        if mode == "torque_loss":  # the first motor turns about the vertical and bears no load
            motors = motors[1:]
        yield mode, [h for h in single_faults(motors, [mode]) if h.faults]
    for one, two in PAIRS:
        neighbours = zip(robot.motor_names, robot.motor_names[1:], strict=False)
        pairs = [Hypothesis((Fault(a, one), Fault(b, two))) for a, b in neighbours]
        yield f"{one}+{two}", pairs


def ahead(
    diagnoser: ft.BayesDiagnoser,
    runs: xr.Dataset,
    nine: Sequence[Hypothesis],
    healthy: Imperfections,
) -> FloatArray:
    """Return by how much the truth of each run beats the nearest of the nine, (run,) [nats]."""
    truth, faults = truth_and_faults(runs)
    if len(truth[0].faults) == 1 and truth[0].faults[0].mode not in ALIEN:
        return expected_log_bayes_factors(diagnoser.twin, runs, healthy, nine).nearest
    # Two faults, or one without a law, explain it exactly: densities are relative to that.
    judge = ExpectedLogBayesFactor(diagnoser.healthy_model, tuple(nine), diagnoser.priors)
    return -judge.fits(runs, faults, runs["onset"].values).max(axis=1)


def tell_loss(runs: xr.Dataset, diagnoser: ft.BayesDiagnoser) -> None:
    """Print what `unknown` costs on runs of the nine."""
    known = [h for h in diagnoser.hypothesis_set if h.known]
    without = ft.BayesDiagnoser(diagnoser.twin, diagnoser.imperfections, known).diagnose(runs)
    found = diagnoser.diagnose(runs)
    for name, results in (("without unknown", without), ("with it", found)):
        good = right(results)
        print(f"runs of the nine, {name}: right {share(int(good.sum()), len(good))}")
    said = sum(d.diagnosis == str(UNKNOWN) for d in found)
    gain = log_score_gain(nats(found), nats(without), np.random.default_rng(0))
    low, high = gain.interval
    print(f"  called unknown: {share(said, len(found))}")
    print(f"  costs {gain.mean:.4f} nats a run (95 % interval {low:.4f} to {high:.4f})")


if __name__ == "__main__":
    main()
