"""The study in one call: take up what is there, do what is missing, write the page."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from failuretwin import __version__
from failuretwin.app.study.page import write_study_page
from failuretwin.app.study.trainings import Exam, StudyPlan, class_names, make_arrays, run_all
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.store import reason, replacing
from failuretwin.digital_model.robot import Robot

PLAN_FILE, WORK, PAGE = "study.json", "trainings", "index.html"


def check_folder(folder: Path, resume: bool) -> None:
    """Refuse a folder that this study must not write to.

    Raises:
        InputError: If it holds anything and is not to be resumed, or is to be and is no study.
    """
    taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if taken and not resume:
        raise InputError(
            f"{folder}: is there already. Go on with a study begun there (--resume), or choose "
            "another folder."
        )
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    begun = names == [WORK]  # interrupted before it had a plan
    if taken and not begun and not (folder / PLAN_FILE).is_file():
        raise InputError(f"{folder}: holds no study to resume ({PLAN_FILE} is missing).")


def run_study(
    plan: StudyPlan,
    robot: Robot,
    test: Exam,
    folder: Path,
    on_progress: Callable[[int], None],
) -> Path:
    """Do the study in a folder that `check_folder` allowed; return its page.

    Args:
        plan: What to do.
        robot: The robot.
        test: What to test on.
        folder: Where everything goes.
        on_progress: Called with the number of iterations just done.

    Raises:
        InputError: If the folder holds a study with another plan, or an extra is missing.
    """
    manifest = _manifest(plan, robot, test)
    stored = folder / PLAN_FILE
    if stored.is_file():
        _check_same(json.loads(stored.read_text(encoding="utf-8")), manifest, folder)
    else:
        _make(folder / WORK)
        make_arrays(plan, robot, test, folder / WORK)
        with replacing(stored) as partial:
            partial.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    trainings = run_all(plan, folder / WORK, len(class_names(robot)), on_progress)
    page = folder / PAGE
    write_study_page(trainings, plan, robot, test, page)
    return page


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({reason(error)}).") from error


def _manifest(plan: StudyPlan, robot: Robot, test: Exam) -> dict[str, Any]:
    """Return what decides the study's figures."""
    content = {
        "seed": plan.seed,
        "runs_per_class": plan.runs_per_class,
        "checkpoints": list(plan.checkpoints),
        "repeats": plan.repeats,
        "robot": fingerprint(robot),
        "test": test.source,
        "test_sha256": _digest(test),
    }
    return {**content, "failuretwin_version": __version__}


def _digest(test: Exam) -> str:
    """Return a hash of all that networks see of the test set, and of its truth."""
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
