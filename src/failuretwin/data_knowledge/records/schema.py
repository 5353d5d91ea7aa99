"""Tables of the store.

Evidence is append-only: triggers refuse to change or delete a row. Only an interval that is open
can be closed (`CLOSES`). Times are UTC, quantities in SI units.

Section: docs/store.md#tables
"""

from __future__ import annotations

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


def _key() -> sa.Column[int]:
    return sa.Column("id", Id, primary_key=True)


def _of(table: str, name: str = "", needed: bool = True) -> sa.Column[int]:
    column = name or f"{table.removesuffix('s')}_id"
    return sa.Column(column, Id, sa.ForeignKey(f"{table}.id"), nullable=not needed)


def _needed(name: str, kind: Any) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=False)


metadata = sa.MetaData()

robots = sa.Table(
    "robots", metadata, _key(), sa.Column("name", Text, nullable=False, unique=True),
    _needed("added", Utc),
)  # fmt: skip
"""One row a robot; its name is its own, not that of its kind."""

profiles = sa.Table(
    "profiles",
    metadata,
    _key(),
    _of("robots"),
    _needed("name", Text),
    _needed("arm_class", Text),
    _needed("document", Text),
    _needed("sha256", Text),
    _needed("added", Utc),
    sa.UniqueConstraint("robot_id", "sha256"),
)
"""Profiles of a robot, as text; the last one is in force."""

sensors = sa.Table(
    "sensors",
    metadata,
    _key(),
    sa.Column("profile_id", Id, sa.ForeignKey("profiles.id"), nullable=False, index=True),
    _needed("kind", Text),
    _needed("details", Json),
)
"""Sensors that a profile states."""

calibrations = sa.Table(
    "calibrations",
    metadata,
    _key(),
    _of("robots"),
    _needed("name", Text),
    _needed("protocol", Text),
    _needed("document", Text),
    _needed("sha256", Text),
    _needed("version", Text),
    _needed("valid_from", Utc),
    sa.Column("valid_to", Utc),
    sa.Index("ix_calibrations_robot", "robot_id", "valid_from"),
)
"""Calibrations of a robot as TOML; `valid_to` is empty for the one in force."""

sessions = sa.Table(
    "sessions",
    metadata,
    _key(),
    _of("robots"),
    _of("calibrations", needed=False),
    _needed("begun", Utc),
    _needed("version", Text),
    _needed("method", Text),
    _needed("protocol", Text),
    sa.Column("command", Text, nullable=False, server_default="diagnose"),
    sa.Column("diagnosed", Json, nullable=False, server_default="{}"),
    sa.Index("ix_sessions_robot", "robot_id", "id"),
)
"""What a command did with a robot: version of the package, method, calibration it rests on.

`diagnosed` counts by state all diagnoses of the robot up to this row, without those behind
notes: a history need not count them."""

logs = sa.Table(
    "logs",
    metadata,
    _key(),
    _of("robots"),
    _needed("path", Text),
    sa.Column("sha256", Text),
    _needed("bytes", sa.BigInteger()),
    _needed("recorded", Utc),
    _needed("added", Utc),
    sa.UniqueConstraint("robot_id", "sha256"),
)
"""Logs by reference: the bulk stays in the file."""

runs = sa.Table(
    "runs",
    metadata,
    _key(),
    _of("logs"),
    _needed("position", sa.Integer()),
    _needed("name", Text),
    sa.Column("details", Json),
    sa.UniqueConstraint("log_id", "position", "name"),
)
"""Runs of a log, in its order; details: duration [s], sensor rate [Hz]."""

diagnoses = sa.Table(
    "diagnoses",
    metadata,
    _key(),
    _of("sessions"),
    sa.Column("run_id", Id, sa.ForeignKey("runs.id"), nullable=False, index=True),
    _of("robots"),
    _needed("at", Utc),
    _needed("state", Text),
    sa.Column("hypothesis", Text),
    sa.Column("probability", sa.Double()),
    _needed("posterior", Json),
    sa.Column("onset_s", sa.Double()),
    sa.Column("onset_low_s", sa.Double()),
    sa.Column("onset_high_s", sa.Double()),
    sa.Column("magnitude", sa.Double()),
    sa.Column("magnitude_unit", Text),
    sa.Column("magnitude_low", sa.Double()),
    sa.Column("magnitude_high", sa.Double()),
    _needed("verdict", Text),
    _needed("undecided", Text),
    _needed("quality", Json),
    _needed("digest", Text),
    sa.Index("ix_diagnoses_robot", "robot_id", "at"),
)
"""Diagnoses of runs; intervals hold 90 %, `magnitude` is in the unit of its fault mode."""

episodes = sa.Table(
    "episodes",
    metadata,
    _key(),
    _of("robots"),
    _needed("number", sa.Integer()),
    _needed("motor", Text),
    _needed("mode", Text),
    _needed("since", Utc),
    sa.Column("until", Utc),
    sa.UniqueConstraint("robot_id", "number"),
)
"""Fault episodes of a robot, numbered from 1; `until` is empty while the fault lasts."""

episode_events = sa.Table(
    "episode_events",
    metadata,
    _key(),
    sa.Column("episode_id", Id, sa.ForeignKey("episodes.id"), nullable=False, index=True),
    _of("diagnoses", "diagnosis_id"),
    _needed("state", Text),
    _needed("at", Utc),
)
"""Changes of the state of an episode, and the diagnosis behind each."""

findings = sa.Table(
    "findings",
    metadata,
    _key(),
    sa.Column("episode_id", Id, sa.ForeignKey("episodes.id"), nullable=False, index=True),
    _of("findings", "withdraws", needed=False),
    _needed("verdict", Text),
    _needed("cause", Text),
    _needed("person", Text),
    _needed("note", Text),
    _needed("at", Utc),
)
"""What people found; a row with `withdraws` takes an earlier one back."""

notes = sa.Table(
    "notes",
    metadata,
    _key(),
    _of("sessions"),
    _of("robots"),
    sa.Column("diagnosis_id", Id, sa.ForeignKey("diagnoses.id"), index=True),
    _needed("at", Utc),
    _needed("text", Text),
    sa.Index("ix_notes_robot", "robot_id", "at"),
)
"""What happened in a session, a sentence each, and the diagnosis behind it."""

offsets = sa.Table(
    "offsets",
    metadata,
    _key(),
    _of("sessions"),
    _of("robots"),
    _needed("at", Utc),
    _needed("motor", Text),
    _needed("name", Text),
    _needed("value", sa.Double()),
    _needed("deviation", sa.Double()),
    _needed("unit", Text),
    sa.Index("ix_offsets_robot", "robot_id", "at"),
)
"""Offsets of the motors as a session found them: mean and standard deviation."""

beliefs = sa.Table(
    "beliefs",
    metadata,
    _key(),
    _of("sessions"),
    _of("robots"),
    _needed("follower", Text),
    _needed("start", Text),
    _needed("runs", sa.Integer()),
    _needed("rows", Json),
    _needed("arrays", sa.LargeBinary()),
    sa.Index("ix_beliefs_robot", "robot_id", "follower"),
)
"""Posterior of theta of a robot after a session, its new runs, and the start of it all."""

residuals = sa.Table(
    "residuals",
    metadata,
    _key(),
    sa.Column("diagnosis_id", Id, sa.ForeignKey("diagnoses.id"), nullable=False, index=True),
    _of("robots"),
    _needed("at", Utc),
    _needed("motor", Text),
    _needed("unit", Text),
    _needed("movements", Json),
)
"""Displacements of a motor where `unknown` is most probable, a list a quantity; see
`core.hypothesis.MotorResidual`."""

repairs = sa.Table(
    "repairs",
    metadata,
    _key(),
    sa.Column("robot_id", Id, sa.ForeignKey("robots.id"), nullable=False, index=True),
    _needed("motor", Text),
    _needed("part", Text),
    _needed("person", Text),
    _needed("note", Text),
    _needed("at", Utc),
)
"""Repairs and replaced parts."""

withdrawals = sa.Table(
    "withdrawals",
    metadata,
    _key(),
    _of("repairs"),
    _needed("person", Text),
    _needed("note", Text),
    _needed("at", Utc),
)
"""Repairs that somebody took back; both rows stay."""

STANDING = ~sa.exists().where(withdrawals.c.repair_id == repairs.c.id)
"""Whether a repair was not withdrawn."""
