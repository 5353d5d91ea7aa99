"""Diagnosis that keeps up with wear: runs are diagnosed in their order, then the tracker learns."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.connection.calibration.observations import observe, session_names
from failuretwin.connection.calibration.timing_fit import movements_of
from failuretwin.connection.wear import RunEvidence, WearState, run_evidence
from failuretwin.connection.wear_tracker import DELAY, PendingRun, Step, Tracker
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.foreign import reading
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray, as_floats
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


def open_history(diagnoser: BayesDiagnoser, calibration: Path) -> History:
    """Return the history of a calibration.

    Args:
        diagnoser: A diagnoser that uses the calibration.
        calibration: Its file, beside which the history is kept.

    Raises:
        InputError: If the history cannot be used.
        OutputError: If a history cannot be written there.
    """
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
            tracker, step = tracker.follow(evidence, _fault_probability(diagnosis))
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


def _fault_probability(diagnosis: Diagnosis) -> float:
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


# The tracker's history beside the calibration: a line a run, from which it goes on exactly.

# Steps of the tracker as lines of JSON. Floats keep all their digits, so nothing is lost.


def row_of(step: Step) -> dict[str, Any]:
    """Return a step as a JSON object."""
    bias, compliance = np.split(step.state.mean, 2)
    bias_deviation, compliance_deviation = np.split(step.state.deviation, 2)
    below = np.tril_indices(len(step.state.mean))
    return {
        "number": step.number,
        "run": step.evidence.run,
        "key": step.evidence.key,
        "probability_faulty": None if np.isnan(step.fault_probability) else step.fault_probability,
        "level": step.cusum,
        "alarm": step.alarm,
        "fates": [list(outcome) for outcome in step.outcomes],
        "learned_at": step.learned_at,
        "bias": bias.tolist(),
        "bias_deviation": bias_deviation.tolist(),
        "compliance": compliance.tolist(),
        "compliance_deviation": compliance_deviation.tolist(),
        "covariance": step.state.covariance[below].tolist(),
        "error": step.evidence.error.tolist(),
        "design": step.evidence.design.tolist(),
    }


def step_of(line: str, where: str) -> Step:
    """Return the step that a line holds.

    Args:
        line: JSON as `row_of` gives it.
        where: What to call it in an error.

    Raises:
        InputError: If it is no such line.
    """
    row = parse_line(line, where)
    try:
        mean = as_floats([*row["bias"], *row["compliance"]])
        error, design = _evidence(row, len(mean))
        chance = row["probability_faulty"]
        return Step(
            number=int(row["number"]),
            evidence=RunEvidence(str(row["run"]), str(row["key"]), error, design),
            fault_probability=float("nan") if chance is None else float(chance),
            cusum=float(row["level"]),
            alarm=str(row["alarm"]),
            outcomes=tuple((int(number), outcome) for number, outcome in row["fates"]),
            learned_at=int(row["learned_at"]),
            state=WearState(mean, _symmetric(as_floats(row["covariance"]), len(mean))),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is damaged ({error}). Move the file away.") from error


def _evidence(row: dict[str, Any], size: int) -> tuple[FloatArray, FloatArray]:
    """Return error and design of a row, with their axes also where a run says nothing."""
    error = as_floats(row["error"])
    if error.size == 0:
        error = np.zeros((0, 1))
    return error, as_floats(row["design"]).reshape(*error.shape, size)


def _symmetric(below: FloatArray, size: int) -> FloatArray:
    """Return the symmetric matrix of a lower triangle."""
    matrix, (row, column) = np.empty((size, size)), np.tril_indices(size)
    matrix[row, column] = matrix[column, row] = below
    return matrix


def parse_line(line: str, where: str) -> dict[str, Any]:
    """Return the JSON object of a line.

    Raises:
        InputError: If it is none.
    """
    with reading(where, "JSON", DAMAGED):
        value = json.loads(line)
    if not isinstance(value, dict):
        raise InputError(f"{where}: is damaged (no object). Move the file away.")
    return value


SUFFIX = ".history.jsonl"
DAMAGED = "It is damaged: move the file away."


@dataclass(frozen=True)
class History:
    """What a history file holds.

    Attributes:
        path: The file; it need not exist.
        size: Bytes of it that count; an unfinished last line does not.
        steps: The runs so far.
        tracker: The tracker after them.
    """

    path: Path
    size: int
    steps: tuple[Step, ...]
    tracker: Tracker

    @property
    def keys(self) -> frozenset[str]:
        """Fingerprints of the runs so far."""
        return frozenset(step.evidence.key for step in self.steps)


def history_path(calibration: Path) -> Path:
    """Return where the history of a calibration is kept: CAL.history.jsonl beside CAL.toml."""
    return calibration.with_suffix(SUFFIX)


def read_history(path: Path, start: Tracker) -> History:
    """Read a history; where there is none, it begins with `start`.

    Args:
        path: The file.
        start: The tracker of the calibration that the history belongs to.

    Raises:
        InputError: If the file cannot be read, is damaged, or belongs to another calibration.
    """
    with reading(path, "a history", DAMAGED):
        content = path.read_bytes() if path.exists() else b""
        size = content.rfind(b"\n") + 1
        head, *lines = content[:size].decode("utf-8", errors="replace").splitlines() or [""]
        if not head:
            return History(path, 0, (), start)
        _check_head(head, path, start)
        steps = tuple(step_of(line, f"{path}: line {n}") for n, line in enumerate(lines, start=2))
        return History(path, size, steps, _resumed(start, steps))


def append_history(history: History, steps: Sequence[Step]) -> None:
    """Add runs to the file that `history` was read from.

    Raises:
        OutputError: If that cannot be done, or the file has changed since; it is as before.
    """
    lines = [json.dumps(row_of(step)) for step in steps]
    if history.size == 0:
        lines.insert(0, json.dumps(_head(history.tracker)))
    text = "".join(f"{line}\n" for line in lines).encode()
    try:
        descriptor = os.open(history.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _append(descriptor, text, history)
        finally:
            os.close(descriptor)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(
            f"{history.path}: could not be written ({error.strerror}). It is as before; free some "
            "space or make its folder writable."
        ) from error


def _append(descriptor: int, text: bytes, history: History) -> None:
    beyond = os.fstat(descriptor).st_size - history.size
    if beyond < 0 or b"\n" in os.pread(descriptor, beyond, history.size):
        raise OutputError(
            f"{history.path}: has changed since it was read; another diagnosis tracks with the "
            "same calibration. It is as that one left it; run the command again."
        )
    os.ftruncate(descriptor, history.size)
    os.lseek(descriptor, history.size, os.SEEK_SET)
    try:
        written = 0
        while written < len(text):
            written += os.write(descriptor, text[written:])
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, history.size)
        raise


def _head(tracker: Tracker) -> dict[str, Any]:
    """Return the first line: which calibration and which limits the history is of."""
    known = (tracker.settling, tracker.calibration.variation, tracker.limits)
    return {"history_of": tracker.robot.name, "calibration": fingerprint(list(known))}


def _check_head(line: str, path: Path, start: Tracker) -> None:
    head, expected = parse_line(line, f"{path}: line 1"), _head(start)
    if "history_of" not in head or "calibration" not in head:
        raise InputError(f"{path}: is no history of a calibration. Move it away.")
    if head != expected:
        raise InputError(
            f"{path}: is the history of another calibration (of robot {head['history_of']!r}); the "
            "one beside it has been learned again since. Move the history away to begin a new one."
        )


def _resumed(start: Tracker, steps: Sequence[Step]) -> Tracker:
    """Return the tracker after the steps."""
    if not steps:
        return start
    last = steps[-1]
    decided = {number for step in steps[-DELAY:] for number, _ in step.outcomes}
    snapshots = [step.state for step in steps if step.number % DELAY == 0]
    return replace(
        start,
        state=last.state,
        window=tuple(
            PendingRun(step.number, step.evidence, step.number not in decided)
            for step in steps[-DELAY:]
        ),
        past=tuple(snapshots[-(start.limits.horizon // DELAY) :]),
        cusum=last.cusum,
        arrived=last.number,
        learned_at=last.learned_at,
        alarm=last.alarm,
    )
