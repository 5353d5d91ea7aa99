"""Diagnosis that keeps up with wear: runs are diagnosed in their order, then the tracker learns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.observations import observe, session_names
from failuretwin.connection.calibration.timing import movements_of
from failuretwin.connection.wear import run_evidence
from failuretwin.connection.wear_history import History, append_history, history_path, read_history
from failuretwin.connection.wear_tracker import Step, Tracker
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.store import check_writable
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.log_quality import drop_invalid, log_quality

if TYPE_CHECKING:
    import xarray as xr

BATCH = 10
"""Runs diagnosed with the same tracked figures; the tracker learns later than that anyway."""


@dataclass(frozen=True)
class Tracked:
    """What a diagnosis with the tracker gave.

    Attributes:
        diagnoses: One for each run.
        history: The history before.
        steps: What the runs changed; runs that the history knew are not among them.
        tracker: The tracker after them.
        known: Number of runs that the history knew.
    """

    diagnoses: list[Diagnosis]
    history: History
    steps: tuple[Step, ...]
    tracker: Tracker
    known: int


def open_history(diagnoser: BayesDiagnoser, calibration: Path | None) -> History:
    """Return the history of the calibration that a diagnoser uses.

    Raises:
        InputError: If no calibration is named, or its history cannot be used.
        OutputError: If a history cannot be written beside it.
    """
    if calibration is None:
        raise InputError(
            "--track keeps its history beside the calibration: name one (--calibration FILE; "
            "`failuretwin calibrate` makes it)."
        )
    path = history_path(calibration)
    check_writable(path)
    start = Tracker.of(diagnoser.healthy_model.imperfections, diagnoser.twin.robot)
    return read_history(path, start)


def diagnose_tracked(
    runs: xr.Dataset,
    diagnoser: BayesDiagnoser,
    history: History,
    advance: Callable[[int], None] = lambda done: None,
) -> Tracked:
    """Diagnose runs in their order while the tracker follows the robot; writes nothing.

    Args:
        runs: The runs, oldest first.
        diagnoser: How to diagnose; its imperfections are those of the calibration.
        history: What the tracker has seen before.
        advance: Called with the number of runs just diagnosed.
    """
    tracker, steps, known = history.tracker, list[Step](), set(history.keys)
    seen = observe(drop_invalid(runs, log_quality(runs)))
    found: list[Diagnosis] = []
    for batch in _batches(runs):
        now = replace(diagnoser, imperfections=tracker.imperfections)
        told = now.diagnose(runs.isel(run=batch))
        said = run_evidence(seen, diagnoser.twin.robot, tracker.tracked_settling, batch)
        for diagnosis, evidence in zip(told, said, strict=True):
            if evidence.key in known:
                continue
            known.add(evidence.key)
            tracker, step = tracker.follow(evidence, _suspicion(diagnosis))
            steps.append(step)
        found += told
        advance(len(batch))
    repeated = runs.sizes["run"] - len(steps)
    return Tracked(found, history, tuple(steps), tracker, repeated)


def keep_history(tracked: Tracked) -> None:
    """Add the runs of a diagnosis to the history on disk.

    Raises:
        OutputError: If that fails; the history is as before.
    """
    if tracked.steps:
        append_history(tracked.history, tracked.steps)


def tracking_line(tracked: Tracked) -> str:
    """Return what the tracker did with the runs, in one line."""
    fates = Counter(fate for step in tracked.steps for _, fate in step.fates)
    parts = [
        f"{fates['learned']} runs learned",
        f"{fates['discarded'] + fates['frozen']} left out",
        f"{sum(run.open for run in tracked.tracker.window)} waiting",
    ]
    if tracked.known:
        parts.append(f"{tracked.known} known already")
    told = f"tracked: {', '.join(parts)}"
    if fates["learned"]:
        told += f"; {_largest_changes(tracked)}"
    if tracked.tracker.alarm:
        told += f"; learning is stopped: {tracked.tracker.alarm}"
    return f"{told}; history: {tracked.history.path}"


def _largest_changes(tracked: Tracked) -> str:
    """Return the largest changes of bias and of sag, with their deviations."""
    before, after = tracked.history.tracker, tracked.tracker
    moved = np.split(after.in_angle(after.state.mean - before.state.mean), 2)
    doubt = np.split(after.in_angle(after.state.deviation), 2)
    told = []
    for kind, change, deviation in zip(("bias", "sag"), moved, doubt, strict=True):
        worst = int(np.argmax(np.abs(change)))
        degrees, error = np.rad2deg(change[worst]), np.rad2deg(deviation[worst])
        motor = after.robot.motor_names[worst]
        told.append(f"{kind} of {motor} {degrees:+.2f} deg (deviation {error:.2f})")
    return f"largest changes: {', '.join(told)}"


def _suspicion(diagnosis: Diagnosis) -> float:
    """Return the probability that a run is faulty; NaN where there is no verdict."""
    return np.nan if diagnosis.undecided else 1.0 - diagnosis.posterior["healthy"]


def _batches(runs: xr.Dataset) -> Iterator[list[int]]:
    """Yield the runs in their order, some of one session at a time, with a movement among them."""
    sessions, moves = session_names(runs), np.asarray(movements_of(runs).exists.any(axis=1))
    moving = np.flatnonzero(moves)
    last = int(moving[-1]) if len(moving) else -1
    batch: list[int] = []
    for run, session in enumerate(sessions):
        full = len(batch) >= BATCH or (batch and sessions[batch[-1]] != session)
        if full and moves[batch].any() and run <= last:
            yield batch
            batch = []
        batch.append(run)
    yield batch
