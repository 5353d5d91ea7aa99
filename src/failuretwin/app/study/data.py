"""The study's runs as features: simulated by the published twin, and a test set beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.study.plan import FEATURES, StudyPlan
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.runs import check_motors, truth_of
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.generation import simulate
from failuretwin.data_knowledge.plan import Plan
from failuretwin.data_knowledge.reading import ReadOptions, read_runs
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.learned.encoder import Encoder, Floats
from failuretwin.decision.learned.signals import signals_of
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Exam:
    """Runs that networks are tested on.

    Attributes:
        runs: The run set.
        real: Whether they come from a log, not from the physics engine.
        source: What they are, in words.
    """

    runs: xr.Dataset
    real: bool
    source: str


@dataclass(frozen=True)
class Arrays:
    """Features and classes of the simulated runs and of the test set, by feature set.

    Attributes:
        simulated: (run, point, channel).
        simulated_class: (run,).
        test: (run, point, channel).
        test_class: (run,).
    """

    simulated: Floats
    simulated_class: IntArray
    test: Floats
    test_class: IntArray


def class_names(robot: Robot) -> list[str]:
    """Return the paper's classes in the order of its labels."""
    return [str(hypothesis) for hypothesis in paper_hypotheses(robot.motor_names)]


def real_test_set(path: Path, robot: Robot, published_labels: bool) -> Exam:
    """Read a test set as the authors processed theirs: readings drawn out by straight lines.

    Raises:
        InputError: If it cannot be read or its truth is not known or not one of the classes.
    """
    runs = read_runs(path, robot, ReadOptions("published", published_labels))
    check_motors(runs, robot.name, robot.motor_names)
    truth = truth_of(runs)
    if truth is None:
        raise InputError(
            f"{path}: the truth of its runs is not known, so nothing can be tested on them. Give a "
            "run set with `fault`, or raw sessions whose folders end in _label_K with "
            "--published-labels."
        )
    strange = sorted(set(truth) - set(class_names(robot)))
    if strange:
        raise InputError(
            f"{path}: runs of {', '.join(strange)} are no class of the study. Expected "
            f"{', '.join(class_names(robot))}."
        )
    return Exam(runs, real=True, source=f"{runs.sizes['run']} runs of {path}")


def stand_in_test_set(plan: StudyPlan, robot: Robot) -> Exam:
    """Simulate a test set with the physics engine, for want of a real one."""
    hypotheses = paper_hypotheses(robot.motor_names)
    count = plan.stand_in_runs
    runs = simulate(Plan(robot, hypotheses, count, plan.seed + 1, engine="physics"))
    return Exam(
        runs,
        real=False,
        source=f"{len(hypotheses) * count} runs of the physics engine, which stands in for a robot",
    )


def make_arrays(plan: StudyPlan, robot: Robot, test: Exam, folder: Path) -> None:
    """Simulate the training data and write a file of arrays for each feature set into `folder`."""
    names = class_names(robot)
    simulated = simulate(
        Plan(robot, paper_hypotheses(robot.motor_names), plan.runs_per_class, plan.seed)
    )
    for features in FEATURES:
        encoder = Encoder(features, robot)
        with replacing(_file(folder, features)) as partial, partial.open("wb") as file:
            np.savez(
                file,
                simulated=encoder.encode(signals_of(simulated)),
                simulated_class=_classes(simulated, names),
                test=encoder.encode(signals_of(test.runs)),
                test_class=_classes(test.runs, names),
            )


def load_arrays(folder: Path, features: str) -> Arrays:
    """Return what `make_arrays` wrote."""
    with np.load(_file(folder, features), allow_pickle=False) as stored:
        return Arrays(**stored)


def _file(folder: Path, features: str) -> Path:
    return folder / f"{features}.npz"


def _classes(runs: xr.Dataset, names: list[str]) -> IntArray:
    return np.array([names.index(fault) for fault in truth_of(runs) or []], dtype=np.int64)
