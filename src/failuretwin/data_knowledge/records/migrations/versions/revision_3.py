"""Revision 3: sessions of all commands, what happened in them, offsets and beliefs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from failuretwin.data_knowledge.records.migrations.versions.revision_1 import (
    JSON,
    REAL,
    TEXT,
    TIME,
    make,
    needed,
    refers_to,
)
from failuretwin.data_knowledge.records.migrations.versions.revision_2 import guard

revision = "3"
down_revision = "2"


def upgrade() -> None:
    """Add the command of a session, and the tables."""
    command = sa.Column("command", TEXT, nullable=False, server_default="diagnose")
    op.add_column("sessions", command)
    _notes()
    _offsets()
    _beliefs()
    guard(("notes", "offsets", "beliefs"))


def _notes() -> None:
    make(
        "notes",
        *_of_a_session(),
        refers_to("diagnoses", "diagnosis_id", nullable=True),
        *needed(TIME, "at"),
        *needed(TEXT, "text"),
    )
    op.create_index("ix_notes_diagnosis_id", "notes", ["diagnosis_id"])
    op.create_index("ix_notes_robot", "notes", ["robot_id", "at"])


def _offsets() -> None:
    make(
        "offsets",
        *_of_a_session(),
        *needed(TIME, "at"),
        *needed(TEXT, "motor", "name"),
        *needed(REAL, "value", "deviation"),
        *needed(TEXT, "unit"),
    )
    op.create_index("ix_offsets_robot", "offsets", ["robot_id", "at"])


def _beliefs() -> None:
    make(
        "beliefs",
        *_of_a_session(),
        *needed(TEXT, "follower", "start"),
        *needed(sa.Integer(), "runs"),
        *needed(JSON, "rows"),
        *needed(sa.LargeBinary(), "arrays"),
    )
    op.create_index("ix_beliefs_robot", "beliefs", ["robot_id", "follower"])


def _of_a_session() -> list[sa.Column[int]]:
    return [refers_to("sessions", "session_id"), refers_to("robots", "robot_id")]
