"""Diagnosis that learns as it goes: runs are judged in their order, each by those before it.

The history of a robot's life is a line a run for people, and beside it what is believed now.
``CAL.history.jsonl`` holds a head, which says of which robot and prior it is, and a line a run;
``CAL.history.npz`` the state from which the next command goes on, digit for digit. The state says
how much of the lines counts, so that a writer that is killed between the two does no harm.

Sections: docs/inference.md#lives, docs/self_calibration.md#follow-the-life-of-a-robot
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.calibration.observations import session_names
from failuretwin.connection.calibration.result import Calibration
from failuretwin.connection.population import stated_variation
from failuretwin.connection.self_calibration import (
    as_calibration,
    check_moves,
    more_when_late,
    with_timing_of,
)
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.foreign import read_text, reading
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunSet, check_motors, truths_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.readers.file_claims import check_npz
from failuretwin.data_knowledge.store import check_writable, replacing
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import (
    beside,
    hardly_rest,
    likeliest_lag,
    on_the_way,
)
from failuretwin.inference.together.life_filter import LifeFilter
from failuretwin.inference.together.mixed_runs import of_second_robot, two_robots
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

BATCH, SHARE = 10, 4
"""Runs that are judged with the same belief at most, and how many runs must have come for each:
among the first ones every run counts for the next."""
KEY_DIGITS = 16
OFFSETS = ("bias", "compliance", "friction")
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


@dataclass(frozen=True)
class Tracked:
    """What a diagnosis that learns as it goes gave.

    Attributes:
        diagnoses: One for each run.
        history: The history before.
        rows: What is kept of each run; of runs that the history knew, nothing.
        life: What is believed of the robot after them.
        known: Number of runs that the history knew.
        mixed: What tells that the runs are of two robots, a sentence; empty: nothing does.
    """

    diagnoses: list[Diagnosis]
    history: History
    rows: tuple[dict[str, Any], ...]
    life: LifeFilter
    known: int
    mixed: str


def begin(diagnoser: BayesDiagnoser, cold: bool, limits: WearLimits | None = None) -> LifeFilter:
    """Return what is believed of a robot before any run.

    That is what its calibration says, or, if it begins cold, what robots of its kind are like.

    Raises:
        InputError: If it is not said where motors settle, or no hypothesis says where they do.
    """
    given = diagnoser.healthy_model.imperfections
    if cold:
        given = generic_imperfections(diagnoser.twin.robot)
        losses = tuple(more_when_late(entry) for entry in given.lost_commands)
        given = replace(given, lost_commands=losses)
    if given.settling is None:
        raise InputError(
            f"imperfections {given.name!r} do not say where motors settle, so there is nothing to "
            "track. Give a calibration (`failuretwin calibrate`), or none to begin cold."
        )
    hypotheses = diagnoser.hypothesis_set
    if not any(has_rows(hypothesis) for hypothesis in hypotheses):
        raise InputError(
            "no hypothesis says where motors settle, so nothing can be learned. Add `healthy` or a "
            "motor that is stuck or misses its targets."
        )
    model = HealthyModel(diagnoser.twin, given)
    doubt = given.variation or Variation()
    if not doubt.bias:  # a calibration that states no doubt: a scatter of each motor, assumed
        doubt = stated_variation(wear_unit(model), model.settling, doubt)
        model = replace(model, imperfections=replace(given, variation=doubt))
    return LifeFilter.of(model, hypotheses, diagnoser.priors, limits or WearLimits())


def diagnose_tracked(
    runs: RunSet,
    diagnoser: BayesDiagnoser,
    history: History,
    advance: Progress = unseen,
) -> Tracked:
    """Diagnose runs, oldest first, each by what those before it teach; writes nothing.

    `advance` is called with the number of runs just diagnosed.

    Raises:
        InputError: If no run holds a movement, or they are of another robot.
    """
    robot = diagnoser.twin.robot
    check_motors(runs, robot.name, robot.motor_names)
    life, known = copy.deepcopy(history.life), set(history.keys)
    seen = _Seen.of(runs, diagnoser, life)
    check_moves(seen.evidence.movements)
    diagnoses: list[Diagnosis | None] = [None] * len(seen.names)
    rows: list[dict[str, Any]] = []
    mixed = ""
    for batch in _batches(runs, seen.keys, known, history.cold, life):
        told = seen.diagnose(batch, life, history.cold)
        said = zip(*life.bias_by_run(), strict=True)
        for run, diagnosis, alone in zip(batch.tolist(), told, said, strict=True):
            diagnoses[run] = diagnosis
            known.add(seen.keys[run])
            number = len(history.keys) + len(rows) + 1
            rows.append(_row(number, seen.keys[run], diagnosis, life, alone))
        mixed = mixed or _mixed(life, rows)
        advance(len(batch))
    again = [run for run, diagnosis in enumerate(diagnoses) if diagnosis is None]
    for first in range(0, len(again), BATCH):
        batch = np.array(again[first : first + BATCH])
        told = seen.diagnose(batch, copy.deepcopy(life), history.cold)
        for run, diagnosis in zip(batch.tolist(), told, strict=True):
            diagnoses[run] = diagnosis
        advance(len(batch))
    found = [diagnosis for diagnosis in diagnoses if diagnosis is not None]
    return Tracked(found, history, tuple(rows), life, len(again), mixed)


def _mixed(life: LifeFilter, rows: list[dict[str, Any]]) -> str:
    """Return that the latest runs are of two robots; empty: nothing tells so."""
    if life.window is None:
        return ""
    latest = rows[-life.window.runs :]
    sites = life.window.sites[np.arange(life.window.runs)[-len(latest) :]]
    second = of_second_robot(sites)
    return "" if second is None else two_robots(second, [row["run"] for row in latest])


def _batches(
    runs: RunSet, keys: list[str], known: set[str], cold: bool, life: LifeFilter
) -> Iterator[IntArray]:
    """Yield the runs that are new, in their order, some of one session at a time."""
    sessions, batch = session_names(runs), list[int]()
    new = [run for run, key in enumerate(keys) if key not in known and keys.index(key) == run]
    for run in new:
        most = max(1, min(BATCH, life.arrived // SHARE)) if cold else BATCH
        if batch and (len(batch) >= most or sessions[batch[-1]] != sessions[run]):
            yield np.array(batch)
            batch = []
        batch.append(run)
    if batch:
        yield np.array(batch)


def _row(
    number: int,
    key: str,
    diagnosis: Diagnosis,
    life: LifeFilter,
    alone: tuple[FloatArray, FloatArray],
) -> dict[str, Any]:
    """Return what is kept of a run: what it was taken for, what is believed after it.

    And what it says by itself of each bias, beside what was given (`LifeFilter.bias_by_run`).
    """
    faulty = None if diagnosis.undecided else 1.0 - diagnosis.posterior.get("healthy", 0.0)
    mean, deviation = life.offsets
    bias, bias_deviation = (
        [value if np.isfinite(value) else None for value in part.tolist()] for part in alone
    )
    return {
        "number": number,
        "run": diagnosis.run,
        "key": key,
        "probability_faulty": faulty,
        "alarm": life.alarm,
        **dict(zip(OFFSETS, mean.tolist(), strict=True)),
        **{f"{name}_deviation": x for name, x in zip(OFFSETS, deviation.tolist(), strict=True)},
        "bias_alone": bias,
        "bias_alone_deviation": bias_deviation,
    }


def followed_evidence(seen: Evidence, life: LifeFilter) -> SettledEvidence:
    """Return settled positions, and moments on the way of runs that hardly rest.

    A life learns from the first such run how far its tool trails the commands.
    """
    if not hardly_rest(seen.sound, life.model).any():
        return seen.sound.settled
    lag_s = life.lag_s
    if lag_s is None:
        lag_s = life.see_moving(likeliest_lag(seen.sound, life.model))
    return on_the_way(seen.sound, life.model, lag_s)


@dataclass(frozen=True)
class _Seen:
    """Some runs, ready to be judged.

    Attributes:
        runs: The runs.
        diagnoser: How to diagnose.
        seen: What they say.
        evidence: Settled positions, and moments on the way of runs that hardly rest.
    """

    runs: RunSet
    diagnoser: BayesDiagnoser
    seen: Evidence
    evidence: SettledEvidence

    @classmethod
    def of(cls, runs: RunSet, diagnoser: BayesDiagnoser, life: LifeFilter) -> _Seen:
        """Return what runs say."""
        seen = Evidence(runs, life.model.settings)
        return cls(runs, diagnoser, seen, followed_evidence(seen, life))

    @property
    def names(self) -> list[str]:
        """Names of the runs."""
        return [str(name) for name in self.runs["run"].values]

    @cached_property
    def keys(self) -> list[str]:
        """Fingerprint of each run; a run that is given twice is known by it."""
        found, settled = [], self.seen.sound.settled
        for run, name in enumerate(self.names):
            digest, there = hashlib.sha256(name.encode()), settled.movements.exists[run]
            for values in (settled.movements.target, settled.point):
                digest.update(np.ascontiguousarray(values[run][there]).tobytes())
            if self.evidence.on_the_way[run]:  # no point of it is at rest
                digest.update(np.ascontiguousarray(self.seen.readings.point[run]).tobytes())
            found.append(digest.hexdigest()[:KEY_DIGITS])
        return found

    def diagnose(self, batch: IntArray, life: LifeFilter, cold: bool) -> list[Diagnosis]:
        """Return the diagnosis of some runs by what is believed now, which then learns of them."""
        life.model = replace(life.model, imperfections=self._imperfections(batch, life, cold))
        moving = None
        if not cold and self.diagnoser.uses_transients:
            counts = self.diagnoser.transient_mask(self.evidence.usable)
            moving = beside(self.seen.sound.transient, self.evidence).where(counts)[batch]
        posterior = life.follow(self.evidence[batch], moving)
        truth, quality = truths_of(self.runs), self.seen.quality
        return [
            posterior.to_diagnosis(at, self.names[run], quality[run], truth[run])
            for at, run in enumerate(batch.tolist())
        ]

    def _imperfections(self, batch: IntArray, life: LifeFilter, cold: bool) -> Imperfections:
        """Return what was believed at the beginning, with the timing that the commands tell."""
        now = life.model.imperfections
        if life.arrived > 0 and now.protocol != "P1":
            now = replace(now, name=f"{now.name}, tracked", protocol="P1")
        if not cold or life.lag_s is not None:
            return now
        movements = life.joined_evidence(self.evidence[batch]).movements
        return with_timing_of(now, movements, self.diagnoser.twin.robot)


def calibration_of(life: LifeFilter, runs: RunSet) -> Calibration:
    """Return what a life has taught by its latest runs, as a calibration that anybody may use."""
    robot, found = life.model.twin.robot, life.told
    told = as_calibration(found, life.begun, robot, runs)
    source = f"{life.arrived} runs without labels; {life.begun.name}"
    known = replace(told.imperfections, source=source)
    return replace(told, imperfections=known, runs=life.arrived, movements=life.movements)


# The files of a history.


def history_path(calibration: Path) -> Path:
    """Return where the history of a calibration is kept: CAL.history.jsonl beside CAL.toml."""
    return calibration.with_suffix(LINES)


def open_history(calibration: Path, start: LifeFilter, cold: bool) -> History:
    """Return the history beside a calibration; where there is none, it begins with `start`.

    `start` is the belief before any run; a cold one is what robots of its kind are like.

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
        life = _resumed(start, arrays, path, state)
        return History(life, cold, path, size, tuple(r["key"] for r in rows[1:]))


def _resumed(
    start: LifeFilter, arrays: Mapping[str, FloatArray], path: Path, state: Path
) -> LifeFilter:
    """Return what was believed when `state` was kept; a part that is missing is one that is new."""
    try:
        return start.resumed(arrays)
    except KeyError as error:
        raise InputError(
            f"{state}: has no {error.args[0]!r}; another version of failuretwin kept it. Move it "
            f"and {path} away to begin a new history."
        ) from error


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
