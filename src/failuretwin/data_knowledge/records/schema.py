"""Tables of the store, and rows that refer to each other.

Evidence is append-only: triggers refuse to change or delete a row. Only an interval that is open
can be closed (`CLOSES`). Times are UTC, quantities in SI units.

Section: docs/store.md#tables
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.engine import Dialect
from sqlalchemy.types import TypeDecorator

CLOSES = {"calibrations": "valid_to", "episodes": "until"}
"""Tables with an interval, and the column of its end: the only value that may be set later."""


class Text(TypeDecorator[str]):
    """Unicode text; NUL and half surrogate pairs, which databases refuse, become U+FFFD."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Return the text to store."""
        return None if value is None else storable(value)


class Utc(TypeDecorator[datetime]):
    """Instant, kept in UTC on every engine."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the instant to store; SQLite has no time zones."""
        if value is None:
            return None
        instant = value.astimezone(UTC)
        return instant.replace(tzinfo=None) if dialect.name == "sqlite" else instant

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the stored instant with its time zone."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


Json = sa.JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql")
Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def storable(text: str) -> str:
    """Return a text as every engine can store it."""
    return text.encode("utf-8", "replace").decode().replace("\0", "\ufffd")


metadata = sa.MetaData()


def _table(name: str, *columns: sa.schema.SchemaItem) -> sa.Table:
    """Return a table whose rows have a number."""
    return sa.Table(name, metadata, sa.Column("id", Id, primary_key=True), *columns)


def _of(
    table: str, name: str = "", needed: bool = True, index: bool | None = None
) -> sa.Column[int]:
    """Return a column of rows of another table."""
    column = name or f"{table.removesuffix('s')}_id"
    return sa.Column(column, Id, sa.ForeignKey(f"{table}.id"), nullable=not needed, index=index)


def _needed(kind: Any, *names: str) -> Iterator[sa.Column[Any]]:
    """Yield columns of one kind that each row fills."""
    return (sa.Column(name, kind, nullable=False) for name in names)


def _may_lack(kind: Any, *names: str) -> Iterator[sa.Column[Any]]:
    """Yield columns of one kind that a row may leave empty."""
    return (sa.Column(name, kind) for name in names)


robots = _table(
    "robots", sa.Column("name", Text, nullable=False, unique=True), *_needed(Utc, "added")
)
"""One row a robot; its name is its own, not that of its kind."""

profiles = _table(
    "profiles",
    _of("robots"),
    *_needed(Text, "name", "arm_class", "document", "sha256"),
    *_needed(Utc, "added"),
    sa.UniqueConstraint("robot_id", "sha256"),
)
"""Profiles of a robot, as text; the last one is in force."""

sensors = _table(
    "sensors",
    _of("profiles", index=True),
    *_needed(Text, "kind"),
    *_needed(Json, "details"),
)
"""Sensors that a profile states."""

calibrations = _table(
    "calibrations",
    _of("robots"),
    *_needed(Text, "name", "protocol", "document", "sha256", "version"),
    *_needed(Utc, "valid_from"),
    *_may_lack(Utc, "valid_to"),
    sa.Index("ix_calibrations_robot", "robot_id", "valid_from"),
)
"""Calibrations of a robot as TOML; `valid_to` is empty for the one in force."""

sessions = _table(
    "sessions",
    _of("robots"),
    _of("calibrations", needed=False),
    *_needed(Utc, "begun"),
    *_needed(Text, "version", "method", "protocol"),
    sa.Column("command", Text, nullable=False, server_default="diagnose"),
    sa.Column("diagnosed", Json, nullable=False, server_default="{}"),
    sa.Index("ix_sessions_robot", "robot_id", "id"),
)
"""What a command did with a robot: version of the package, method, calibration it rests on.

`diagnosed` counts by state all diagnoses of the robot up to this row, without those behind
notes: a history need not count them."""

logs = _table(
    "logs",
    _of("robots"),
    *_needed(Text, "path"),
    *_may_lack(Text, "sha256"),
    *_needed(sa.BigInteger(), "bytes"),
    *_needed(Utc, "recorded", "added"),
    sa.UniqueConstraint("robot_id", "sha256"),
)
"""Logs by reference: the bulk stays in the file."""

runs = _table(
    "runs",
    _of("logs"),
    *_needed(sa.Integer(), "position"),
    *_needed(Text, "name"),
    *_may_lack(Json, "details"),
    sa.UniqueConstraint("log_id", "position", "name"),
)
"""Runs of a log, in its order; details: duration [s], sensor rate [Hz]."""

diagnoses = _table(
    "diagnoses",
    _of("sessions"),
    _of("runs", index=True),
    _of("robots"),
    *_needed(Utc, "at"),
    *_needed(Text, "state"),
    *_may_lack(Text, "hypothesis"),
    *_may_lack(sa.Double(), "probability"),
    *_needed(Json, "posterior"),
    *_may_lack(sa.Double(), "onset_s", "onset_low_s", "onset_high_s", "magnitude"),
    *_may_lack(Text, "magnitude_unit"),
    *_may_lack(sa.Double(), "magnitude_low", "magnitude_high"),
    *_needed(Text, "verdict", "undecided"),
    *_needed(Json, "quality"),
    *_needed(Text, "digest"),
    sa.Index("ix_diagnoses_robot", "robot_id", "at"),
)
"""Diagnoses of runs; intervals hold 90 %, `magnitude` is in the unit of its fault mode."""

episodes = _table(
    "episodes",
    _of("robots"),
    *_needed(sa.Integer(), "number"),
    *_needed(Text, "motor", "mode"),
    *_needed(Utc, "since"),
    *_may_lack(Utc, "until"),
    sa.UniqueConstraint("robot_id", "number"),
)
"""Fault episodes of a robot, numbered from 1; `until` is empty while the fault lasts."""

episode_events = _table(
    "episode_events",
    _of("episodes", index=True),
    _of("diagnoses", "diagnosis_id"),
    *_needed(Text, "state"),
    *_needed(Utc, "at"),
)
"""Changes of the state of an episode, and the diagnosis behind each."""

findings = _table(
    "findings",
    _of("episodes", index=True),
    _of("findings", "withdraws", needed=False),
    *_needed(Text, "verdict", "cause", "person", "note"),
    *_needed(Utc, "at"),
)
"""What people found; a row with `withdraws` takes an earlier one back."""

notes = _table(
    "notes",
    _of("sessions"),
    _of("robots"),
    _of("diagnoses", "diagnosis_id", needed=False, index=True),
    *_needed(Utc, "at"),
    *_needed(Text, "text"),
    sa.Index("ix_notes_robot", "robot_id", "at"),
)
"""What happened in a session, a sentence each, and the diagnosis behind it."""

offsets = _table(
    "offsets",
    _of("sessions"),
    _of("robots"),
    *_needed(Utc, "at"),
    *_needed(Text, "motor", "name"),
    *_needed(sa.Double(), "value", "deviation"),
    *_needed(Text, "unit"),
    sa.Index("ix_offsets_robot", "robot_id", "at"),
)
"""Offsets of the motors as a session found them: mean and standard deviation."""

beliefs = _table(
    "beliefs",
    _of("sessions"),
    _of("robots"),
    *_needed(Text, "follower", "start"),
    *_needed(sa.Integer(), "runs"),
    *_needed(Json, "rows"),
    *_needed(sa.LargeBinary(), "arrays"),
    sa.Index("ix_beliefs_robot", "robot_id", "follower"),
)
"""Posterior of theta of a robot after a session, its new runs, and the start of it all."""

residuals = _table(
    "residuals",
    _of("diagnoses", "diagnosis_id", index=True),
    _of("robots"),
    *_needed(Utc, "at"),
    *_needed(Text, "motor", "unit"),
    *_needed(Json, "movements"),
)
"""Displacements of a motor where `unknown` is most probable, a list a quantity; see
`core.hypothesis.MotorResidual`."""

repairs = _table(
    "repairs",
    _of("robots", index=True),
    *_needed(Text, "motor", "part", "person", "note"),
    *_needed(Utc, "at"),
)
"""Repairs and replaced parts."""

withdrawals = _table(
    "withdrawals",
    _of("repairs"),
    *_needed(Text, "person", "note"),
    *_needed(Utc, "at"),
)
"""Repairs that somebody took back; both rows stay."""

STANDING = ~sa.exists().where(withdrawals.c.repair_id == repairs.c.id)
"""Whether a repair was not withdrawn."""


# Rows.


@dataclass(frozen=True)
class SessionRows:
    """Rows that a session refers to: its own, that of its robot, and that of its run."""

    session: int
    robot: int
    run: int | None = None

    @property
    def columns(self) -> dict[str, Any]:
        """Columns by which rows of the session refer to it and its robot."""
        return {"session_id": self.session, "robot_id": self.robot}


@dataclass(frozen=True)
class Basis:
    """What the results of a session rest on.

    Attributes:
        command: The command.
        calibration: Row of the calibration; None: none of the store.
        method: Method of diagnosis; empty: nothing is diagnosed.
        protocol: Real data that it uses: P0, P0c, P1 or P2; empty: nothing is diagnosed.
    """

    command: str
    calibration: int | None = None
    method: str = ""
    protocol: str = ""


def add_rows(
    connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, Any]]
) -> list[int]:
    """Insert rows and return their ids in the same order.

    The ids of several rows are taken beforehand, so that the rows need no answer: drivers send such
    rows several times as fast.
    """
    if not rows:
        return []
    if len(rows) == 1:
        statement = sa.insert(table).returning(table.c.id)
        return [connection.scalars(statement, dict(rows[0])).one()]
    ids = _new_ids(connection, table, len(rows))
    numbered = [{**row, "id": number} for row, number in zip(rows, ids, strict=True)]
    connection.execute(sa.insert(table), numbered)
    return ids


def _new_ids(connection: sa.Connection, table: sa.Table, count: int) -> list[int]:
    """Return ids that no other row has or gets, ascending."""
    if connection.dialect.name == "sqlite":  # there is one writer at a time
        last = connection.scalar(sa.select(sa.func.max(table.c.id))) or 0
        return list(range(last + 1, last + 1 + count))
    sequence = sa.func.nextval(f"{table.name}_id_seq")
    numbers = sa.func.generate_series(1, count).table_valued("number")
    return sorted(connection.scalars(sa.select(sequence).select_from(numbers)))
