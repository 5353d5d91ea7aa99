"""Reading from a store: robots, histories, questions, exports, checks."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from failuretwin.core.errors import check_name
from failuretwin.data_knowledge.records import CHECK_DAYS, writing
from failuretwin.data_knowledge.records.beliefs import (
    Belief,
    BeliefLine,
    latest_rows,
    other_line,
    read_belief,
)
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.export import export_parquet, export_shell
from failuretwin.data_knowledge.records.fleet import (
    FleetFaults,
    fleet_calibrations,
    fleet_faults,
    motor_ages,
)
from failuretwin.data_knowledge.records.history import History, StoredCalibration, read_history
from failuretwin.data_knowledge.records.log_files import StoreCheck, checked
from failuretwin.data_knowledge.records.queries import (
    QUESTIONS,
    QueryAnswer,
    RobotGlance,
    StoredRun,
    read_overview,
    read_runs_of,
)
from failuretwin.data_knowledge.records.schema import robots


class StoreReader:
    """The part of a store that only reads.

    Args:
        database: The database with the tables.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    @property
    def name(self) -> str:
        """Path of the SQLite file, or URL without the password."""
        return self._database.name

    def calibration(self, robot: str) -> StoredCalibration | None:
        """Return the calibration of a robot that is in force.

        None: the robot has none, or the store does not know the robot.
        """
        with self._database.reading() as connection:
            row = _row_of(connection, robot)
            return None if row is None else writing.calibration_in_force(connection, row)

    def belief(self, robot: str, line: BeliefLine) -> tuple[Belief | None, str]:
        """Return the last belief of a line, and why that of another line is not used.

        Raises:
            InputError: If it is damaged.
        """
        with self._database.reading() as connection:
            row = _row_of(connection, robot)
            if row is None:
                return None, ""
            found = read_belief(connection, row, line)
            return found, "" if found else other_line(connection, row, line)

    def tracked_rows(self, robot: str, follower: str = "diagnose") -> tuple[dict[str, Any], ...]:
        """Return what is kept of each run of a followed robot, the oldest first.

        The runs are those of the line of beliefs that was followed last; empty: there is none.
        """
        with self._database.reading() as connection:
            row = _row_of(connection, robot)
            return () if row is None else latest_rows(connection, row, follower)

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

    def overview(self) -> tuple[RobotGlance, ...]:
        """Return all robots with their last diagnosis and open faults, by name."""
        with self._database.reading() as connection:
            return read_overview(connection)

    def runs(self, robot: str) -> tuple[StoredRun, ...]:
        """Return the last diagnosed runs of a robot, the newest first.

        Raises:
            InputError: If the store does not know the robot.
        """
        with self._database.reading() as connection:
            return read_runs_of(connection, writing.find_robot(connection, robot))

    def query(self, name: str, days: float = CHECK_DAYS) -> QueryAnswer:
        """Return the answer to a ready question.

        Args:
            name: ``failing-motors``, ``time-between-failures``, ``rates-by-age``,
                ``wrong-diagnoses``, ``unknown-faults`` or ``due``.
            days: Time without a run after which a robot is due [days].

        Raises:
            InputError: If there is no such question.
        """
        check_name("query", name, QUESTIONS)
        question = QUESTIONS[name]
        with self._database.reading() as connection:
            rows = question.ask(connection, datetime.now(UTC), days)
        return QueryAnswer(name, question.title, question.columns, tuple(rows))

    def fleet_faults(self, kind: str) -> FleetFaults:
        """Return the confirmed faults of all robots of a kind, and the time that they were seen.

        Args:
            kind: Name of their profile.
        """
        with self._database.reading() as connection:
            return fleet_faults(connection, kind)

    def motor_ages(self, robot: str) -> dict[str, float]:
        """Return the age of each motor of a robot at its last run [h].

        Empty: the store does not know the robot, or no run or profile of it.
        """
        with self._database.reading() as connection:
            row = _row_of(connection, robot)
            return {} if row is None else motor_ages(connection, row)

    def fleet_calibrations(self, kind: str) -> dict[str, StoredCalibration]:
        """Return the calibrations in force of all robots of a kind, each file once, by robot.

        Args:
            kind: Name of their profile.
        """
        with self._database.reading() as connection:
            return fleet_calibrations(connection, kind)

    def export(self, folder: str | Path) -> dict[str, int]:
        """Write every table to ``TABLE.parquet`` in a folder, and return the numbers of rows.

        Raises:
            InputError: If pyarrow is missing.
            OutputError: If they cannot be written; the folder is as before.
        """
        with self._database.reading() as connection:
            return export_parquet(connection, Path(folder))

    def export_shell(self, robot: str, file: str | Path) -> list[str]:
        """Write a robot as an Asset Administration Shell, and return the names of its submodels.

        Args:
            robot: Name of the robot.
            file: The file, ``.aasx`` or ``.json``.

        Raises:
            InputError: If the store does not know the robot, the SDK is missing, or the suffix is
                another.
            OutputError: If it cannot be written; the file is as before.
        """
        return export_shell(self.history(robot), Path(file))

    def check(self) -> StoreCheck:
        """Check the database, and whether each log is where it was and as it was."""
        with self._database.reading() as connection:
            return checked(connection)


def _row_of(connection: sa.Connection, robot: str) -> int | None:
    """Return the row of a robot; None: the store does not know it."""
    return connection.scalar(sa.select(robots.c.id).where(robots.c.name == robot))
