"""The store: remembers robots, their diagnoses and faults, and what people found.

    import failuretwin as ft

    store = ft.open_store("robots.db")
    store.remember(ft.diagnose("monday.nc"), "arm_7", log="monday.nc")
    print(store.history("arm_7").health)

Section: docs/store.md
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from failuretwin import __version__
from failuretwin.core.errors import InputError, check_name
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.runs import measured_rate
from failuretwin.data_knowledge.records import CHECK_DAYS, writing
from failuretwin.data_knowledge.records.checking import StoreCheck, checked
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.export import export_parquet
from failuretwin.data_knowledge.records.history import (
    OTHER_CAUSE,
    WRONG,
    FaultEpisode,
    History,
    StoredCalibration,
    read_calibrations,
    read_episodes,
    read_history,
)
from failuretwin.data_knowledge.records.log_files import LogFile, log_file, utc
from failuretwin.data_knowledge.records.queries import QueryAnswer, ask
from failuretwin.data_knowledge.records.schema import (
    calibrations,
    findings,
    repairs,
    robots,
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


class Store:
    """A store of robots; `open_store` returns one.

    Every call is one transaction and holds no connection afterwards. Evidence is append-only.
    Errors are `InputError` while reading and `OutputError` while writing: nothing of the call is
    stored then.

    Args:
        database: The database with the tables.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    @property
    def name(self) -> str:
        """Path of the SQLite file, or URL without the password."""
        return self._database.name

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
    ) -> Remembered:
        """Store the diagnoses of the runs of one log, in the order of the log.

        The fault episodes of the robot follow them by the rule of
        `failuretwin.data_knowledge.records.episodes`. A run that was stored before, or that is
        older than the last one of the robot, changes no episode. The same diagnosis of the same
        run is stored once.

        Args:
            diagnoses: Diagnoses of all runs of the log.
            robot: Name of the robot, made if it is new.
            log: The log, by path and checksum; None: no file, recorded now.
            runs: The run set, for the duration [s] and the sensor rate [Hz].
            profile: The robot's profile, stored if it is new.
            calibration: Number of the stored calibration that the diagnoses rest on; None: none of
                the store.

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
            run_rows, new = writing.keep_runs(connection, at, names, details)
            kept = writing.new_diagnoses(connection, at, diagnoses, run_rows, calibration)
            tracker = writing.tracker_of(connection, row)
            if source.recorded >= (writing.latest_run(connection, row) or source.recorded):
                for number, (diagnosis, run, _) in enumerate(kept):
                    if run in new:
                        tracker.follow(diagnosis, source.recorded, number)
            rows = writing.add_diagnoses(connection, row, kept, source.recorded, calibration)
            changed = writing.keep_episodes(connection, row, tracker.changed, rows)
            return Remembered(
                len(kept), len(diagnoses) - len(kept), _episodes_of(connection, row, changed)
            )

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
    ) -> FaultEpisode:
        """Store what a person found about an episode; the last finding that stands counts.

        Args:
            robot: Name of the robot.
            episode: Number of the episode.
            verdict: ``confirmed``, ``wrong`` or ``other cause``.
            cause: The cause; needed for ``other cause``.
            person: Who found it.
            note: Anything else.

        Raises:
            InputError: If there is no such robot, episode or verdict, or no cause.
            OutputError: If it could not be stored.
        """
        check_name("finding", verdict, VERDICTS)
        if verdict == OTHER_CAUSE and not cause:
            raise InputError("an other cause has no name. State the cause that was found.")
        stated = {"verdict": verdict, "cause": cause, "person": person, "note": note}
        return self._add_finding(robot, episode, stated)

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
        stated = {"verdict": "withdrawn", "cause": "", "person": person, "note": note}
        return self._add_finding(robot, episode, stated, withdraw=True)

    def _add_finding(
        self, robot: str, number: int, stated: Mapping[str, Any], withdraw: bool = False
    ) -> FaultEpisode:
        with self._database.writing() as connection:
            row = writing.find_locked(connection, robot)
            episode = _episode(connection, row, robot, number)
            standing = episode.finding if withdraw else None
            if withdraw and standing is None:
                raise InputError(
                    f"episode {number} of {robot!r} has no finding to withdraw. Expected one of "
                    "`failuretwin found`."
                )
            of = {"episode_id": episode.row, "withdraws": standing and standing.number}
            writing.add_rows(connection, findings, [{**stated, **of, "at": datetime.now(UTC)}])
            return _episode(connection, row, robot, number)

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
            stated = {"motor": motor, "part": part, "person": person, "note": note}
            when = {"robot_id": row, "at": _or_now(at)}
            writing.add_rows(connection, repairs, [{**stated, **when}])

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
            current = _in_force(connection, row)
            if current is not None and current.document == document:
                return current
            if current is not None:
                _close(connection, current, start)
            stated = {"robot_id": row, "name": name, "protocol": protocol, "document": document}
            stated |= {"version": __version__, "sha256": writing.text_checksum(document)}
            writing.add_rows(connection, calibrations, [{**stated, "valid_from": start}])
            return read_calibrations(connection, row)[-1]

    def calibration(self, robot: str) -> StoredCalibration | None:
        """Return the calibration of a robot that is in force.

        None: the robot has none, or the store does not know the robot.
        """
        with self._database.reading() as connection:
            row = connection.scalar(sa.select(robots.c.id).where(robots.c.name == robot))
            return None if row is None else _in_force(connection, row)

    # Reading.

    def robots(self) -> list[str]:
        """Return the names of all robots, sorted."""
        with self._database.reading() as connection:
            return sorted(connection.scalars(sa.select(robots.c.name)))

    def history(self, robot: str) -> History:
        """Return what the store knows of a robot.

        Raises:
            InputError: If it does not know the robot.
        """
        with self._database.reading() as connection:
            return read_history(connection, writing.find_robot(connection, robot), robot)

    def query(self, name: str, days: float = CHECK_DAYS) -> QueryAnswer:
        """Return the answer to a ready question.

        Args:
            name: ``failing-motors``, ``time-between-failures``, ``wrong-diagnoses`` or ``due``.
            days: Time without a run after which a robot is due [days].

        Raises:
            InputError: If there is no such question.
        """
        with self._database.reading() as connection:
            return ask(connection, name, days)

    def export(self, folder: str | Path) -> dict[str, int]:
        """Write every table to ``TABLE.parquet`` in a folder, and return the numbers of rows.

        Raises:
            InputError: If pyarrow is missing.
            OutputError: If they cannot be written; the folder is as before.
        """
        with self._database.reading() as connection:
            return export_parquet(connection, Path(folder))

    def check(self) -> StoreCheck:
        """Check the database, and whether each log is where it was and as it was."""
        with self._database.reading() as connection:
            return checked(connection)


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


# Parts of `Store.remember`.

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


def _or_now(time: datetime | None) -> datetime:
    return datetime.now(UTC) if time is None else utc(time)


def _details(runs: xr.Dataset | None, count: int) -> list[dict[str, float] | None]:
    if runs is None:
        return [None] * count
    rate = measured_rate(runs)
    return [{"duration_s": float(one), "rate_hz": rate} for one in runs["duration"].values]


def _episodes_of(
    connection: sa.Connection, robot: int, changed: Sequence[int]
) -> tuple[FaultEpisode, ...]:
    return tuple(one for one in read_episodes(connection, robot) if one.row in changed)


# Parts of the other calls.


def _episode(connection: sa.Connection, row: int, robot: str, number: int) -> FaultEpisode:
    all_of_it = read_episodes(connection, row)
    found = next((one for one in all_of_it if one.number == number), None)
    if found is None:
        valid = ", ".join(str(one.number) for one in all_of_it) or "none so far"
        raise InputError(f"robot {robot!r} has no episode {number}. Its episodes: {valid}.")
    return found


def _in_force(connection: sa.Connection, robot: int) -> StoredCalibration | None:
    stored = read_calibrations(connection, robot)
    return next((one for one in stored if one.valid_to is None), None)


def _close(connection: sa.Connection, current: StoredCalibration, end: datetime) -> None:
    if end < current.valid_from:
        raise InputError(
            f"calibration {current.name!r} is valid from {current.valid_from:%Y-%m-%d %H:%M}, "
            f"after {end:%Y-%m-%d %H:%M}. Expected a later time."
        )
    row = calibrations.c.id == current.number
    connection.execute(sa.update(calibrations).where(row).values(valid_to=end))
