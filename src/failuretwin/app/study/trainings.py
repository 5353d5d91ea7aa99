"""The study's trainings: each a job of its own, whose result is kept, several at a time."""

from __future__ import annotations

import json
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.app.study.data import load_arrays
from failuretwin.app.study.plan import BATCH_RUNS, VALIDATION_SHARE, Job, StudyPlan
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.store import replacing

LOOK_S = 0.5
"""Time between two looks at how far the trainings are [s]."""


@dataclass(frozen=True)
class Checkpoint:
    """Shares of runs that a network gets right at one point of its training.

    Attributes:
        iteration: Batches seen.
        training: On the runs it learns from.
        validation: On simulated runs it does not learn from.
        test: On the test set.
    """

    iteration: int
    training: float
    validation: float
    test: float


@dataclass(frozen=True)
class Training:
    """The result of one job.

    Attributes:
        job: What was trained.
        checkpoints: In the order of their iterations.
        confusion: Counts on the test set at the last of them, rows of (truth, diagnosis).
        seconds: Time it took [s].
    """

    job: Job
    checkpoints: tuple[Checkpoint, ...]
    confusion: tuple[tuple[int, ...], ...]
    seconds: float


def run_all(
    plan: StudyPlan, folder: Path, classes: int, on_progress: Callable[[int], None]
) -> list[Training]:
    """Do all trainings that have no result in `folder` yet; return the results of all.

    Args:
        plan: What to do.
        folder: Where the arrays are and the results go.
        classes: Number of classes.
        on_progress: Called with the number of iterations just done, those of earlier attempts
            included.
    """
    jobs = list(plan.jobs())
    missing = [job for job in jobs if not _file(folder, job).is_file()]
    on_progress((len(jobs) - len(missing)) * plan.iterations)
    if missing:
        _spread(plan, folder, classes, missing, on_progress)
    return [read_training(_file(folder, job)) for job in jobs]


def processes(jobs: int) -> int:
    """Return how many trainings run at a time: one for each core, or one on a GPU."""
    import torch

    if torch.cuda.is_available():
        return 1
    from failuretwin.decision.learned.stream import cores

    return min(jobs, cores())


def _spread(
    plan: StudyPlan,
    folder: Path,
    classes: int,
    jobs: Iterable[Job],
    on_progress: Callable[[int], None],
) -> None:
    context = multiprocessing.get_context("spawn")
    done = context.Value("q", 0)
    waiting = list(jobs)
    told = 0
    with ProcessPoolExecutor(
        processes(len(waiting)), context, initializer=_begin, initargs=(done,)
    ) as pool:
        running = {pool.submit(train, plan, folder, classes, job) for job in waiting}
        try:
            while running:
                finished, running = wait(running, LOOK_S, FIRST_COMPLETED)
                on_progress(done.value - told)
                told = done.value
                for future in finished:
                    future.result()
        except BrokenProcessPool as error:
            raise FailureTwinError(
                "a training has died. Look for what ended it, such as too little memory, and go "
                "on with --resume."
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():  # they would go on with their jobs
                process.terminate()
            raise


_done: Any = None
"""Iterations that all processes have done; set in each of them."""


def _begin(done: Any) -> None:
    global _done
    _done = done
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever gives out the jobs
    import torch

    torch.set_num_threads(1)


def _count() -> None:
    if _done is not None:
        with _done.get_lock():
            _done.value += 1


def train(plan: StudyPlan, folder: Path, classes: int, job: Job) -> None:
    """Do one training and write its result into `folder`."""
    import torch

    from failuretwin.decision.learned.networks import Shape, build_network
    from failuretwin.decision.learned.training import (
        Pace,
        Standard,
        scores_of,
        shuffled_batches,
        training,
    )

    begun = time.perf_counter()
    arrays = load_arrays(folder, job.features)
    rng = np.random.default_rng([plan.seed, job.repeat])
    order = rng.permutation(len(arrays.simulated))
    held_out = round(VALIDATION_SHARE * len(order))
    validation, learning = order[:held_out], order[held_out:]
    standard = Standard.of(arrays.simulated[learning])
    sets = {
        "training": (standard(arrays.simulated[learning]), arrays.simulated_class[learning]),
        "validation": (standard(arrays.simulated[validation]), arrays.simulated_class[validation]),
        "test": (standard(arrays.test), arrays.test_class),
    }
    torch.manual_seed(int(rng.integers(2**31)))
    network = build_network("lstm", Shape(arrays.simulated.shape[2], classes))
    batches = shuffled_batches(*sets["training"], BATCH_RUNS, rng)
    checkpoints = []
    said: IntArray = np.empty(0, dtype=np.int64)
    for iteration in training(network, batches, Pace(plan.iterations, job.learning_rate)):
        _count()
        if iteration in plan.checkpoints:
            right = {}
            for name, (features, truth) in sets.items():
                said = scores_of(network, features).argmax(axis=1)
                right[name] = float(np.mean(said == truth))
            checkpoints.append(Checkpoint(iteration, **right))
    confusion = np.zeros((classes, classes), dtype=np.int64)
    np.add.at(confusion, (arrays.test_class, said), 1)
    result = Training(
        job,
        tuple(checkpoints),
        tuple(tuple(row) for row in confusion.tolist()),
        time.perf_counter() - begun,
    )
    with replacing(_file(folder, job)) as partial:
        partial.write_text(json.dumps(asdict(result), indent=1), encoding="utf-8")


def read_training(path: Path) -> Training:
    """Return the result that a job wrote."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    return Training(
        Job(**stored["job"]),
        tuple(Checkpoint(**checkpoint) for checkpoint in stored["checkpoints"]),
        tuple(tuple(row) for row in stored["confusion"]),
        stored["seconds"],
    )


def _file(folder: Path, job: Job) -> Path:
    return folder / f"{job.name}.json"
