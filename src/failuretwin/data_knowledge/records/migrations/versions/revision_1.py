"""Revision 1: the tables."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "1"
down_revision = None

TEXT, TIME = sa.Text(), sa.DateTime(timezone=True)
REAL: sa.Double[float] = sa.Double()
JSON = sa.JSON().with_variant(JSONB(), "postgresql")
ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """Make the tables."""
    _robots()
    _logs()
    _diagnoses()
    _episodes()


def _robots() -> None:
    make("robots", sa.Column("name", TEXT, nullable=False, unique=True), *needed(TIME, "added"))
    make(
        "profiles",
        refers_to("robots", "robot_id"),
        *needed(TEXT, "name", "arm_class", "document", "sha256"),
        *needed(TIME, "added"),
        sa.UniqueConstraint("robot_id", "sha256"),
    )
    make(
        "sensors",
        refers_to("profiles", "profile_id"),
        *needed(TEXT, "kind"),
        *needed(JSON, "details"),
    )
    op.create_index("ix_sensors_profile_id", "sensors", ["profile_id"])
    make(
        "calibrations",
        refers_to("robots", "robot_id"),
        *needed(TEXT, "name", "protocol", "document", "sha256", "version"),
        *needed(TIME, "valid_from"),
        sa.Column("valid_to", TIME),
    )
    op.create_index("ix_calibrations_robot", "calibrations", ["robot_id", "valid_from"])
    make(
        "repairs",
        refers_to("robots", "robot_id"),
        *needed(TEXT, "motor", "part", "person", "note"),
        *needed(TIME, "at"),
    )
    op.create_index("ix_repairs_robot_id", "repairs", ["robot_id"])


def _logs() -> None:
    make(
        "logs",
        refers_to("robots", "robot_id"),
        *needed(TEXT, "path"),
        sa.Column("sha256", TEXT),
        *needed(sa.BigInteger(), "bytes"),
        *needed(TIME, "recorded", "added"),
        sa.UniqueConstraint("robot_id", "sha256"),
    )
    make(
        "runs",
        refers_to("logs", "log_id"),
        *needed(sa.Integer(), "position"),
        *needed(TEXT, "name"),
        sa.Column("details", JSON),
        sa.UniqueConstraint("log_id", "position", "name"),
    )


def _diagnoses() -> None:
    make(
        "sessions",
        refers_to("robots", "robot_id"),
        refers_to("calibrations", "calibration_id", nullable=True),
        *needed(TIME, "begun"),
        *needed(TEXT, "version", "method", "protocol"),
    )
    figures = ("onset_s", "onset_low_s", "onset_high_s", "magnitude")
    make(
        "diagnoses",
        refers_to("sessions", "session_id"),
        refers_to("runs", "run_id"),
        refers_to("robots", "robot_id"),
        *needed(TIME, "at"),
        *needed(TEXT, "state"),
        sa.Column("hypothesis", TEXT),
        sa.Column("probability", REAL),
        *needed(JSON, "posterior"),
        *(sa.Column(name, REAL) for name in figures),
        sa.Column("magnitude_unit", TEXT),
        *(sa.Column(name, REAL) for name in ("magnitude_low", "magnitude_high")),
        *needed(TEXT, "verdict", "undecided"),
        *needed(JSON, "quality"),
        *needed(TEXT, "digest"),
    )
    op.create_index("ix_diagnoses_run_id", "diagnoses", ["run_id"])
    op.create_index("ix_diagnoses_robot", "diagnoses", ["robot_id", "at"])
    op.create_index("ix_diagnoses_state", "diagnoses", ["robot_id", "state"])


def _episodes() -> None:
    make(
        "episodes",
        refers_to("robots", "robot_id"),
        *needed(sa.Integer(), "number"),
        *needed(TEXT, "motor", "mode"),
        *needed(TIME, "since"),
        sa.Column("until", TIME),
        sa.UniqueConstraint("robot_id", "number"),
    )
    make(
        "episode_events",
        refers_to("episodes", "episode_id"),
        refers_to("diagnoses", "diagnosis_id"),
        *needed(TEXT, "state"),
        *needed(TIME, "at"),
    )
    op.create_index("ix_episode_events_episode_id", "episode_events", ["episode_id"])
    make(
        "findings",
        refers_to("episodes", "episode_id"),
        refers_to("findings", "withdraws", nullable=True),
        *needed(TEXT, "verdict", "cause", "person", "note"),
        *needed(TIME, "at"),
    )
    op.create_index("ix_findings_episode_id", "findings", ["episode_id"])


def make(table: str, *parts: Any) -> None:
    """Make a table with a key."""
    op.create_table(table, sa.Column("id", ID, primary_key=True), *parts)


def refers_to(table: str, column: str, nullable: bool = False) -> sa.Column[int]:
    """Return a column that refers to another table."""
    return sa.Column(column, ID, sa.ForeignKey(f"{table}.id"), nullable=nullable)


def needed(kind: Any, *names: str) -> list[sa.Column[Any]]:
    """Return columns that are never null."""
    return [sa.Column(name, kind, nullable=False) for name in names]
