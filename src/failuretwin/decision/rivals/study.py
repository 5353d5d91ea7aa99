"""The study of rivals: every method on the same training runs, the same test runs, five seeds.

Each job writes its diagnoses to a file of its own, so an interrupted study goes on.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.progress import Progress
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import load_run_set, replacing, save_run_set, write_text
from failuretwin.decision.benchmark.tasks import PREFIXES_S, TASKS, Judgement, diagnoses_of
from failuretwin.decision.evaluation import Truths, compare, evaluate
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, signals_of
from failuretwin.decision.learned.paper_study import (
    WORK,
    Exam,
    begin,
    class_names,
    spread,
)
from failuretwin.decision.results import read_results, write_json_lines
from failuretwin.decision.rivals.training import (
    IMPERFECT,
    LATE,
    LEARNT,
    MODELS,
    OWN,
    PUBLISHED,
    Answer,
    RivalJob,
    RivalPlan,
    by_own_network,
    by_training,
    rival_jobs,
)
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    import xarray as xr

ANSWERS, TEST = "answers", "test.nc"
WIDER = 2.0
"""Factor on the calibration's variation between robots in training runs: other days and tools
differ more than it states."""
VIEWS = ("", *(f"_{end:g}s" for end in PREFIXES_S))
"""Suffixes of files: the whole runs, and what is seen of them at three earlier times."""


def known_robot(robot: Robot, twin: str) -> CalibratedRobot:
    """Return the robot with what a method knows of it; the published twin knows its class."""
    if twin == PUBLISHED:
        return CalibratedRobot(robot, generic_imperfections(robot))
    return load_calibration(None, robot)


# Training runs and features, made once.


def make_rival_data(plan: RivalPlan, robot: Robot, exam: Exam, folder: Path) -> None:
    """Write the arrays of both twins and the test runs into `folder`."""
    from failuretwin.decision.training_data import PopulationData

    names, modes = class_names(robot), {n: MODES[n] for n in ("stuck", "steady_state_error")}
    published = simulate(Plan(robot, names, plan.runs_per_class, plan.seed))
    known = known_robot(robot, IMPERFECT)
    data = PopulationData((known,), modes, plan.seed, widening=(WIDER,))
    imperfect = data.run_set(0, plan.runs_per_class * len(names))
    save_run_set(imperfect, folder / LEARNT)
    made = {
        PUBLISHED: (FeatureEncoder("augmented", robot), published),
        IMPERFECT: (FeatureEncoder("robust", robot, known.imperfections), imperfect),
    }
    for twin, (coder, runs) in made.items():
        with replacing(folder / f"{twin}.npz") as new, new.open("wb") as file:
            features = coder.encode(signals_of(runs))
            classes = np.array([names.index(str(fault)) for fault in runs["fault"].values])
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


def run_rivals(plan: RivalPlan, robot: Robot, exam: Exam, out: Path, on_progress: Progress) -> None:
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
    if job.method == OWN:
        answer = by_own_network(plan, known_robot(robot, job.twin), folder, job, views_of(test))
    elif job.method not in MODELS:
        answer = by_training(plan, robot, folder, job, test)
    trained = time.process_time()
    chances = [answer(0)]
    seconds = time.process_time() - trained
    chances += [answer(view) for view in range(1, len(VIEWS))]
    names = class_names(robot)
    for suffix, rows in zip(VIEWS, chances, strict=True):
        found = diagnoses_of(test, names, rows.tolist())
        write_json_lines(_stated(found, job, test), _answers(folder, job, suffix))
    cost = {"training_s": trained - start, "run_ms": 1e3 * seconds / len(test["run"])}
    write_text(json.dumps(cost), _cost(folder, job))


def _answers(folder: Path, job: RivalJob, suffix: str = "") -> Path:
    return folder / ANSWERS / f"{job.name}{suffix}.jsonl"


def _cost(folder: Path, job: RivalJob) -> Path:
    """Return the file of costs, which is written when a job is done."""
    return folder / ANSWERS / f"{job.name}.json"


def _stated(found: Sequence[Diagnosis], job: RivalJob, test: xr.Dataset) -> list[Diagnosis]:
    """Return diagnoses with what was true and which job made them."""
    of: dict[str, Any] = {"protocol": job.protocol, "method": f"{job.method}, {job.twin} twin"}
    faults = test["fault"].values
    return [replace(one, truth=str(f), **of) for one, f in zip(found, faults, strict=True)]


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
        parts = replace(job, method="bayes", repeat=0), replace(job, method=OWN)
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
            seeds [s]; NaN: none names it. Alarms are judged at `PREFIXES_S` and at the end.
        alarms: Share of faulty runs whose first alarm names the fault, and of healthy runs with
            an alarm [%]; means over seeds.
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
        live = np.array([_live(folder, job, truths) for job in jobs])
        delays = live[np.isfinite(live[:, 0]), 0]
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
            float(delays.mean()) if len(delays) else math.nan,
            (float(live[:, 1].mean()), float(live[:, 2].mean())),
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
