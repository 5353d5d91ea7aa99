"""Training a network for a real robot: on the calibrated twin, without any recorded failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.decision.learned.diagnoser import LearnedDiagnoser
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, expectation_of
from failuretwin.decision.learned.log_pool import HybridDiagnoser, fit_pool_weights
from failuretwin.decision.learned.networks import Standard
from failuretwin.decision.learned.training_data import Stream, TrainingData, widened
from failuretwin.decision.scoring_rules import log_score
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.protocol import Diagnoser

if TYPE_CHECKING:
    import xarray as xr

WIDER = 2.0
"""Robots in training differ this many times as much as the calibration leaves open."""
VALIDATION_SEED = 1_000_003
"""Added to the seed for runs of the other engine, so that none of their chance is shared."""


@dataclass(frozen=True)
class Validation:
    """How diagnoses do on simulated runs of the physics engine that nothing was learned from.

    Attributes:
        runs: How many there were.
        right: Share that is right.
        log_score: Mean log score [nats a run].
    """

    runs: int
    right: float
    log_score: float


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        network: Name of the network; see `NETWORKS`.
        iterations: Batches of 64 runs to learn from; ten minutes on two cores.
        seed: Seed of all chance.
        validation_runs: Runs of the physics engine; half set temperature and
            weights, half judge.
    """

    network: str = "cnn"
    iterations: int = 6000
    seed: int = 0
    validation_runs: int = 1800


def train(
    robot: Robot,
    imperfections: Imperfections | None = None,
    plan: TrainingPlan = TrainingPlan(),
    *,
    with_bayes: bool = False,
) -> LearnedDiagnoser | HybridDiagnoser:
    """Return a network trained on the twin, alone or together with the Bayesian diagnosis.

    Other processes make the runs: guard scripts by ``if __name__ == "__main__":``. Keep a network
    with `save_network`.

    Args:
        robot: The robot.
        imperfections: Its healthy behaviour, such as a calibration; None: as its profile says.
        plan: How much to train.
        with_bayes: Whether to pool the network with the Bayesian diagnosis, by fitted weights.
    """
    if imperfections is None:
        known = load_calibration(None, robot)
        robot, imperfections = known.robot, known.imperfections
    network, _, _ = train_network(plan, robot, imperfections)
    if not with_bayes:
        return network
    bayes = BayesDiagnoser(DigitalTwin(robot), imperfections)
    return HybridDiagnoser(bayes, network, network.weights_)


def train_network(
    plan: TrainingPlan,
    robot: Robot,
    imperfections: Imperfections,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> tuple[LearnedDiagnoser, Validation, Validation]:
    """Train a network on the twin with imperfections and calibrate its probabilities.

    Nothing is chosen on the way: the network of the last iteration is the result.

    Args:
        plan: How much to train.
        robot: The robot.
        imperfections: Its healthy behaviour, such as a calibration.
        on_iteration: Called after each batch with the number of those done.

    Returns:
        The network, how it does, and how it does pooled with the Bayesian diagnosis.
    """
    encoder = FeatureEncoder("robust", robot, expectation_of(robot, imperfections))
    data = TrainingData(robot, widened(imperfections, WIDER), plan.seed)
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
    with stream.chunks() as chunks:
        standard = Standard.of(next(chunks)[0])
        batches = stream.batches(chunks)
        network.fit_batches(batches, standard, classes, data.movements, on_iteration)
    other = TrainingData(
        robot, imperfections, plan.seed + VALIDATION_SEED, data.variants, engine="physics"
    )
    half = plan.validation_runs // 2
    bayes = BayesDiagnoser(DigitalTwin(robot), imperfections)
    _calibrate(network, bayes, other.run_set(0, half))
    judges = other.run_set(1, half)
    both = HybridDiagnoser(bayes, network, network.weights_)
    return network, _judge(network, judges), _judge(both, judges)


def _calibrate(network: LearnedDiagnoser, bayes: BayesDiagnoser, runs: xr.Dataset) -> None:
    """Set the temperature of a network, and its weights beside the Bayesian diagnosis."""
    network.calibrate(runs)
    classes = network.classes_.tolist()
    by_bayes = [[d.posterior[name] for name in classes] for d in bayes.diagnose(runs)]
    truth = [classes.index(str(fault)) for fault in runs["fault"].values]
    network.weights_ = fit_pool_weights(
        np.array(by_bayes), network.predict_proba(runs), np.array(truth, dtype=np.int64)
    )


def _judge(diagnoser: Diagnoser, runs: xr.Dataset) -> Validation:
    diagnoses = diagnoser.diagnose(runs)
    truth = [str(d.truth) for d in diagnoses]
    right = float(np.mean([d.diagnosis == true for d, true in zip(diagnoses, truth, strict=True)]))
    score = log_score(truth, [d.posterior for d in diagnoses])
    return Validation(len(diagnoses), right, score.mean)
