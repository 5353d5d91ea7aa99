"""The paper's study: simulate, train each network, keep every result, resume after interruption.

Networks are trained on runs of the published twin alone and tested on real runs.
"""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from failuretwin import __version__
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import FailureTwinError, InputError, OutputError, counted, reason
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.progress import Progress
from failuretwin.core.runs import check_motors, truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
from failuretwin.data_knowledge.store import SUFFIXES, replacing, write_text
from failuretwin.decision.evaluation import Truths
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, signals_of
from failuretwin.decision.scoring import class_ratios
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.data_knowledge.readers.raw_sessions import As

J = TypeVar("J")
PLAN_FILE, WORK = "study.json", "trainings"

# Plan of the study.

FEATURES = ("original", "augmented")
"""The paper's two feature sets."""
RATES = REPRODUCING_RATE, PRINTED_RATE = 1e-3, 1e-4
"""Learning rates: the one that reproduces the paper's Table II, and the one that it prints."""
BATCH_RUNS = 32
VALIDATION_SHARE = 0.1


@dataclass(frozen=True)
class Job:
    """One training; each `repeat`, from 0, has its own split and initial weights."""

    features: str
    learning_rate: float
    repeat: int

    @property
    def name(self) -> str:
        """Name of its result file, without suffix."""
        return f"{self.features}-{self.learning_rate:g}-{self.repeat}"


@dataclass(frozen=True)
class StudyPlan:
    """Sizes of the study; the defaults are the paper's.

    Attributes:
        seed: Random seed.
        runs_per_class: Simulated runs of each of the nine classes.
        checkpoints: Iterations at which accuracies are measured within one training. The paper
            calls them epochs; its figures fit iterations, of which an epoch has 101.
        repeats: Repetitions of each training.
        stand_in_runs: Runs per class of the stand-in test set by the physics engine.
    """

    seed: int = 0
    runs_per_class: int = 400
    checkpoints: tuple[int, ...] = (1010, 2020, 3030, 4040, 5050)
    repeats: int = 5
    stand_in_runs: int = 100

    def jobs(self) -> list[Job]:
        """Return all trainings, the most informative ones first."""
        kinds = [(rate, features) for rate in RATES for features in reversed(FEATURES)]
        return [Job(f, rate, repeat) for repeat in range(self.repeats) for rate, f in kinds]

    @property
    def iterations(self) -> int:
        """Iterations of one training."""
        return self.checkpoints[-1]


def quick_plan(seed: int) -> StudyPlan:
    """Return a small study of about two minutes."""
    return StudyPlan(seed, 60, (50, 100, 150, 200, 250), 2, 20)


# Test set and training data.


@dataclass(frozen=True)
class Exam:
    """Test set: recorded runs (`real`) or simulated ones, with a description of their source."""

    runs: xr.Dataset
    real: bool
    source: str


def class_names(robot: Robot) -> list[str]:
    """Return the paper's classes in the order of its labels."""
    return [str(hypothesis) for hypothesis in paper_hypotheses(robot.motor_names)]


def given_test_set(path: Path, robot: Robot, published_labels: bool, how: As = "published") -> Exam:
    """Read a test set; `published`: interpolated readings, as the authors processed theirs."""
    if published_labels and path.suffix in SUFFIXES:
        raise InputError(
            f"{path}: is a run set, which has its labels already; --published-labels is for raw "
            "sessions. Leave it out, or `failuretwin import` the sessions with it."
        )
    runs = read_runs(path, robot, ReadOptions(how, published_labels))
    check_motors(runs, robot.name, robot.motor_names)
    truth = {known.fault for known in Truths.of(runs, str(path)).by_run.values()}
    strange = sorted(truth - set(class_names(robot)))
    if strange:
        raise InputError(
            f"{path}: runs of {', '.join(strange)} are no class of the study. Expected "
            f"{', '.join(class_names(robot))}."
        )
    simulated = str(runs.attrs.get("source", "")).startswith("simulated")
    kind = "simulated run" if simulated else "run"
    return Exam(runs, not simulated, f"{counted(runs.sizes['run'], kind)} of {path}")


def stand_in_test_set(plan: StudyPlan, robot: Robot) -> Exam:
    """Simulate a test set with the physics engine."""
    hypotheses = paper_hypotheses(robot.motor_names)
    runs = simulate(Plan(robot, hypotheses, plan.stand_in_runs, plan.seed + 1, engine="physics"))
    source = f"{runs.sizes['run']} runs of the physics engine, which stands in for a robot"
    return Exam(runs, real=False, source=source)


def make_arrays(plan: StudyPlan, robot: Robot, test: Exam, folder: Path) -> None:
    """Simulate the training runs and write one file of arrays per feature set into `folder`."""
    names = class_names(robot)
    simulated = simulate(
        Plan(robot, paper_hypotheses(robot.motor_names), plan.runs_per_class, plan.seed)
    )
    for features in FEATURES:
        encoder = FeatureEncoder(features, robot)
        arrays: dict[str, Any] = {}
        for name, runs in (("simulated", simulated), ("test", test.runs)):
            arrays[name] = encoder.encode(signals_of(runs))
            arrays[f"{name}_class"] = [names.index(fault) for fault in truth_of(runs) or []]
        with replacing(folder / f"{features}.npz") as new, new.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)


# Trainings, each in a process of its own.


@dataclass(frozen=True)
class Training:
    """Result of one job.

    Attributes:
        accuracies: Accuracy at each checkpoint on the `training`, `validation` and `test` runs.
        confusion: Counts on the test set at the last checkpoint, rows of (truth, diagnosis).
        seconds: Duration [s].
    """

    job: Job
    accuracies: dict[str, tuple[float, ...]]
    confusion: tuple[tuple[int, ...], ...]
    seconds: float


def run_all(plan: StudyPlan, folder: Path, classes: int, on_progress: Progress) -> list[Training]:
    """Run the trainings without a result in `folder`; return all results.

    `on_progress` receives numbers of finished trainings, including those of earlier attempts.
    """
    jobs = plan.jobs()
    missing = [job for job in jobs if not _file(folder, job).is_file()]
    on_progress(len(jobs) - len(missing))
    if missing:
        spread(partial(train, plan, folder, classes), missing, on_progress)
    files = [_file(folder, job) for job in jobs]
    return [from_table(Training, json.loads(f.read_text(encoding="utf-8")), str(f)) for f in files]


def spread(work: Callable[[J], None], jobs: Sequence[J], on_progress: Progress) -> None:
    """Run jobs in processes of their own, one per core at a time."""
    import torch

    at_a_time = 1 if torch.cuda.is_available() else min(len(jobs), os.cpu_count() or 1)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(at_a_time, context, initializer=_start) as pool:
        try:
            for future in as_completed([pool.submit(work, job) for job in jobs]):
                future.result()
                on_progress(1)
        except BrokenProcessPool as error:
            raise FailureTwinError(
                "a training has died. Look for what ended it, such as too little memory, and go "
                "on with --resume."
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    import torch

    torch.set_num_threads(1)


def in_bfloat16(steps: Iterator[int]) -> Iterator[int]:
    """Yield the steps of a training whose matrix products are in bfloat16.

    Where the processor has no units for these products (AMX), they stay in single precision.
    """
    import torch

    native = torch.cpu.get_capabilities().get("amx_bf16", False)
    while True:
        with torch.autocast("cpu", torch.bfloat16, enabled=native):
            step = next(steps, None)
        if step is None:
            return
        yield step


def train(plan: StudyPlan, folder: Path, classes: int, job: Job) -> None:
    """Run one training and write its result into `folder`."""
    import torch

    from failuretwin.decision.learned import networks

    start = time.perf_counter()
    rng = np.random.default_rng([plan.seed, job.repeat])
    sets = _standardised_sets(folder / f"{job.features}.npz", rng)
    channels = sets["test"][0].shape[2]
    torch.manual_seed(int(rng.integers(2**31)))
    network = networks.build_network("lstm", channels, classes)
    batches = networks.shuffled_batches(*sets["training"], BATCH_RUNS, rng)
    accuracies: dict[str, tuple[float, ...]] = dict.fromkeys(sets, ())
    confusion = np.zeros((classes, classes), dtype=np.int64)
    steps = networks.training(network, batches, plan.iterations, job.learning_rate)
    for iteration in in_bfloat16(steps):
        if iteration in plan.checkpoints:
            for name, (features, truth) in sets.items():
                diagnosis = networks.scores_of(network, features).argmax(axis=1)
                accuracies[name] += (float(np.mean(diagnosis == truth)),)
            confusion[:] = 0  # of the test set, which is the last
            np.add.at(confusion, (truth, diagnosis), 1)
    counts = tuple(map(tuple, confusion.tolist()))
    result = Training(job, accuracies, counts, time.perf_counter() - start)
    write_text(json.dumps(asdict(result), indent=1), _file(folder, job))


def _standardised_sets(path: Path, rng: np.random.Generator) -> dict[str, tuple[Any, Any]]:
    """Return features and classes of the `training`, `validation` and `test` runs."""
    from failuretwin.decision.learned.networks import Standard

    with np.load(path, allow_pickle=False) as stored:
        simulated, truth = stored["simulated"], stored["simulated_class"]
        test = stored["test"], stored["test_class"]
    validation, learning = held_out(len(simulated), rng)
    standard = Standard.of(simulated[learning])
    return {
        "training": (standard(simulated[learning]), truth[learning]),
        "validation": (standard(simulated[validation]), truth[validation]),
        "test": (standard(test[0]), test[1]),
    }


def held_out(runs: int, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Return which runs are held out for validation, and which are learned from."""
    order = rng.permutation(runs)
    held = round(VALIDATION_SHARE * runs)
    return order[:held], order[held:]


def _file(folder: Path, job: Job) -> Path:
    return folder / f"{job.name}.json"


# Statistics over repetitions.


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over repetitions; NaN where undefined."""

    mean: float
    deviation: float


def of_kind(trainings: Sequence[Training], features: str, rate: float) -> list[Training]:
    """Return the repetitions with these features and this learning rate."""
    return [t for t in trainings if (t.job.features, t.job.learning_rate) == (features, rate)]


def spread_of(values: Sequence[float] | FloatArray) -> Spread:
    """Return mean and sample standard deviation; NaN if any value is NaN, as in the paper."""
    array = np.asarray(values, dtype=np.float64)
    deviation = float(array.std(ddof=1)) if len(array) > 1 else math.nan
    return Spread(float(array.mean()), deviation)


def accuracies(repeats: Sequence[Training], name: str) -> list[Spread]:
    """Return the accuracy on the `training`, `validation` or `test` runs at each checkpoint."""
    rows = np.array([training.accuracies[name] for training in repeats])
    return [spread_of(column) for column in rows.T]


def ratio_spreads(repeats: Sequence[Training]) -> list[tuple[Spread, ...]]:
    """Return precision, recall and F1 of each class on the test set.

    Precision and F1 are NaN in a repetition that never predicts the class, as in the paper.
    """
    ratios = class_ratios(np.array([training.confusion for training in repeats]))
    ratios[np.isnan(ratios[..., 0]), 2] = np.nan  # (repeat, class, ratio)
    return [tuple(spread_of(column) for column in rows.T) for rows in np.moveaxis(ratios, 1, 0)]


def mean_confusion(repeats: Sequence[Training]) -> FloatArray:
    """Return the row-normalised confusion matrix on the test set, (truth, diagnosis).

    Rows of classes missing from the test set are NaN.
    """
    total = np.sum([training.confusion for training in repeats], axis=0).astype(np.float64)
    with np.errstate(invalid="ignore"):
        return total / total.sum(axis=1, keepdims=True)


# The study in one call.


def check_folder(folder: Path, resume: bool) -> None:
    """Check that the study may write to `folder`."""
    taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if taken and not resume:
        raise InputError(
            f"{folder}: is there already. Go on with a study begun there (--resume), or choose "
            "another folder."
        )
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    without_plan = names == [WORK]  # interrupted before the plan was written
    if taken and not without_plan and not (folder / PLAN_FILE).is_file():
        raise InputError(f"{folder}: holds no study to resume ({PLAN_FILE} is missing).")


def run_study(
    plan: StudyPlan, robot: Robot, test: Exam, folder: Path, on_progress: Progress
) -> list[Training]:
    """Run what is missing of a study in a folder that `check_folder` accepted."""
    begin(plan, robot, test, folder, make_arrays)
    return run_all(plan, folder / WORK, len(class_names(robot)), on_progress)


P = TypeVar("P", bound=Any)
"""A plan: a dataclass of plain values."""


def begin(
    plan: P,
    robot: Robot,
    test: Exam,
    folder: Path,
    make: Callable[[P, Robot, Exam, Path], None],
) -> None:
    """Make the data of a study, or check that the one begun in `folder` is the same."""
    manifest = _manifest(plan, robot, test)
    stored = folder / PLAN_FILE
    if stored.is_file():
        _check_same(json.loads(stored.read_text(encoding="utf-8")), manifest, folder)
        return
    try:
        (folder / WORK).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({reason(error)}).") from error
    make(plan, robot, test, folder / WORK)
    write_text(json.dumps(manifest, indent=1), stored)


def _manifest(plan: Any, robot: Robot, test: Exam) -> dict[str, Any]:
    """Return everything that determines the figures of the study."""
    return {
        **json.loads(json.dumps(asdict(plan))),
        "robot": fingerprint(robot),
        "test": test.source,
        "test_sha256": _digest(test),
        "failuretwin_version": __version__,
    }


def _digest(test: Exam) -> str:
    """Return a hash of the commands, readings and truth of the test set."""
    digest = hashlib.sha256(json.dumps([str(f) for f in test.runs["fault"].values]).encode())
    for name in ("command", "measured"):
        digest.update(test.runs[name].values.tobytes())
    return digest.hexdigest()


def _check_same(stored: dict[str, Any], wanted: dict[str, Any], folder: Path) -> None:
    for key, value in wanted.items():
        if stored.get(key) != value:
            raise InputError(
                f"{folder}: the study begun there has {key} {stored.get(key)!r}, this one "
                f"{value!r}. Give the same arguments again, or choose another folder."
            )
