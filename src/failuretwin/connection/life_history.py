"""The history of a robot's life: a line a run for people, and beside it what is believed now.

``CAL.history.jsonl`` holds a head, which says of which robot and prior it is, and a line a run;
``CAL.history.npz`` the state from which the next command goes on, digit for digit. The state says
how much of the lines counts, so that a writer that is killed between the two does no harm.

Section: docs/self_calibration.md#follow-the-life-of-a-robot
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.config import fingerprint
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.foreign import read_text, reading
from failuretwin.data_knowledge.readers.file_claims import check_npz
from failuretwin.data_knowledge.store import check_writable, replacing
from failuretwin.inference.together.life_filter import LifeFilter

LINES, STATE = ".history.jsonl", ".history.npz"
SIZE = "size"
"""Name in the state of how many bytes of the lines count."""


@dataclass(frozen=True)
class History:
    """What has been seen of a robot before.

    Attributes:
        life: What is believed of it.
        cold: Whether it began with nothing but what its kind is like.
        path: File of the lines; None: nothing is kept.
        size: Bytes of it that count.
        keys: Fingerprints of the runs so far.
    """

    life: LifeFilter
    cold: bool
    path: Path | None = None
    size: int = 0
    keys: tuple[str, ...] = ()


def history_path(calibration: Path) -> Path:
    """Return where the history of a calibration is kept: CAL.history.jsonl beside CAL.toml."""
    return calibration.with_suffix(LINES)


def open_history(calibration: Path, start: LifeFilter, cold: bool) -> History:
    """Return the history beside a calibration; where there is none, it begins with `start`.

    That is what is believed before any run; `cold`: what the robot's kind is like.

    Raises:
        InputError: If the history cannot be read, is damaged, or has begun with something else.
        OutputError: If a history cannot be written there.
    """
    path = history_path(calibration)
    state = path.with_suffix("").with_suffix(STATE)
    check_writable(path)
    if not (path.exists() and state.exists()):
        return History(start, cold, path)
    with reading(path, "a history", f"It is damaged: move it and {state} away."):
        content = path.read_bytes()
        check_npz(state)
        with np.load(state, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        size = int(arrays.pop(SIZE))
        if len(content) < size:
            raise InputError(f"{path}: is shorter than it was. Move it and {state} away.")
        lines = content[:size].decode().splitlines()
        rows = [_object(line, f"{path}: line {n}") for n, line in enumerate(lines, start=1)]
        _check_head(rows[0], path, start)
        return History(start.resumed(arrays), cold, path, size, tuple(r["key"] for r in rows[1:]))


def read_rows(path: Path, robot: str) -> list[dict[str, Any]]:
    """Return the lines of a robot's history, one a run, as `keep_history` was given them.

    Raises:
        InputError: If it cannot be read, is damaged, is of another robot, or holds no run.
    """
    text = read_text(path, "a history")
    rows = [_object(line, f"{path}: line {n}") for n, line in enumerate(text.splitlines(), start=1)]
    of = rows[0].get("history_of") if rows else None
    if of != robot:
        raise InputError(f"{path}: is the history of {of or 'no robot'}, expected {robot!r}.")
    if not rows[1:]:
        raise InputError(f"{path}: holds no run. Expected what `diagnose --track` keeps.")
    return rows[1:]


def keep_history(history: History, life: LifeFilter, rows: Sequence[dict[str, Any]]) -> None:
    """Add runs to the files that `history` was read from, and what is believed after them.

    Raises:
        OutputError: If that cannot be done, or the files have changed since; they are as before.
    """
    path = history.path
    if path is None or not rows:
        return
    state = path.with_suffix("").with_suffix(STATE)
    if _counted(state) != history.size:
        raise OutputError(
            f"{path}: has changed since it was read; another diagnosis tracks with the same "
            "calibration. It is as that one left it; run the command again."
        )
    lines = [start_of(history.life)] if history.size == 0 else []
    text = "".join(f"{json.dumps(line)}\n" for line in [*lines, *rows]).encode()
    before = path.read_bytes()[: history.size] if history.size else b""
    with replacing(path) as partial:
        partial.write_bytes(before + text)
    with replacing(state) as partial, partial.open("wb") as file:
        size = np.array(history.size + len(text))
        np.savez(file, allow_pickle=False, **{SIZE: size, **life.to_arrays()})


def _counted(state: Path) -> int:
    """Return how many bytes of the lines count now."""
    if not state.exists():
        return 0
    with np.load(state, allow_pickle=False) as stored:
        return int(stored[SIZE])


def start_of(life: LifeFilter) -> dict[str, Any]:
    """Return which robot, which prior and which limits a history is of."""
    given = life.begun
    known = [given.settling, given.variation, life.limits]
    return {"history_of": life.model.twin.robot.name, "calibration": fingerprint(known)}


def _check_head(head: dict[str, Any], path: Path, start: LifeFilter) -> None:
    if "history_of" not in head or "calibration" not in head:
        raise InputError(f"{path}: is no history of a calibration. Move it away.")
    if head != start_of(start):
        raise InputError(
            f"{path}: is the history of another calibration (of robot {head['history_of']!r}); the "
            "one beside it has been learned again since. Move the history away to begin a new one."
        )


def _object(line: str, where: str) -> dict[str, Any]:
    with reading(where, "JSON", "It is damaged: move the file away."):
        value = json.loads(line)
    if not isinstance(value, dict):
        raise InputError(f"{where}: is damaged (no object). Move the file away.")
    return value
