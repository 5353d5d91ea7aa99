"""What commands take from the store and add to it."""

from __future__ import annotations

import math
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.app.records import episode_line
from failuretwin.app.terminal import tell
from failuretwin.connection.calibration.result import Calibration, calibration_text
from failuretwin.core.errors import InputError, OutputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.records.episodes import RAISED
from failuretwin.data_knowledge.records.history import FaultEpisode, StoredCalibration
from failuretwin.data_knowledge.records.log_files import LogFile, log_file
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.rows import Basis
from failuretwin.data_knowledge.records.sessions import Note, Session
from failuretwin.data_knowledge.records.store import Remembered, Store
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibration_from_table
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.diagnoser import BayesDiagnoser

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.app.commands.options import LogOptions
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.decision.acting.session import AlarmChange
    from failuretwin.decision.test_motions.health_check import CheckResult


RETRY_S = 5.0
"""Time after which entries are tried again on a store that failed [s]."""


@dataclass(frozen=True)
class RobotRecord:
    """One robot in a store.

    Attributes:
        store: The store.
        name: Name of the robot there.
        profile: Its profile.
        calibration: Its calibration that the command uses; None: none of the store.
    """

    store: Store
    name: str
    profile: Robot
    calibration: StoredCalibration | None = None

    def with_calibration(self) -> RobotRecord:
        """Return the record with the calibration in force, and say which it is."""
        stored = self.store.calibration(self.name)
        if stored is None:
            return self
        since = f"{stored.valid_from:%Y-%m-%d}"
        text = f"calibration of {self.name} from the store: {stored.name}, valid from {since}"
        tell(text, err=True)
        return replace(self, calibration=stored)

    @property
    def calibrated(self) -> CalibratedRobot | None:
        """The robot with its calibration of the store; None: it uses none."""
        return None if self.calibration is None else self._with(self.calibration, self.name)

    def _with(self, stored: StoredCalibration, robot: str) -> CalibratedRobot:
        """Return the robot with a calibration of the store, which is that of `robot`."""
        where = f"{self.store.name}: calibration {stored.name!r} of {robot}"
        return calibration_from_table(tomllib.loads(stored.document), self.profile, where)

    @property
    def population(self) -> CalibratedRobot | None:
        """The robot as one of the calibrated robots of its kind, and say so.

        None: it has a calibration of its own, also by a profile that is its own, or too few of its
        kind have one.
        """
        from failuretwin.connection.population import LEAST_ROBOTS, Population

        own_profile = self.name == self.profile.name and self.profile.imperfections_file is not None
        if self.calibration is not None or own_profile:
            return None
        found, kind = self.store.fleet_calibrations(self.profile.name), self.profile.name
        if len(found) < LEAST_ROBOTS:
            count = counted(len(found), "calibrated robot")
            need = f"expected {LEAST_ROBOTS} or more; the profile's figures are used"
            tell(f"learned healthy behaviour: {count} ({kind}), {need}", err=True)
            return None
        known = [self._with(stored, robot) for robot, stored in found.items()]
        figures = Population.fit(known, self.profile).imperfections
        name = f"population of {len(known)} calibrated robots ({kind})"
        tell(f"learned healthy behaviour: {name}", err=True)
        return CalibratedRobot(self.profile, replace(figures, name=name))

    @property
    def calibration_number(self) -> int | None:
        """Number of the calibration in the store; None: none of the store."""
        return None if self.calibration is None else self.calibration.number

    def remember(
        self,
        diagnoses: Sequence[Diagnosis],
        log: LogFile | None,
        runs: xr.Dataset | None = None,
        command: str = "diagnose",
        offsets: Sequence[MotorOffset] = (),
        first: int = 0,
    ) -> Remembered:
        """Store diagnoses of one log, from its run number `first` on."""
        return self.store.remember(
            diagnoses,
            self.name,
            log=log,
            runs=runs,
            profile=self.profile,
            calibration=self.calibration_number,
            command=command,
            offsets=offsets,
            first=first,
        )

    def tracked_rows(self) -> tuple[dict[str, Any], ...]:
        """Return what `diagnose --track` keeps of each run, the oldest first.

        Raises:
            InputError: If it has followed no run of the robot.
        """
        rows = self.store.tracked_rows(self.name)
        if not rows:
            raise InputError(
                f"{self.store.name}: holds no tracked run of {self.name!r}. Expected what "
                "`diagnose --track` with a store keeps."
            )
        return rows

    def fault_factors(self, hypotheses: Sequence[Hypothesis]) -> dict[str, float]:
        """Return how many times as probable faults are as by the table, and say why.

        The confirmed faults of all robots of the kind in the store tell, by the age of each motor.
        """
        from failuretwin.connection.fault_rates import LearnedRates

        seen, ages = self.store.fleet_faults(self.profile.name), self.store.motor_ages(self.name)
        learned = LearnedRates.of(seen, hypotheses, ages)
        tell(f"learned priors: {learned.line}", err=True)
        return learned.factors

    def with_learned_priors(self, bayes: BayesDiagnoser) -> BayesDiagnoser:
        """Return a diagnoser with the priors that the store teaches."""
        factors = self.fault_factors(bayes.hypothesis_set)
        return replace(bayes, priors=replace(bayes.priors, fault_factors=factors))

    def keeper(self, reading: LogOptions, recorded: datetime | None) -> DiagnosisKeeper:
        """Return what keeps the diagnoses of some logs."""
        return DiagnosisKeeper(self, reading, recorded)

    def work_keeper(self, command: str, known: CalibratedRobot, method: str) -> WorkKeeper:
        """Return what keeps what a command does with the arm, and why."""
        figures = known.imperfections
        method = f"{method}; healthy behaviour: {figures.name}"
        return WorkKeeper(self, Basis(command, self.calibration_number, method, figures.protocol))

    def remember_check(
        self, results: Sequence[CheckResult], log: LogFile | None = None
    ) -> list[str]:
        """Store diagnoses of checks, zeros and plays; return what was stored, in lines.

        Several checks are the runs of one log; zeros and plays are those of the last.
        """
        found = [result.diagnosis for result in results]
        offsets = _check_offsets(results[-1], self.profile)
        done = self.remember(found, log, command="check", offsets=offsets)
        before = f", {done.known} known before" if done.known else ""
        checks = counted(done.added, "check")
        first = f"remembered in {self.store.name}: {checks} of {self.name}{before}"
        return [first, *map(episode_line, done.episodes)]

    def register(
        self, out: Path, runs: xr.Dataset, logs: Sequence[Path], recorded: datetime | None
    ) -> str:
        """Store a run set that was written as a log without diagnoses, and return a line.

        Args:
            out: The run set.
            runs: Its runs.
            logs: What it was read from.
            recorded: When that was recorded (UTC); None: when the last log was last modified.
        """
        recorded = recorded or max(log_file(log).recorded for log in logs)
        names = [str(name) for name in runs["run"].values]
        text = f"{counted(len(names), 'run')} written to {out}"
        self.store.begin(
            self.name,
            Basis("import"),
            Note(datetime.now(UTC), text),
            log=log_file(out, recorded),
            runs=names,
            profile=self.profile,
        )
        return f"remembered in {self.store.name}: {counted(len(names), 'run')} of {self.name}"

    def keep_calibration(self, found: Calibration) -> str:
        """Store a calibration, and return what was stored, in a line."""
        figures = found.imperfections
        kept = self.store.keep_calibration(
            self.name,
            calibration_text(found, self.profile),
            name=figures.name,
            protocol=figures.protocol,
            profile=self.profile,
        )
        where = f"remembered in {self.store.name}"
        return f"{where}: calibration {kept.name} of {self.name}, in force from now on"


class WorkKeeper:
    """Stores the entries of a diary while the arm works, in a thread: the arm never waits for it.

    Entries wait where the store fails, and are tried again.

    Args:
        record: The robot in the store.
        basis: The command, and what its results rest on.
    """

    def __init__(self, record: RobotRecord, basis: Basis) -> None:
        self._record = record
        self._basis = basis
        self._session: Session | None = None
        self._waiting: list[Note] = []
        self._changed: dict[int, FaultEpisode] = {}
        self._due_s = -math.inf
        self._writer = ThreadPoolExecutor(1)

    def keep(self, at: datetime, entry: str | AlarmChange) -> None:
        """Store an entry of a time (UTC), soon."""
        self._writer.submit(self._try, _note(at, entry))

    def end(self) -> list[str]:
        """Store what waits, and return what was stored, in lines.

        Raises:
            OutputError: If it cannot be stored.
        """
        self._writer.shutdown()
        self._write()
        command = self._basis.command
        first = f"remembered in {self._record.store.name}: {command} of {self._record.name}"
        return [first, *map(episode_line, self._changed.values())]

    def _try(self, note: Note) -> None:
        self._waiting.append(note)
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + RETRY_S
            with suppress(OutputError):
                self._write()
                self._due_s = -math.inf

    def _write(self) -> None:
        if self._session is None:
            self._session = self._begun()
        changed = self._session.note(*self._waiting)
        self._waiting = []
        self._changed |= {one.number: one for one in changed}

    def _begun(self) -> Session:
        record, command = self._record, self._basis.command
        log = LogFile(command, None, 0, datetime.now(UTC))
        return record.store.begin(
            record.name, self._basis, log=log, runs=[command], profile=record.profile
        )


def _note(at: datetime, entry: str | AlarmChange) -> Note:
    if isinstance(entry, str):
        return Note(at, entry)
    fault = entry.fault
    alarm = "" if fault is None else f"{fault.motor}:{fault.mode}"
    certain = fault is None or fault.state == RAISED
    return Note(at, entry.text, entry.diagnosis, alarm, certain, entry.final)


def _check_offsets(result: CheckResult, robot: Robot) -> list[MotorOffset]:
    found, offsets = result.offsets, list[MotorOffset]()
    for k, motor in enumerate(robot.motor_names):
        unit = "m" if robot.slides[k] else "rad"
        for name, value, deviation in (
            ("zero", found.zero, found.zero_sd),
            ("play", found.play, found.play_sd),
        ):
            offsets.append(MotorOffset(motor, name, float(value[k]), float(deviation[k]), unit))
    return offsets


class DiagnosisKeeper:
    """Keeps the diagnoses of one command, log by log.

    Args:
        stored: The robot in the store.
        reading: The logs.
        recorded: When they were recorded (UTC); None: when each was last modified.
    """

    def __init__(self, stored: RobotRecord, reading: LogOptions, recorded: datetime | None) -> None:
        self._stored = stored
        self._reading = reading
        self._recorded = recorded
        self._parts: list[xr.Dataset] = []

    @cached_property
    def logs(self) -> list[LogFile]:
        """The logs, by path and checksum."""
        return [log_file(log, self._recorded) for log in self._reading.logs]

    @property
    def latest(self) -> datetime:
        """When the last log was recorded (UTC)."""
        return max(log.recorded for log in self.logs)

    def runs(self, robot: Robot, workforce: Workforce) -> xr.Dataset:
        """Return the runs of all logs as one run set."""
        self._parts = self._reading.parts(robot, workforce)
        return concatenate(self._parts)

    def remember(self, diagnoses: Sequence[Diagnosis]) -> list[str]:
        """Store the diagnoses of all runs, and return what was stored, in lines."""
        rest, added, known = list(diagnoses), 0, 0
        changed: dict[int, FaultEpisode] = {}
        for log, part in zip(self.logs, self._parts, strict=True):
            names = map(str, part["run"].values)
            own = [replace(one, run=run) for run, one in zip(names, rest, strict=False)]
            del rest[: len(own)]
            done = self._stored.remember(own, log, part)
            added, known = added + done.added, known + done.known
            changed |= {one.number: one for one in done.episodes}
        before = f", {known} known before" if known else ""
        where = f"remembered in {self._stored.store.name}"
        first = f"{where}: {counted(added, 'run')} of {self._stored.name}{before}"
        return [first, *(episode_line(one) for one in changed.values())]
