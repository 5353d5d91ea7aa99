"""Training a network for a real robot: on the calibrated twin, without any recorded failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.encoder import Encoder
from failuretwin.decision.learned.estimator import LearnedDiagnoser
from failuretwin.decision.learned.recipe import Recipe, widened
from failuretwin.decision.learned.robust_features import expectation_of
from failuretwin.decision.learned.stream import Stream
from failuretwin.decision.learned.training import Standard
from failuretwin.digital_model.imperfections import Imperfections
from failuretwin.digital_model.robot import Robot

WIDER = 2.0
"""Robots in training differ this many times as much as the calibration leaves open."""
VALIDATION_SEED = 1_000_003
"""Added to the seed for runs of the other engine, so that none of their chance is shared."""


@dataclass(frozen=True)
class Validation:
    """How a network does on simulated runs of the physics engine, which it has not learned from.

    Attributes:
        runs: How many there were.
        right: Share that it gets right.
        surprise: Mean log score [nats a run].
        temperature: What its scores were divided by, found on other such runs.
    """

    runs: int
    right: float
    surprise: float
    temperature: float


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        network: Name of the network.
        iterations: Batches to learn from.
        seed: Seed of all chance.
        validation_runs: Runs of the physics engine; half set the temperature, half judge.
    """

    network: str
    iterations: int
    seed: int = 0
    validation_runs: int = 1800


def train_network(
    plan: TrainingPlan,
    robot: Robot,
    imperfections: Imperfections,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> tuple[LearnedDiagnoser, Validation]:
    """Train a network on the twin with imperfections and calibrate its probabilities.

    Nothing is chosen on the way: the network of the last iteration is the result.

    Args:
        plan: How much to train.
        robot: The robot.
        imperfections: Its healthy behaviour, such as a calibration.
        on_iteration: Called after each batch with the number of those done.
    """
    encoder = Encoder("robust", robot, expectation_of(robot, imperfections))
    recipe = Recipe(robot, widened(imperfections, WIDER), plan.seed)
    diagnoser = LearnedDiagnoser(
        plan.network,
        encoder,
        iterations=plan.iterations,
        learning_rate=2e-3,
        batch_runs=64,
        random_state=plan.seed % 2**32,
    )
    stream = Stream(recipe, encoder, diagnoser.batch_runs)
    classes = [str(hypothesis) for hypothesis in recipe.hypotheses]
    with stream.chunks() as chunks:
        standard = Standard.of(next(chunks)[0])
        batches = stream.batches(chunks)
        diagnoser.fit_batches(batches, standard, classes, recipe.movements, on_iteration)
    return diagnoser, _calibrate(diagnoser, recipe, plan, imperfections)


def _calibrate(
    diagnoser: LearnedDiagnoser, recipe: Recipe, plan: TrainingPlan, imperfections: Imperfections
) -> Validation:
    """Set the temperature on runs of the physics engine and judge on others of them."""
    other = Recipe(
        recipe.robot, imperfections, plan.seed + VALIDATION_SEED, recipe.variants, "physics"
    )
    encoder = diagnoser.encoder
    assert encoder is not None
    features, index = other.chunk(0, plan.validation_runs, encoder)
    truth = diagnoser.classes_[index]
    half = plan.validation_runs // 2
    diagnoser.calibrate(features[:half], truth[:half])
    chances = diagnoser.predict_proba(features[half:])
    return _judge(chances, index[half:], float(diagnoser.temperature_))


def _judge(chances: FloatArray, truth: IntArray, temperature: float) -> Validation:
    given = chances[np.arange(len(truth)), truth]
    right = float(np.mean(chances.argmax(axis=1) == truth))
    return Validation(len(truth), right, float(-np.log(given).mean()), temperature)
