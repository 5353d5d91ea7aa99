"""Plan of the study of rivals, and the training of one method on one twin with one seed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import log_softmax, softmax

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.store import load_run_set, replacing
from failuretwin.decision.learned.feature_encoder import Floats
from failuretwin.decision.learned.paper_study import (
    BATCH_RUNS,
    class_names,
    held_out,
    in_bfloat16,
)
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.decision.learned.networks import Batch

PUBLISHED, IMPERFECT = TWINS = ("published", "imperfect")
NETWORKS = ("lstm", "cnn", "tcn", "transformer")
ADAPTING = {"dann": "P1", "fine-tuned": "P2"}
"""CNNs that learn from target runs, with the protocol letter."""
CLASSICAL = {
    "minirocket": "MiniRocket",
    "boosting": "GradientBoosting",
    "nearest": "NearestSimulation",
}
OWN = "motorwise"
"""Our network."""
MODELS = ("kalman", "bayes", "self-calibrating", "hybrid")
"""Methods without training, and the hybrid, which pools Bayes with our network of its seed."""
LATE = ("fine-tuned", "hybrid")
"""Methods that go on from a network of their seed."""


@dataclass(frozen=True)
class RivalPlan:
    """Sizes of the study.

    Attributes:
        seed: Random seed.
        runs_per_class: Simulated training runs of each class, for every method.
        iterations: Batches of 32 runs, for every network.
        repeats: Seeds.
        stand_in_runs: Runs per class of the stand-in test set by the physics engine.
    """

    seed: int = 0
    runs_per_class: int = 400
    iterations: int = 3030
    repeats: int = 5
    stand_in_runs: int = 40


def quick_rivals(seed: int) -> RivalPlan:
    """Return a small study."""
    return RivalPlan(seed, 40, 60, 1, 4)


@dataclass(frozen=True)
class RivalJob:
    """One method, trained on runs of one twin with one seed."""

    method: str
    twin: str
    repeat: int

    @property
    def name(self) -> str:
        """Name of its file, without suffix."""
        return f"{self.method}_{self.twin}_{self.repeat}"

    @property
    def protocol(self) -> str:
        """Protocol letter; the imperfect twin was calibrated on healthy logs."""
        if self.method == "self-calibrating":
            return "P1"
        return ADAPTING.get(self.method, "P0" if self.twin == PUBLISHED else "P0c")


def rival_jobs(plan: RivalPlan) -> list[RivalJob]:
    """Return all jobs; methods without chance have one, and those of one twin only that."""
    jobs = []
    for repeat in range(plan.repeats):
        for twin in TWINS:
            names = [*NETWORKS, OWN, *ADAPTING, *CLASSICAL, "hybrid"]
            names += [m for m in MODELS if m != "hybrid" and repeat == 0]
            one_twin = {OWN: IMPERFECT, "hybrid": IMPERFECT, "self-calibrating": PUBLISHED}
            jobs += [RivalJob(n, twin, repeat) for n in names if one_twin.get(n, twin) == twin]
    return jobs


# One training.

Answer = Callable[[int], FloatArray]
"""Returns logits or probabilities of the test runs in one of their views, (run, class)."""
LEARNT = "imperfect.nc"
"""Training runs of the imperfect twin."""
FOLDS = 5
RATE = 3e-3
"""First learning rate of the networks; it falls to zero along half a cosine."""
FINE_TUNING = (1e-4, 0.1)
"""Learning rate, and iterations as a share of those of the training."""


def by_training(
    plan: RivalPlan, robot: Robot, folder: Path, job: RivalJob, test: xr.Dataset
) -> Answer:
    """Train a method and return what gives its probabilities.

    A tenth of the training runs sets the temperature of the probabilities.
    """
    from failuretwin.decision.learned.diagnoser import best_temperature
    from failuretwin.decision.learned.networks import Standard, scores_of

    rng = np.random.default_rng([plan.seed, job.repeat])
    with np.load(folder / f"{job.twin}.npz", allow_pickle=False) as stored:
        features, classes, target = stored["features"], stored["classes"], stored["test"]
    judge, learn = held_out(len(features), rng)
    standard = Standard.of(features[learn])
    features, target = standard(features), standard(target)
    logits: Callable[[Floats], FloatArray]
    if job.method in CLASSICAL:
        from failuretwin.decision.rivals import classical

        model = getattr(classical, CLASSICAL[job.method])(random_state=job.repeat)
        model.fit(features[learn], classes[learn])
        logits = partial(_logits, len(class_names(robot)), model)
    else:
        trainer = _Trainer(plan, robot, job, rng, folder)
        network = trainer.trained((features[learn], classes[learn]), target[0])
        logits = partial(scores_of, network)
    if job.method == "fine-tuned":
        truth = np.array([class_names(robot).index(str(f)) for f in test["fault"].values])
        answer = trainer.fine_tuned(network, target, truth)
    else:
        answer = partial(_seen_by, logits, target)
    temperature = best_temperature(logits(features[judge]), classes[judge])
    return lambda view: np.asarray(softmax(log_softmax(answer(view), axis=1) / temperature, axis=1))


def by_own_network(
    plan: RivalPlan,
    known: CalibratedRobot,
    folder: Path,
    job: RivalJob,
    views: Sequence[xr.Dataset],
) -> Answer:
    """Train our network on the same runs, as often, and return what gives its probabilities."""
    from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser
    from failuretwin.decision.learned.moment_encoder import MomentEncoder

    runs = load_run_set(folder / LEARNT)
    rng = np.random.default_rng([plan.seed, job.repeat])
    judge, learn = held_out(runs.sizes["run"], rng)
    encoder = MomentEncoder(known.robot, known.imperfections)
    network = MotorwiseDiagnoser(
        encoder, iterations=plan.iterations, batch_runs=BATCH_RUNS, random_state=job.repeat
    )
    network.fit(runs.isel(run=learn)).calibrate(runs.isel(run=judge))
    places = [network.classes_.tolist().index(name) for name in class_names(known.robot)]
    return lambda view: network.predict_proba(views[view])[:, places]


def _seen_by(logits: Callable[[Floats], FloatArray], target: Floats, view: int) -> FloatArray:
    return logits(target[view])


def _logits(count: int, model: Any, features: Floats) -> FloatArray:
    """Return log probabilities of `count` classes, (run, class)."""
    chances = np.zeros((len(features), count))
    chances[:, model.classes_] = model.predict_proba(features)
    return np.asarray(np.log(np.maximum(chances, LEAST)))


LEAST = 1e-6
"""Least probability of a classifier before the temperature: trees and neighbours give zeros."""


@dataclass(frozen=True)
class _Trainer:
    """Trains the network of one job."""

    plan: RivalPlan
    robot: Robot
    job: RivalJob
    rng: np.random.Generator
    folder: Path

    def trained(self, learn: Batch, target: Floats) -> Any:
        """Return a trained network, stored unless it adapts; fine-tuning goes on from the CNN."""
        import torch

        from failuretwin.decision.learned import networks as own

        torch.manual_seed(int(self.rng.integers(2**31)))
        kind = self.job.method if self.job.method in NETWORKS else "cnn"
        classes = len(class_names(self.robot))
        network: Any = own.build_network(kind, learn[0].shape[2], classes)
        batches = own.shuffled_batches(*learn, BATCH_RUNS, self.rng)
        if self.job.method == "dann":
            steps = self.plan.iterations, RATE
            run = own.adversarial_training(network, batches, target, *steps, self.rng)
            deque(in_bfloat16(run), maxlen=0)
            return network
        return self._kept(network, batches)

    def _kept(self, network: Any, batches: Iterator[Batch]) -> Any:
        """Train a network, or load that of another method that goes on from it."""
        import torch

        from failuretwin.decision.learned.networks import training

        kind = self.job.method if self.job.method in NETWORKS else "cnn"
        stored = self.folder / f"{replace(self.job, method=kind).name}.pt"
        if kind != self.job.method and stored.is_file():
            network.load_state_dict(torch.load(stored, weights_only=True))
            return network
        run = training(network, batches, self.plan.iterations, RATE, decay=True)
        deque(in_bfloat16(run), maxlen=0)
        with replacing(stored) as new:
            torch.save(network.state_dict(), new)
        return network

    def fine_tuned(self, network: Any, target: Floats, truth: IntArray) -> Answer:
        """Return the logits of each fold by a network that went on learning on the others.

        It learns on whole runs, the first view of `target` (view, run, point, channel).
        """
        from copy import deepcopy

        from failuretwin.decision.learned import networks as own

        rate, share = FINE_TUNING
        steps = max(1, round(share * self.plan.iterations))
        tuned, fold_of = [deepcopy(network) for _ in range(FOLDS)], folds(truth)
        for fold, one in enumerate(tuned):
            others = fold_of != fold
            batches = own.shuffled_batches(target[0, others], truth[others], BATCH_RUNS, self.rng)
            run = own.training(one, batches, steps if others.any() else 0, rate)
            deque(in_bfloat16(run), maxlen=0)

        def answer(view: int) -> FloatArray:
            by_fold = [own.scores_of(one, target[view]) for one in tuned]
            return np.stack(by_fold)[fold_of, np.arange(len(truth))]

        return answer


def folds(truth: IntArray) -> IntArray:
    """Return the fold of each run: of every class, consecutive runs stay together."""
    fold = np.zeros(len(truth), dtype=np.int64)
    for number in np.unique(truth):
        places = np.flatnonzero(truth == number)
        fold[places] = np.arange(len(places)) * FOLDS // len(places)
    return fold
