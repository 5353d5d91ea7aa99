"""Diagnosis that learns as it goes: runs are judged in their order, each by those before it.

Section: docs/inference.md#lives
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.connection.calibration.observations import session_names
from failuretwin.connection.calibration.result import Calibration
from failuretwin.connection.life_history import History
from failuretwin.connection.population import stated_variation
from failuretwin.connection.self_calibration import (
    as_calibration,
    check_moves,
    more_when_late,
    with_timing_of,
)
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.runs import check_motors, truths_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.life_filter import LifeFilter
from failuretwin.inference.together.mixed_runs import of_second_robot, two_robots
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

if TYPE_CHECKING:
    import xarray as xr

BATCH, SHARE = 10, 4
"""Runs that are judged with the same belief at most, and how many runs must have come for each:
among the first ones every run counts for the next."""
KEY_DIGITS = 16
OFFSETS = ("bias", "compliance", "friction")


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

    That is its calibration, or, cold, what its kind is like.

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
    runs: xr.Dataset,
    diagnoser: BayesDiagnoser,
    history: History,
    advance: Callable[[int], None] = lambda done: None,
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
    runs: xr.Dataset, keys: list[str], known: set[str], cold: bool, life: LifeFilter
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


@dataclass(frozen=True)
class _Seen:
    """Some runs, ready to be judged.

    Attributes:
        runs: The runs.
        diagnoser: How to diagnose.
        seen: What they say.
        evidence: Settled positions.
    """

    runs: xr.Dataset
    diagnoser: BayesDiagnoser
    seen: Evidence
    evidence: SettledEvidence

    @classmethod
    def of(cls, runs: xr.Dataset, diagnoser: BayesDiagnoser, life: LifeFilter) -> _Seen:
        seen = Evidence(runs, life.model.settings)
        evidence = seen.sound.settled
        check_moves(evidence.movements)
        return cls(runs, diagnoser, seen, evidence)

    @property
    def names(self) -> list[str]:
        """Names of the runs."""
        return [str(name) for name in self.runs["run"].values]

    @property
    def keys(self) -> list[str]:
        """Fingerprint of each run; a run that is given twice is known by it."""
        found = []
        for run, name in enumerate(self.names):
            digest, there = hashlib.sha256(name.encode()), self.evidence.movements.exists[run]
            for values in (self.evidence.movements.target, self.evidence.point):
                digest.update(np.ascontiguousarray(values[run][there]).tobytes())
            found.append(digest.hexdigest()[:KEY_DIGITS])
        return found

    def diagnose(self, batch: IntArray, life: LifeFilter, cold: bool) -> list[Diagnosis]:
        """Return the diagnosis of some runs by what is believed now, which then learns of them."""
        life.model = replace(life.model, imperfections=self._known(batch, life, cold))
        moving = None
        evidence = self.evidence[batch]
        if not cold and self.diagnoser.uses_transients:
            counts = self.diagnoser.transient_mask(self.evidence.usable)
            moving = self.seen.sound.transient.where(counts)[batch]
        posterior = life.follow(evidence, moving)
        truth, quality = truths_of(self.runs), self.seen.quality
        return [
            posterior.to_diagnosis(at, self.names[run], quality[run], truth[run])
            for at, run in enumerate(batch.tolist())
        ]

    def _known(self, batch: IntArray, life: LifeFilter, cold: bool) -> Imperfections:
        """Return what was believed at the beginning, with the timing that the commands tell."""
        now = life.model.imperfections
        if life.arrived > 0 and now.protocol != "P1":
            now = replace(now, name=f"{now.name}, tracked", protocol="P1")
        if not cold:
            return now
        movements = life.joined_evidence(self.evidence[batch]).movements
        return with_timing_of(now, movements, self.diagnoser.twin.robot)


def calibration_of(life: LifeFilter, runs: xr.Dataset) -> Calibration:
    """Return what a life has taught by its latest runs, as a calibration that anybody may use."""
    robot, found = life.model.twin.robot, life.told
    told = as_calibration(found, life.begun, robot, runs)
    source = f"{life.arrived} runs without labels; {life.begun.name}"
    known = replace(told.imperfections, source=source)
    return replace(told, imperfections=known, runs=life.arrived, movements=life.movements)
