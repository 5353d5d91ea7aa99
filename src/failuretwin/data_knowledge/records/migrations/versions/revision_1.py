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
    _make("robots", sa.Column("name", TEXT, nullable=False, unique=True), *_needed(TIME, "added"))
    _make(
        "profiles",
        _of("robots", "robot_id"),
        *_needed(TEXT, "name", "arm_class", "document", "sha256"),
        *_needed(TIME, "added"),
        sa.UniqueConstraint("robot_id", "sha256"),
    )
    _make(
        "sensors", _of("profiles", "profile_id"), *_needed(TEXT, "kind"), *_needed(JSON, "details")
    )
    op.create_index("ix_sensors_profile_id", "sensors", ["profile_id"])
    _make(
        "calibrations",
        _of("robots", "robot_id"),
        *_needed(TEXT, "name", "protocol", "document", "sha256", "version"),
        *_needed(TIME, "valid_from"),
        sa.Column("valid_to", TIME),
    )
    op.create_index("ix_calibrations_robot", "calibrations", ["robot_id", "valid_from"])
    _make(
        "repairs",
        _of("robots", "robot_id"),
        *_needed(TEXT, "motor", "part", "person", "note"),
        *_needed(TIME, "at"),
    )
    op.create_index("ix_repairs_robot_id", "repairs", ["robot_id"])


def _logs() -> None:
    _make(
        "logs",
        _of("robots", "robot_id"),
        *_needed(TEXT, "path"),
        sa.Column("sha256", TEXT),
        *_needed(sa.BigInteger(), "bytes"),
        *_needed(TIME, "recorded", "added"),
        sa.UniqueConstraint("robot_id", "sha256"),
    )
    _make(
        "runs",
        _of("logs", "log_id"),
        *_needed(sa.Integer(), "position"),
        *_needed(TEXT, "name"),
        sa.Column("details", JSON),
        sa.UniqueConstraint("log_id", "position", "name"),
    )


def _diagnoses() -> None:
    _make(
        "sessions",
        _of("robots", "robot_id"),
        _of("calibrations", "calibration_id", nullable=True),
        *_needed(TIME, "begun"),
        *_needed(TEXT, "version", "method", "protocol"),
    )
    figures = ("onset_s", "onset_low_s", "onset_high_s", "magnitude")
    _make(
        "diagnoses",
        _of("sessions", "session_id"),
        _of("runs", "run_id"),
        _of("robots", "robot_id"),
        *_needed(TIME, "at"),
        *_needed(TEXT, "state"),
        sa.Column("hypothesis", TEXT),
        sa.Column("probability", REAL),
        *_needed(JSON, "posterior"),
        *(sa.Column(name, REAL) for name in figures),
        sa.Column("magnitude_unit", TEXT),
        *(sa.Column(name, REAL) for name in ("magnitude_low", "magnitude_high")),
        *_needed(TEXT, "verdict", "undecided"),
        *_needed(JSON, "quality"),
        *_needed(TEXT, "digest"),
    )
    op.create_index("ix_diagnoses_run_id", "diagnoses", ["run_id"])
    op.create_index("ix_diagnoses_robot", "diagnoses", ["robot_id", "at"])
    op.create_index("ix_diagnoses_state", "diagnoses", ["robot_id", "state"])


def _episodes() -> None:
    _make(
        "episodes",
        _of("robots", "robot_id"),
        *_needed(sa.Integer(), "number"),
        *_needed(TEXT, "motor", "mode"),
        *_needed(TIME, "since"),
        sa.Column("until", TIME),
        sa.UniqueConstraint("robot_id", "number"),
    )
    _make(
        "episode_events",
        _of("episodes", "episode_id"),
        _of("diagnoses", "diagnosis_id"),
        *_needed(TEXT, "state"),
        *_needed(TIME, "at"),
    )
    op.create_index("ix_episode_events_episode_id", "episode_events", ["episode_id"])
    _make(
        "findings",
        _of("episodes", "episode_id"),
        _of("findings", "withdraws", nullable=True),
        *_needed(TEXT, "verdict", "cause", "person", "note"),
        *_needed(TIME, "at"),
    )
    op.create_index("ix_findings_episode_id", "findings", ["episode_id"])


def _make(table: str, *parts: Any) -> None:
    op.create_table(table, sa.Column("id", ID, primary_key=True), *parts)


def _of(table: str, column: str, nullable: bool = False) -> sa.Column[int]:
    return sa.Column(column, ID, sa.ForeignKey(f"{table}.id"), nullable=nullable)


def _needed(kind: Any, *names: str) -> list[sa.Column[Any]]:
    return [sa.Column(name, kind, nullable=False) for name in names]
