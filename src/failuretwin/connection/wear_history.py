"""The tracker's history beside the calibration: a line a run, from which it goes on exactly.

Lines are only ever added, many at a time and in one write. Each holds all that is needed to go on
from it, so whatever a killed writer leaves behind is a shorter history.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.wear import RunEvidence, WearState
from failuretwin.connection.wear_tracker import DELAY, Step, Tracker, Waiting
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.types import FloatArray, as_floats

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
        "level": step.level,
        "alarm": step.alarm,
        "fates": [list(fate) for fate in step.fates],
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
            level=float(row["level"]),
            alarm=str(row["alarm"]),
            fates=tuple((int(number), fate) for number, fate in row["fates"]),
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
    try:
        value = json.loads(line)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: is damaged ({error}). Move the file away.") from error
    if not isinstance(value, dict):
        raise InputError(f"{where}: is damaged (no object). Move the file away.")
    return value


SUFFIX = ".history.jsonl"


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
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}).") from error
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
    decided = {number for step in steps[-DELAY:] for number, _ in step.fates}
    snapshots = [step.state for step in steps if step.number % DELAY == 0]
    return replace(
        start,
        state=last.state,
        window=tuple(
            Waiting(step.number, step.evidence, step.number not in decided)
            for step in steps[-DELAY:]
        ),
        past=tuple(snapshots[-(start.limits.horizon // DELAY) :]),
        level=last.level,
        arrived=last.number,
        learned_at=last.learned_at,
        alarm=last.alarm,
    )
