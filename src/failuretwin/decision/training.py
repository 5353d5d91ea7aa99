"""Training a network on the twin, without recorded failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import softmax

from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.evaluation import Judged
from failuretwin.decision.learned.diagnoser import (
    MotorwiseDiagnoser,
    best_temperature,
    check_modes,
)
from failuretwin.decision.learned.log_pool import HybridDiagnoser, fit_pool_weights
from failuretwin.decision.learned.moment_encoder import MomentEncoder
from failuretwin.decision.scoring import Scores
from failuretwin.decision.training_data import KINDS, PopulationData, PopulationStream
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    HealthyLike,
    RobotLike,
    calibrated,
)
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser

if TYPE_CHECKING:
    import xarray as xr

ARMS = ("armpi_fpv", "so101", "ur5e", "panda")
"""Bundled arms that one network may learn together."""
VALIDATION_SEED = 1_000_003
"""Added to the seed for validation runs."""


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        iterations: Batches of 64 runs; the default takes ten minutes on two cores.
        seed: Random seed.
        validation_runs: Runs of the physics engine: half to fit temperature, intervals and pool
            weights, half to score the result.
        hypotheses: Classes of the network; None: the paper's.
        all_arms: Whether the network learns from all bundled arms.
        device: One of `DEVICES`.
    """

    iterations: int = 6000
    seed: int = 0
    validation_runs: int = 1800
    hypotheses: tuple[Hypothesis, ...] | None = None
    all_arms: bool = False
    device: str = "auto"


def train(
    robot: RobotLike = "armpi_fpv",
    imperfections: HealthyLike = None,
    plan: TrainingPlan = TrainingPlan(),
    *,
    with_bayes: bool = False,
) -> MotorwiseDiagnoser | HybridDiagnoser:
    """Return a network trained on the twin, or its pool with the Bayesian diagnosis.

    Other processes simulate the runs: guard scripts by ``if __name__ == "__main__":``. Save a
    network with `save_network`.

    Args:
        robot: Robot to train for.
        imperfections: Healthy behaviour, such as a calibration; None: that of the robot's profile.
        plan: How much to train.
        with_bayes: Return the pool with fitted weights.
    """
    known = calibrated(robot, imperfections)
    network, _, _ = train_network(plan, known)
    if not with_bayes:
        return network
    return _pooled(_bayes_of(known, network), network, known)


def _bayes_of(known: CalibratedRobot, network: MotorwiseDiagnoser) -> BayesDiagnoser:
    """Return the Bayesian diagnosis of a robot, by the classes of its network."""
    return BayesDiagnoser(known, hypotheses=[str(name) for name in network.classes_])


def _pooled(
    bayes: BayesDiagnoser, network: MotorwiseDiagnoser, known: CalibratedRobot
) -> HybridDiagnoser:
    return HybridDiagnoser(bayes, network, network.weights_, class_name(known.robot))


@dataclass(frozen=True)
class _Exam:
    """Validation runs of one robot.

    Attributes:
        network: The network for this robot.
        bayes: Its Bayesian diagnosis.
        runs: Runs to fit temperature, intervals and pool weights.
        judges: Runs to score the result.
    """

    network: MotorwiseDiagnoser
    bayes: BayesDiagnoser
    runs: xr.Dataset
    judges: xr.Dataset

    @property
    def classes(self) -> list[str]:
        """Names of the classes of this robot."""
        return [str(name) for name in self.network.classes_]

    @property
    def truth(self) -> IntArray:
        """Index of the class of each run, (run,)."""
        classes = self.classes
        return np.array([classes.index(str(fault)) for fault in self.runs["fault"].values])


def train_network(
    plan: TrainingPlan,
    known: CalibratedRobot,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> tuple[MotorwiseDiagnoser, Scores, Scores]:
    """Train a network on the twin and calibrate its probabilities and intervals.

    The network of the last iteration is the result. `on_iteration` is called after each batch with
    the number of batches so far. Returns the network, and the scores of the network and of its
    pool with the Bayesian diagnosis on validation runs of this robot.
    """
    names = [n for n in ARMS if n != known.robot.name] if plan.all_arms else []
    robots = (known, *(calibrated(name) for name in names))
    hypotheses = plan.hypotheses or paper_hypotheses(known.robot.motor_names)
    modes = check_modes(hypotheses, known.robot)
    data = PopulationData(robots, {name: MODES[name] for name in modes}, plan.seed)
    network = MotorwiseDiagnoser(
        MomentEncoder(known.robot, known.imperfections),
        modes,
        iterations=plan.iterations,
        random_state=plan.seed % 2**32,
    )
    stream = PopulationStream(data, network.batch_of, network.batch_runs)
    counts = [kind.movements for kind in KINDS]
    arms = [arm.robot.name for arm in robots]
    with closing(stream.chunks()) as chunks:
        sample = [next(chunks)[0] for _ in robots]
        how = (min(counts), max(counts)), arms, on_iteration, plan.device
        network.fit_batches(stream.batches(chunks), sample, *how)
    exams = [_exam(plan, data, network, at) for at in range(len(robots))]
    _calibrate(network, exams)
    first = exams[0]
    both = _pooled(first.bayes, network, known)
    alone, pooled = (Judged.of(d.diagnose(first.judges)).scores for d in (network, both))
    return network, alone, pooled


def _exam(plan: TrainingPlan, data: PopulationData, network: MotorwiseDiagnoser, at: int) -> _Exam:
    """Return the validation runs of one of the robots, by its index."""
    other = replace(data, seed=plan.seed + VALIDATION_SEED, engine="physics", widening=(1.0,))
    arm, half = data.robots[at], plan.validation_runs // 2 // len(data.robots)
    own = network.for_robot(MomentEncoder(arm.robot, arm.imperfections))
    bayes = _bayes_of(arm, own)
    judges = other.run_set(at + len(data.robots), half)
    return _Exam(own, bayes, other.run_set(at, half), judges)


def _calibrate(network: MotorwiseDiagnoser, exams: Sequence[_Exam]) -> None:
    """Fit temperature, intervals, and the weights in the pool with the Bayesian diagnosis."""
    truth = np.concatenate([exam.truth for exam in exams])
    scores = _joined([exam.network.scores(exam.runs) for exam in exams], NEVER)
    network.temperature_ = best_temperature(scores, truth)
    known = [exam.network.calibrate_intervals(exam.runs).widths_ for exam in exams]
    network.widths_ = {arm: widths for one in known for arm, widths in one.items()}
    by_network = softmax(scores / network.temperature_, axis=1)
    by_bayes = [
        np.array([[d.posterior[name] for name in exam.classes] for d in found])
        for exam in exams
        for found in [exam.bayes.diagnose(exam.runs)]
    ]
    network.weights_ = fit_pool_weights(_joined(by_bayes, 0.0), by_network, truth)


NEVER = -1e6
"""Logit of a class that an arm does not have."""


def _joined(parts: Sequence[FloatArray], fill: float) -> FloatArray:
    """Return arrays (run, class) of arms with their classes as one."""
    most = max(part.shape[1] for part in parts)
    wide = [np.pad(p, ((0, 0), (0, most - p.shape[1])), constant_values=fill) for p in parts]
    return np.concatenate(wide)
