"""The study of rivals: every method on the same training runs, the same test runs, five seeds.

Each job writes its diagnoses to a file of its own, so an interrupted study goes on.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import log_softmax, softmax

from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import load_run_set, replacing, save_run_set, write_text
from failuretwin.decision.benchmark.tasks import PREFIXES_S, TASKS, Judgement
from failuretwin.decision.evaluation import Truths, compare, evaluate
from failuretwin.decision.learned.feature_encoder import (
    FeatureEncoder,
    Floats,
    expectation_of,
    signals_of,
)
from failuretwin.decision.learned.paper_study import (
    BATCH_RUNS,
    VALIDATION_SHARE,
    WORK,
    Exam,
    begin,
    class_names,
    in_bfloat16,
    spread,
)
from failuretwin.decision.results import read_results, write_json_lines
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.robot import Robot, load_robot

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.decision.learned.networks import Batch

PUBLISHED, IMPERFECT = TWINS = ("published", "imperfect")
NETWORKS = ("lstm", "cnn", "tcn", "transformer", "motorwise")
ADAPTING = {"dann": "P1", "fine-tuned": "P2"}
"""CNNs that learn from target runs, with the protocol letter."""
DEDICATED = {"hierarchy": 5, "specialists": 4, "motors-3-4": 2}
"""CNNs for single motors, with their number: they share the iterations."""
CLASSICAL = {
    "minirocket": "MiniRocket",
    "boosting": "GradientBoosting",
    "nearest": "NearestSimulation",
}
MODELS = ("kalman", "bayes", "self-calibrating", "hybrid")
"""Methods without training, and the hybrid, which pools one of them with the CNN of its seed."""
FOLDS = 5
RATE = 3e-3
"""First learning rate of the networks; it falls to zero along half a cosine."""
FINE_TUNING = (1e-4, 0.1)
"""Learning rate, and iterations as a share of those of the training."""
LATE = ("fine-tuned", "motors-3-4", "hybrid")
"""Methods that go on from the CNN of their seed."""
ANSWERS, TEST = "answers", "test.nc"
VIEWS = ("", *(f"_{end:g}s" for end in PREFIXES_S))
"""Suffixes of files: the whole runs, and what is seen of them at three earlier times."""


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
            names = [*NETWORKS, *ADAPTING, *DEDICATED, *CLASSICAL, "hybrid"]
            names += [m for m in MODELS if m != "hybrid" and repeat == 0]
            one_twin = {"motorwise": IMPERFECT, "hybrid": IMPERFECT, "self-calibrating": PUBLISHED}
            jobs += [RivalJob(n, twin, repeat) for n in names if one_twin.get(n, twin) == twin]
    return jobs


def known_robot(robot: Robot, twin: str) -> CalibratedRobot:
    """Return the robot with what a method knows of it; the published twin knows its class."""
    if twin == PUBLISHED:
        return CalibratedRobot(robot, generic_imperfections(robot))
    return load_calibration(None, robot)


# Training runs and features, made once.


def make_rival_data(plan: RivalPlan, robot: Robot, exam: Exam, folder: Path) -> None:
    """Write the arrays of both twins and the test runs into `folder`."""
    from failuretwin.decision.training import WIDER, TrainingData, widened

    names = class_names(robot)
    published = simulate(Plan(robot, names, plan.runs_per_class, plan.seed))
    encoder = FeatureEncoder("augmented", robot)
    truth = np.array([names.index(str(fault)) for fault in published["fault"].values])
    made = {PUBLISHED: (encoder, encoder.encode(signals_of(published)), truth)}
    known = known_robot(robot, IMPERFECT)
    data = TrainingData(robot, widened(known.imperfections, WIDER), plan.seed)
    robust = FeatureEncoder("robust", robot, expectation_of(robot, known.imperfections))
    made[IMPERFECT] = (robust, *data.chunk(0, len(published["run"]), robust))
    for twin, (coder, features, classes) in made.items():
        with replacing(folder / f"{twin}.npz") as new, new.open("wb") as file:
            test = np.stack([coder.encode(signals_of(seen)) for seen in views_of(exam.runs)])
            np.savez(file, allow_pickle=False, features=features, classes=classes, test=test)
    save_run_set(exam.runs, folder / TEST)


def views_of(runs: xr.Dataset) -> list[xr.Dataset]:
    """Return whole runs, and runs whose commands rest and whose readings end after a time."""
    views = [runs]
    for end in PREFIXES_S:
        seen = runs["time"] < end
        last = runs["command"].isel(time=int(seen.sum()) - 1)
        command, measured = runs["command"].where(seen, last), runs["measured"].where(seen)
        views.append(runs.assign(command=command, measured=measured))
    return views


# One job.

Answer = Callable[[int], FloatArray]
"""Returns logits or probabilities of the test runs in one of the `VIEWS`, (run, class)."""


def run_rivals(
    plan: RivalPlan, robot: Robot, exam: Exam, out: Path, on_progress: Callable[[int], None]
) -> None:
    """Run the jobs without a result; those that go on from others come last."""
    begin(plan, robot, exam, out, make_rival_data)
    jobs, folder = rival_jobs(plan), out / WORK
    missing = [job for job in jobs if not _cost(folder, job).is_file()]
    (folder / ANSWERS).mkdir(exist_ok=True)
    on_progress(len(jobs) - len(missing))
    work = partial(run_job, plan, str(robot.source), folder)
    for late in (False, True):
        some = [job for job in missing if (job.method in LATE) == late]
        if some:
            spread(work, some, on_progress)


def run_job(plan: RivalPlan, profile: str, folder: Path, job: RivalJob) -> None:
    """Write the diagnoses of one job, then its cost."""
    robot, test = load_robot(profile), load_run_set(folder / TEST)
    start = time.process_time()
    answer: Answer = partial(_by_model, robot, folder, job, views_of(test))
    if job.method not in MODELS:
        answer = _by_training(plan, robot, folder, job, test)
    trained = time.process_time()
    chances = [answer(0)]
    seconds = time.process_time() - trained
    chances += [answer(view) for view in range(1, len(VIEWS))]
    names = class_names(robot)
    for suffix, rows in zip(VIEWS, chances, strict=True):
        found = list(_diagnoses(job, names, test, rows))
        write_json_lines(found, _answers(folder, job, suffix))
    cost = {"training_s": trained - start, "run_ms": 1e3 * seconds / len(test["run"])}
    write_text(json.dumps(cost), _cost(folder, job))


def _answers(folder: Path, job: RivalJob, suffix: str = "") -> Path:
    return folder / ANSWERS / f"{job.name}{suffix}.jsonl"


def _cost(folder: Path, job: RivalJob) -> Path:
    """Return the file of costs, which is written when a job is done."""
    return folder / ANSWERS / f"{job.name}.json"


def _diagnoses(
    job: RivalJob, names: Sequence[str], test: xr.Dataset, chances: FloatArray
) -> Iterator[Diagnosis]:
    truth, method = test["fault"].values, f"{job.method}, {job.twin} twin"
    for run, row, fault in zip(test["run"].values, chances, truth, strict=True):
        posterior = dict(zip(names, map(float, row), strict=True))
        yield Diagnosis(str(run), posterior, truth=str(fault), protocol=job.protocol, method=method)


def _by_model(
    robot: Robot, folder: Path, job: RivalJob, views: Sequence[xr.Dataset], view: int
) -> FloatArray:
    """Return the probabilities of a method that is not trained, (run, class)."""
    from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
    from failuretwin.decision.benchmark.baselines import KalmanBank
    from failuretwin.decision.learned.log_pool import PoolWeights, log_pool
    from failuretwin.inference.diagnoser import BayesDiagnoser

    names, known, test = class_names(robot), known_robot(robot, job.twin), views[view]
    if job.method == "hybrid":
        parts = replace(job, method="bayes", repeat=0), replace(job, method="cnn")
        files = [_answers(folder, part, VIEWS[view]) for part in parts]
        stored = [read_results(file).diagnoses for file in files]
        bayes, network = (np.array([[d.posterior[n] for n in names] for d in ds]) for ds in stored)
        return log_pool(bayes, network, PoolWeights(*HYBRID_WEIGHTS))
    if job.method == "kalman":
        bank = KalmanBank(known.twin)
        if job.twin == IMPERFECT:
            bank.known[""] = known.imperfections
        found = bank.diagnose(test.assign_attrs(hypotheses=",".join(names), individual=""))
    elif job.method == "self-calibrating":
        found = SelfCalibratingDiagnoser(robot).diagnose(test)
    else:
        found = BayesDiagnoser(known.twin, known.imperfections).diagnose(test)
    return np.array([[d.posterior[name] for name in names] for d in found])


HYBRID_WEIGHTS = (0.8, 0.2)
"""Weights of Bayes and the network in the pool; stated before any test set was scored."""


def _by_training(
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
    order = rng.permutation(len(features))
    held = round(VALIDATION_SHARE * len(order))
    learn, judge = order[held:], order[:held]
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
        batch = features[learn], classes[learn]
        if job.method in DEDICATED:
            logits = trainer.dedicated(batch)
        else:
            network = trainer.trained(batch, target[0])
            logits = partial(scores_of, network)
    if job.method == "fine-tuned":
        truth = np.array([class_names(robot).index(str(f)) for f in test["fault"].values])
        answer = trainer.fine_tuned(network, target, truth)
    else:
        answer = partial(_seen_by, logits, target)
    temperature = best_temperature(logits(features[judge]), classes[judge])
    return lambda view: np.asarray(softmax(log_softmax(answer(view), axis=1) / temperature, axis=1))


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
        from failuretwin.decision.rivals.networks import adversarial_training

        network, batches = self._new(learn, len(class_names(self.robot)))
        if self.job.method == "dann":
            steps = self.plan.iterations, RATE
            run = adversarial_training(network, batches, target, *steps, self.rng)
            deque(in_bfloat16(run), maxlen=0)
            return network
        return self._kept(network, batches)

    def _kept(self, network: Any, batches: Iterator[Batch]) -> Any:
        """Train a network once: load it if it is stored."""
        import torch

        kind = self.job.method if self.job.method in NETWORKS else "cnn"
        stored = self.folder / f"{replace(self.job, method=kind).name}.pt"
        if stored.is_file():
            network.load_state_dict(torch.load(stored, weights_only=True))
            return network
        self._run(network, batches, self.plan.iterations)
        with replacing(stored) as new:
            torch.save(network.state_dict(), new)
        return network

    def _new(self, learn: Batch, classes: int) -> tuple[Any, Iterator[Batch]]:
        """Return a network with random weights, and its batches."""
        import torch

        from failuretwin.decision.learned import networks as own
        from failuretwin.decision.learned.diagnoser import network_shape
        from failuretwin.decision.rivals import networks as other

        kind = "robust" if self.job.twin == IMPERFECT else "augmented"
        shape = network_shape(FeatureEncoder(kind, self.robot), learn[0].shape[2], classes)
        torch.manual_seed(int(self.rng.integers(2**31)))
        own_kind = self.job.method in NETWORKS
        network = other.build(self.job.method if own_kind else "cnn", shape)
        return network, own.shuffled_batches(*learn, BATCH_RUNS, self.rng)

    def _run(self, network: Any, batches: Iterator[Batch], iterations: int) -> None:
        from failuretwin.decision.learned.networks import training

        run = training(network, batches, iterations, RATE, decay=True)
        deque(in_bfloat16(run), maxlen=0)

    def dedicated(self, learn: Batch) -> Callable[[Floats], FloatArray]:
        """Return log probabilities by networks of single motors."""
        from failuretwin.decision.rivals import dedicated

        def train(batch: Batch, classes: int) -> Any:
            network, batches = self._new(batch, classes)
            self._run(network, batches, self.plan.iterations // DEDICATED[self.job.method])
            return network

        if self.job.method == "motors-3-4":
            general = self._kept(*self._new(learn, len(class_names(self.robot))))
            return dedicated.motors_3_and_4(train, learn, general)
        return getattr(dedicated, self.job.method)(train, learn)

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


# Figures of a finished study.


@dataclass(frozen=True)
class RivalScores:
    """Figures of one method over its seeds.

    Attributes:
        method: The method.
        twin: The twin that it learned from.
        protocol: Protocol letter.
        accuracy: Share of correct runs of each seed, (seed,).
        interval: Wilson 95 % interval of the first seed.
        nats: Mean log score of each seed, (seed,).
        errors: Calibration error of each seed, (seed,).
        gain: Nats a run saved by Bayes, with interval, on the first seed.
        p: Exact McNemar test against Bayes, on the first seed.
        delay_s: Median time from the onset to a first alarm that names the fault, mean over
            seeds [s]; alarms are judged at `PREFIXES_S` and at the end.
        alarms: Share of faulty runs whose first alarm names the fault, and of healthy runs with
            an alarm; means over seeds.
        training_s: Mean processor time of a training [s].
        run_ms: Mean processor time of a diagnosis [ms].
    """

    method: str
    twin: str
    protocol: str
    accuracy: tuple[float, ...]
    interval: tuple[float, float]
    nats: tuple[float, ...]
    errors: tuple[float, ...]
    gain: tuple[float, float, float]
    p: float
    delay_s: float
    alarms: tuple[float, float]
    training_s: float
    run_ms: float


def rival_scores(plan: RivalPlan, folder: Path) -> Iterator[RivalScores]:
    """Yield the figures of each method; paired tests are against Bayes with the calibration."""
    kinds: dict[tuple[str, str], list[RivalJob]] = {}
    for job in rival_jobs(plan):
        kinds.setdefault((job.method, job.twin), []).append(job)
    truths = Truths.of(load_run_set(folder / TEST))
    bayes = _answers(folder, RivalJob("bayes", IMPERFECT, 0))
    for (method, twin), jobs in kinds.items():
        found = [evaluate(_answers(folder, job)) for job in jobs]
        costs = [json.loads(_cost(folder, job).read_text("utf-8")) for job in jobs]
        against = compare(_answers(folder, jobs[0]), bayes)
        delay, named, false = np.mean([_live(folder, job, truths) for job in jobs], axis=0)
        yield RivalScores(
            method,
            twin,
            jobs[0].protocol,
            tuple(one.scores.accuracy for one in found),
            found[0].scores.interval,
            tuple(one.scores.log_score for one in found),
            tuple(math.nan if (c := e.calibration) is None else c.equal.error for e in found),
            (against.gain.mean, *against.gain.interval),
            against.split.p,
            float(delay),
            (float(named), float(false)),
            _mean(costs, "training_s"),
            _mean(costs, "run_ms"),
        )


def _live(folder: Path, job: RivalJob, truths: Truths) -> list[float]:
    """Return delay [s], named faults and false alarms [%], as the benchmark's task `live`."""
    task = TASKS["live"]
    whole, *parts = [read_results(_answers(folder, job, view)).diagnoses for view in VIEWS]
    seen = dict(zip(task.parts, parts, strict=True))
    return [score.value for score in task.score(Judgement(whole, truths, seen))]


def _mean(costs: Sequence[dict[str, float]], key: str) -> float:
    return float(np.mean([cost[key] for cost in costs]))
