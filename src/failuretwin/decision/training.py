"""Training a network for a real robot: on the calibrated twin, without any recorded failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.decision.learned.data import Recipe, widened
from failuretwin.decision.learned.diagnoser import Diagnoser, HybridDiagnoser, LearnedDiagnoser
from failuretwin.decision.learned.features import Encoder, expectation_of
from failuretwin.decision.learned.networks import Standard, Stream
from failuretwin.decision.learned.posteriors import fit_weights
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser

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
        surprise: Mean log score [nats a run].
    """

    runs: int
    right: float
    surprise: float


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        network: Name of the network.
        iterations: Batches to learn from.
        seed: Seed of all chance.
        validation_runs: Runs of the physics engine; half set temperature and
            weights, half judge.
        hypotheses: What the network tells apart; None: the paper's classes.
    """

    network: str
    iterations: int
    seed: int = 0
    validation_runs: int = 1800
    hypotheses: tuple[Hypothesis, ...] | None = None


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
        The network, how it does, and how it does blended with the Bayesian diagnosis.
    """
    encoder = Encoder("robust", robot, expectation_of(robot, imperfections))
    hypotheses = plan.hypotheses or paper_hypotheses(robot.motor_names)
    recipe = Recipe(robot, widened(imperfections, WIDER), plan.seed, hypotheses=hypotheses)
    network = LearnedDiagnoser(
        plan.network,
        encoder,
        iterations=plan.iterations,
        learning_rate=2e-3,
        batch_runs=64,
        random_state=plan.seed % 2**32,
    )
    stream = Stream(recipe, encoder, network.batch_runs)
    classes = [str(hypothesis) for hypothesis in recipe.hypotheses]
    with stream.chunks() as chunks:
        standard = Standard.of(next(chunks)[0])
        batches = stream.batches(chunks)
        network.fit_batches(batches, standard, classes, recipe.movements, on_iteration)
    other = replace(
        recipe, imperfections=imperfections, seed=plan.seed + VALIDATION_SEED, engine="physics"
    )
    half = plan.validation_runs // 2
    bayes = BayesDiagnoser(DigitalTwin(robot), imperfections, hypotheses)
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
    network.weights_ = fit_weights(
        np.array(by_bayes), network.predict_proba(runs), np.array(truth, dtype=np.int64)
    )


def _judge(diagnoser: Diagnoser, runs: xr.Dataset) -> Validation:
    diagnoses = diagnoser.diagnose(runs)
    given = np.array([d.posterior[str(d.truth)] for d in diagnoses])
    right = float(np.mean([d.diagnosis == d.truth for d in diagnoses]))
    return Validation(len(diagnoses), right, float(-np.log(given).mean()))
