"""Training a network on the twin, without recorded failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.evaluation import Judged
from failuretwin.decision.learned.diagnoser import (
    LearnedDiagnoser,
    NetworkDiagnoser,
    best_temperature,
)
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, expectation_of
from failuretwin.decision.learned.labels import Labels
from failuretwin.decision.learned.log_pool import HybridDiagnoser, fit_pool_weights
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.motorwise_diagnoser import (
    NETWORK,
    MotorwiseDiagnoser,
    check_modes,
)
from failuretwin.decision.learned.networks import Standard
from failuretwin.decision.motorwise_data import KINDS, PopulationData, PopulationStream
from failuretwin.decision.scoring import Scores
from failuretwin.decision.training_data import WIDER, Stream, TrainingData, widened
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
"""Bundled arms that one motor-wise network may learn together."""
VALIDATION_SEED = 1_000_003
"""Added to the seed for validation runs."""


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        network: `NETWORK`, or the name of a network on features; see `NETWORKS`.
        iterations: Batches of 64 runs; the default takes ten minutes on two cores.
        seed: Random seed.
        validation_runs: Runs of the physics engine: half to fit temperature and pool weights, half
            to score the result.
        hypotheses: Classes of the network; None: the paper's.
        all_arms: Whether the motor-wise network learns from all bundled arms.
        device: One of `DEVICES`.
    """

    network: str = NETWORK
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
) -> NetworkDiagnoser | HybridDiagnoser:
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
    return HybridDiagnoser(
        BayesDiagnoser(known), network, network.weights_, class_name(known.robot)
    )


def train_network(
    plan: TrainingPlan,
    known: CalibratedRobot,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> tuple[NetworkDiagnoser, Scores, Scores]:
    """Train a network on the twin and calibrate its probabilities.

    The network of the last iteration is the result. `on_iteration` is called after each batch with
    the number of batches so far. Returns the network, and the scores of the network and of its
    pool with the Bayesian diagnosis on validation runs of this robot.
    """
    hypotheses = plan.hypotheses or paper_hypotheses(known.robot.motor_names)
    learned = _motorwise if plan.network == NETWORK else _on_features
    network, exams = learned(plan, known, hypotheses, on_iteration)
    _calibrate(network, exams)
    alone, pooled = exams[0].judged(network)
    return network, alone, pooled


@dataclass(frozen=True)
class _Exam:
    """Validation runs of one robot.

    Attributes:
        bayes: The Bayesian diagnosis of this robot.
        runs: Runs to fit temperature and pool weights.
        judges: Runs to score the result.
        encoder: What is known of the robot; None: the network has an encoder of its own.
    """

    bayes: BayesDiagnoser
    runs: xr.Dataset
    judges: xr.Dataset
    encoder: MomentEncoder | None = None

    def of(self, network: NetworkDiagnoser) -> NetworkDiagnoser:
        """Return the network for this robot."""
        if self.encoder is None or not isinstance(network, MotorwiseDiagnoser):
            return network
        return network.for_robot(self.encoder)

    def labelled(self, network: MotorwiseDiagnoser) -> tuple[Tokens, Labels]:
        """Return tokens and truth of the runs to fit."""
        assert self.encoder is not None
        faults = [str(name) for name in self.runs["fault"].values]
        names = self.encoder.robot.motor_names
        labels = Labels.of_runs(self.runs, faults, names, network.modes)
        return self.encoder.encode(self.runs), labels

    def judged(self, network: NetworkDiagnoser) -> tuple[Scores, Scores]:
        """Return the scores of the network and of its pool with the Bayesian diagnosis."""
        kind = class_name(self.bayes.twin.robot)
        both = HybridDiagnoser(self.bayes, network, network.weights_, kind)
        alone, pooled = (Judged.of(d.diagnose(self.judges)).scores for d in (network, both))
        return alone, pooled


Trained = tuple[NetworkDiagnoser, Sequence[_Exam]]
OnIteration = Callable[[int], None]


def _motorwise(
    plan: TrainingPlan,
    known: CalibratedRobot,
    hypotheses: Sequence[Hypothesis],
    on_iteration: OnIteration,
) -> Trained:
    """Train the motor-wise network, and simulate the validation runs of its arms."""
    names = [n for n in ARMS if n != known.robot.name] if plan.all_arms else []
    robots = (known, *(calibrated(name) for name in names))
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
    other = replace(data, seed=plan.seed + VALIDATION_SEED, engine="physics", exact=True)
    half = plan.validation_runs // 2 // len(robots)
    exams = [
        _Exam(
            BayesDiagnoser(arm, hypotheses=[*map(str, network.for_robot(encoder).classes_)]),
            other.run_set(at, half),
            other.run_set(at + len(robots), half),
            encoder,
        )
        for at, arm in enumerate(robots)
        for encoder in [MomentEncoder(arm.robot, arm.imperfections)]
    ]
    return network, exams


def _on_features(
    plan: TrainingPlan,
    known: CalibratedRobot,
    hypotheses: Sequence[Hypothesis],
    on_iteration: OnIteration,
) -> Trained:
    """Train a network on features of points in time."""
    robot, imperfections = known.robot, known.imperfections
    encoder = FeatureEncoder("robust", robot, expectation_of(robot, imperfections))
    data = TrainingData(
        robot, widened(imperfections, WIDER), plan.seed, hypotheses=tuple(hypotheses)
    )
    network = LearnedDiagnoser(
        plan.network,
        encoder,
        iterations=plan.iterations,
        learning_rate=2e-3,
        batch_runs=64,
        random_state=plan.seed % 2**32,
    )
    stream = Stream(data, encoder, network.batch_runs)
    classes = [str(hypothesis) for hypothesis in data.hypotheses]
    with closing(stream.chunks()) as chunks:
        standard = Standard.of(next(chunks)[0])
        batches = stream.batches(chunks)
        network.fit_batches(batches, standard, classes, data.movements, on_iteration, plan.device)
    other = replace(
        data, imperfections=imperfections, seed=plan.seed + VALIDATION_SEED, engine="physics"
    )
    half = plan.validation_runs // 2
    bayes = BayesDiagnoser(known, hypotheses=hypotheses)
    return network, [_Exam(bayes, other.run_set(0, half), other.run_set(1, half))]


def _calibrate(network: NetworkDiagnoser, exams: Sequence[_Exam]) -> None:
    """Fit the temperature of a network and its weights in the pool with the Bayesian diagnosis."""
    truth = np.concatenate([_truth(exam.of(network), exam.runs) for exam in exams])
    scores = [exam.of(network).scores(exam.runs) for exam in exams]
    network.temperature_ = best_temperature(_joined(scores, NEVER), truth)
    if isinstance(network, MotorwiseDiagnoser):
        network.calibrate_sizes([exam.labelled(network) for exam in exams])
    by_network = [exam.of(network).predict_proba(exam.runs) for exam in exams]
    by_bayes = []
    for exam in exams:
        classes = exam.of(network).classes_.tolist()
        found = exam.bayes.diagnose(exam.runs)
        by_bayes.append(np.array([[d.posterior[name] for name in classes] for d in found]))
    network.weights_ = fit_pool_weights(_joined(by_bayes, 0.0), _joined(by_network, 0.0), truth)


NEVER = -1e6
"""Logit of a class that an arm does not have."""


def _truth(network: NetworkDiagnoser, runs: xr.Dataset) -> IntArray:
    classes = network.classes_.tolist()
    return np.array([classes.index(str(fault)) for fault in runs["fault"].values], dtype=np.int64)


def _joined(parts: Sequence[FloatArray], fill: float) -> FloatArray:
    """Return arrays (run, class) of arms with their classes as one."""
    most = max(part.shape[1] for part in parts)
    wide = [np.pad(p, ((0, 0), (0, most - p.shape[1])), constant_values=fill) for p in parts]
    return np.concatenate(wide)
