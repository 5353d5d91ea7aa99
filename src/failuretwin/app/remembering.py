"""What commands take from the store and add to it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.app.records import episode_line
from failuretwin.app.terminal import tell
from failuretwin.connection.calibration.result import Calibration, calibration_text
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import RunSet, concatenate
from failuretwin.data_knowledge.records.history import FaultEpisode, StoredCalibration
from failuretwin.data_knowledge.records.log_files import LogFile, log_file
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.schema import Basis
from failuretwin.data_knowledge.records.sessions import Note
from failuretwin.data_knowledge.records.store import Remembered, Store
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibration_from_table
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.faults.priors import Priors

if TYPE_CHECKING:
    from failuretwin.app.commands.options import LogOptions
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.decision.test_motions.health_check import CheckResult


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
        runs: RunSet | None = None,
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

    def learned_priors(self, hypotheses: Sequence[Hypothesis], usual: Priors) -> Priors:
        """Return the priors of faults that the store teaches, all others as usual."""
        return replace(usual, fault_factors=self.fault_factors(hypotheses))

    def keeper(self, reading: LogOptions, recorded: datetime | None) -> DiagnosisKeeper:
        """Return what keeps the diagnoses of some logs."""
        return DiagnosisKeeper(self, reading, recorded)

    def basis(self, command: str, method: str, known: CalibratedRobot) -> Basis:
        """Return what the results of a command rest on."""
        healthy = known.imperfections
        method = f"{method}; healthy behaviour: {healthy.name}"
        return Basis(command, self.calibration_number, method, healthy.protocol)

    def remembered(
        self, what: str, known: int = 0, episodes: Iterable[FaultEpisode] = ()
    ) -> list[str]:
        """Return what was stored in lines: things, how many were known before, and episodes."""
        before = f", {known} known before" if known else ""
        first = f"remembered in {self.store.name}: {what} of {self.name}{before}"
        return [first, *map(episode_line, episodes)]

    def remember_check(
        self, results: Sequence[CheckResult], log: LogFile | None = None
    ) -> list[str]:
        """Store diagnoses of checks, zeros and plays; return what was stored, in lines.

        Several checks are the runs of one log; zeros and plays are those of the last.
        """
        found = [result.diagnosis for result in results]
        offsets = _check_offsets(results[-1], self.profile)
        done = self.remember(found, log, command="check", offsets=offsets)
        return self.remembered(counted(done.added, "check"), done.known, done.episodes)

    def register(
        self, out: Path, runs: RunSet, logs: Sequence[Path], recorded: datetime | None
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
        return self.remembered(counted(len(names), "run"))[0]

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
        return f"{self.remembered(f'calibration {kept.name}')[0]}, in force from now on"


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
        self._parts: list[RunSet] = []

    @cached_property
    def logs(self) -> list[LogFile]:
        """The logs, by path and checksum."""
        return [log_file(log, self._recorded) for log in self._reading.logs]

    @property
    def latest(self) -> datetime:
        """When the last log was recorded (UTC)."""
        return max(log.recorded for log in self.logs)

    def runs(self, robot: Robot, workforce: Workforce) -> RunSet:
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
        return self._stored.remembered(counted(added, "run"), known, changed.values())
