"""The store: remembers robots, their diagnoses and faults, and what people found.

    import failuretwin as ft

    store = ft.open_store("robots.db")
    store.remember(ft.diagnose("monday.nc"), "arm_7", log="monday.nc")
    print(store.history("arm_7").health)

Section: docs/store.md
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.core.errors import InputError, check_name
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import measured_rate
from failuretwin.data_knowledge.records import writing
from failuretwin.data_knowledge.records.beliefs import (
    Belief,
    BeliefLine,
    add_belief,
)
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.history import (
    OTHER_CAUSE,
    WRONG,
    FaultEpisode,
    StoredCalibration,
)
from failuretwin.data_knowledge.records.log_files import LogFile, log_file, utc
from failuretwin.data_knowledge.records.offsets import MotorOffset, add_offsets
from failuretwin.data_knowledge.records.reading import StoreReader
from failuretwin.data_knowledge.records.schema import (
    Basis,
    SessionRows,
    add_rows,
    repairs,
)
from failuretwin.data_knowledge.records.sessions import (
    Note,
    Session,
    follow_notes,
    keep_episodes,
    latest_run,
    tracker_of,
)
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

VERDICTS = (CONFIRMED, WRONG, OTHER_CAUSE)
"""What a person can find about an episode."""


@dataclass(frozen=True)
class Remembered:
    """What one call of `Store.remember` has added.

    Attributes:
        added: Number of diagnoses that were stored.
        known: Number of diagnoses that were stored before.
        episodes: Episodes that began, were raised or were cleared.
    """

    added: int
    known: int
    episodes: tuple[FaultEpisode, ...]


class Store(StoreReader):
    """A store of robots; `open_store` returns one.

    Every call is one transaction and holds no connection afterwards. Evidence is append-only.
    Errors are `InputError` while reading and `OutputError` while writing: nothing of the call is
    stored then.

    Args:
        database: The database with the tables.
    """

    # Diagnoses.

    def remember(
        self,
        diagnoses: Sequence[Diagnosis],
        robot: str,
        *,
        log: LogFile | str | Path | None = None,
        runs: xr.Dataset | None = None,
        profile: Robot | None = None,
        calibration: int | None = None,
        command: str = "diagnose",
        offsets: Sequence[MotorOffset] = (),
        first: int = 0,
    ) -> Remembered:
        """Store the diagnoses of the runs of one log, in the order of the log.

        The fault episodes of the robot follow them by the rule of
        `failuretwin.data_knowledge.records.episodes`. A run that was stored before, or that is
        older than the last one of the robot, changes no episode. The same diagnosis of the same
        run is stored once.

        Args:
            diagnoses: Diagnoses of all runs of the log, or of successive ones.
            robot: Name of the robot, made if it is new.
            log: The log, by path and checksum; None: no file, recorded now.
            runs: The run set, for the duration [s] and the sensor rate [Hz].
            profile: The robot's profile, stored if it is new.
            calibration: Number of the stored calibration that the diagnoses rest on; None: none of
                the store.
            command: The command that made them.
            offsets: Offsets of the motors that it measured.
            first: Number of the first of these runs in the log.

        Raises:
            InputError: If the log cannot be read or the name of the robot cannot be shown.
            OutputError: If nothing could be stored.
        """
        if not diagnoses:
            return Remembered(0, 0, ())
        source = _reference(log)
        details = _details(runs, len(diagnoses))
        with self._database.writing() as connection:
            row = writing.keep_robot(connection, robot, profile)
            at = writing.keep_log(connection, row, source)
            names = [one.run for one in diagnoses]
            run_rows = writing.keep_runs(connection, at, names, details, first)
            kept, seen = writing.new_diagnoses(connection, at, diagnoses, run_rows, calibration)
            if not kept:
                return Remembered(0, len(diagnoses), ())
            tracker = tracker_of(connection, row)
            if source.recorded >= (latest_run(connection, row) or source.recorded):
                for number, (diagnosis, run, _) in enumerate(kept):
                    if run not in seen:
                        tracker.follow(diagnosis, source.recorded, number)
            basis = Basis(command, calibration, diagnoses[0].method, diagnoses[0].protocol)
            states = (one.state for one, _, _ in kept)
            of = SessionRows(writing.add_session(connection, row, basis, states), row)
            rows = writing.add_diagnoses(connection, of, kept, source.recorded)
            add_offsets(connection, of, source.recorded, offsets)
            changed = keep_episodes(connection, row, tracker.changed, rows)
            return Remembered(len(kept), len(diagnoses) - len(kept), changed)

    # Sessions.

    def begin(
        self,
        robot: str,
        basis: Basis,
        *happened: Note,
        log: LogFile | None = None,
        runs: Sequence[str] = (),
        profile: Robot | None = None,
    ) -> Session:
        """Begin a session that is stored as it happens, such as that of a watch.

        Args:
            robot: Name of the robot, made if it is new.
            basis: The command, and what its results rest on.
            happened: First notes; episodes follow their diagnoses.
            log: The log, by path and checksum; None: there is none, nor a diagnosis.
            runs: Names of its runs; diagnoses of the session belong to the first.
            profile: The robot's profile, stored if it is new.

        Raises:
            InputError: If the name of the robot cannot be shown.
            OutputError: If nothing could be stored.
        """
        with self._database.writing() as connection:
            row = writing.keep_robot(connection, robot, profile)
            known = list[int]()
            if log is not None:
                at = writing.keep_log(connection, row, log)
                known = writing.keep_runs(connection, at, runs, [None] * len(runs))
            session = writing.add_session(connection, row, basis)
            of = SessionRows(session, row, known[0] if known else None)
            first = follow_notes(connection, of, happened)
        return Session(self._database, of, first)

    def keep_alarm(
        self,
        robot: str,
        *,
        identity: str,
        text: str,
        at: datetime,
        before: str,
        now: str,
        diagnosis: Diagnosis,
    ) -> bool:
        """Store an alarm of a fleet, once, and let the episodes of the robot follow it.

        Args:
            robot: Name of the robot, made if it is new.
            identity: What is the same each time that the alarm is delivered.
            text: What happened.
            at: When (UTC).
            before: Fault that the alarm named before; empty: none.
            now: Fault that it names now; empty: it is cleared.
            diagnosis: The diagnosis behind it.

        Returns:
            Whether it was new.

        Raises:
            OutputError: If it could not be stored.
        """
        text = f"{text} [{identity}]"
        with self._database.writing() as connection:
            row = writing.keep_robot(connection, robot, None)
            if writing.is_noted(connection, row, text):
                return False
            at_log = writing.keep_log(connection, row, LogFile("fleet", None, 0, at))
            run = writing.keep_runs(connection, at_log, [identity], [None])[0]
            session = writing.add_session(connection, row, Basis("worker"))
            rows = SessionRows(session, row, run)
            named = Hypothesis.parse(before).faults if before else ()
            alarmed = tuple(fault.motor for fault in named)
            follow_notes(connection, rows, [Note(at, text, diagnosis, now)], alarmed)
        return True

    def keep_belief(
        self,
        robot: str,
        basis: Basis,
        line: BeliefLine,
        belief: Belief,
        at: datetime,
        offsets: Sequence[MotorOffset] = (),
        profile: Robot | None = None,
    ) -> int:
        """Store the posterior of theta of a robot, from which the next session goes on.

        Returns:
            Number of the belief.

        Args:
            robot: Name of the robot, made if it is new.
            basis: The command, and the calibration that the line began with.
            line: The line of beliefs that it goes on.
            belief: The belief.
            at: When the last of its runs was (UTC).
            offsets: The offsets that it holds, for people.
            profile: The robot's profile, stored if it is new.

        Raises:
            OutputError: If it could not be stored, or another session went on meanwhile.
        """
        with self._database.writing() as connection:
            row = writing.keep_robot(connection, robot, profile)
            of = SessionRows(writing.add_session(connection, row, basis), row)
            add_offsets(connection, of, at, offsets)
            return add_belief(connection, of, line, belief)

    # People.

    def found(
        self,
        robot: str,
        episode: int,
        verdict: str,
        *,
        cause: str = "",
        person: str = "",
        note: str = "",
        at: datetime | None = None,
    ) -> FaultEpisode:
        """Store what a person found about an episode; the last finding that stands counts.

        Args:
            robot: Name of the robot.
            episode: Number of the episode.
            verdict: ``confirmed``, ``wrong`` or ``other cause``.
            cause: The cause; needed for ``other cause``.
            person: Who found it.
            note: Anything else.
            at: When (UTC); None: now.

        Raises:
            InputError: If there is no such robot, episode or verdict, or no cause.
            OutputError: If it could not be stored.
        """
        check_name("finding", verdict, VERDICTS)
        if verdict == OTHER_CAUSE and not cause:
            raise InputError("an other cause has no name. State the cause that was found.")
        stated = _stated(at, verdict=verdict, cause=cause, person=person, note=note)
        with self._database.writing() as connection:
            return writing.add_finding(connection, robot, episode, stated)

    def withdraw(
        self, robot: str, episode: int, *, person: str = "", note: str = ""
    ) -> FaultEpisode:
        """Take back the last finding about an episode; both stay in the store.

        Args:
            robot: Name of the robot.
            episode: Number of the episode.
            person: Who withdraws it.
            note: Why.

        Raises:
            InputError: If there is no such robot or episode, or no finding that stands.
            OutputError: If it could not be stored.
        """
        stated = _stated(None, verdict="withdrawn", cause="", person=person, note=note)
        with self._database.writing() as connection:
            return writing.add_finding(connection, robot, episode, stated, withdraw=True)

    def repaired(
        self,
        robot: str,
        motor: str,
        *,
        part: str = "",
        person: str = "",
        note: str = "",
        at: datetime | None = None,
    ) -> None:
        """Store a repair. It clears no episode: the next healthy diagnosis does.

        Args:
            robot: Name of the robot.
            motor: The motor that was repaired.
            part: The replaced part; empty: none.
            person: Who did it.
            note: Anything else.
            at: When (UTC); None: now.

        Raises:
            InputError: If there is no such robot or motor.
            OutputError: If it could not be stored.
        """
        with self._database.writing() as connection:
            row = writing.find_robot(connection, robot)
            motors = writing.motors_of(connection, row)
            if motors:
                check_name("motor", motor, motors)
            stated = _stated(at, motor=motor, part=part, person=person, note=note)
            add_rows(connection, repairs, [{**stated, "robot_id": row}])

    def withdraw_repair(self, robot: str, motor: str, *, person: str = "", note: str = "") -> None:
        """Take back the last repair of a motor; both stay in the store.

        Raises:
            InputError: If there is no such robot, or no repair of the motor that stands.
            OutputError: If it could not be stored.
        """
        with self._database.writing() as connection:
            writing.withdraw_last_repair(connection, robot, motor, {"person": person, "note": note})

    # Calibrations.

    def keep_calibration(
        self,
        robot: str,
        document: str,
        *,
        name: str,
        protocol: str,
        profile: Robot | None = None,
        valid_from: datetime | None = None,
    ) -> StoredCalibration:
        """Store a calibration; it replaces the one in force, whose validity ends.

        Args:
            robot: Name of the robot, made if it is new.
            document: The calibration file (TOML).
            name: Name of the calibration.
            protocol: Real data it rests on: P0c or P1.
            profile: The robot's profile, stored if it is new.
            valid_from: Start of its validity (UTC); None: now.

        Raises:
            InputError: If the calibration in force is newer.
            OutputError: If it could not be stored.
        """
        start = _or_now(valid_from)
        with self._database.writing() as connection:
            row = writing.keep_robot(connection, robot, profile)
            stated = {"name": name, "protocol": protocol, "document": document}
            stated |= {"version": __version__, "sha256": writing.text_checksum(document)}
            return writing.replace_calibration(connection, row, stated, start)


def open_store(url: str | Path, *, create: bool = False) -> Store:
    """Open a store.

    Args:
        url: Path of an SQLite file, ``sqlite:///FILE`` or ``postgresql://USER@HOST/DATABASE``.
        create: Whether the tables are made if there are none.

    Raises:
        InputError: If there is no store, it has another schema than this version, or the server
            does not answer.
        OutputError: If it cannot be made.
    """
    database = Database(url)
    if create:
        database.create()
    else:
        database.check_revision()
    return Store(database)


# Parts of the calls.

CLOCK_ERROR = timedelta(days=1)
"""Largest lead of the clock that logs are stamped by."""


def _reference(log: LogFile | str | Path | None) -> LogFile:
    if log is None:
        return LogFile("", None, 0, datetime.now(UTC))
    found = log if isinstance(log, LogFile) else log_file(log)
    if found.recorded > datetime.now(UTC) + CLOCK_ERROR:
        raise InputError(
            f"{found.path}: its time, {found.recorded:%Y-%m-%d %H:%M}, lies in the future, so all "
            "later logs would count as older. State the right one: --recorded TIME."
        )
    return found


def _stated(at: datetime | None, **columns: str) -> dict[str, Any]:
    """Return the columns of what a person states at a time (UTC); None: now."""
    return {**columns, "at": _or_now(at)}


def _or_now(time: datetime | None) -> datetime:
    return datetime.now(UTC) if time is None else utc(time)


def _details(runs: xr.Dataset | None, count: int) -> list[dict[str, float] | None]:
    if runs is None:
        return [None] * count
    rate = measured_rate(runs)
    return [{"duration_s": float(one), "rate_hz": rate} for one in runs["duration"].values]
