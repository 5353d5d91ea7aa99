"""Revision 4: residuals of runs that no known fault explains."""

from __future__ import annotations

from alembic import op

from failuretwin.data_knowledge.records.migrations.versions.revision_1 import (
    JSON,
    TEXT,
    TIME,
    make,
    needed,
    refers_to,
)
from failuretwin.data_knowledge.records.migrations.versions.revision_2 import guard

revision = "4"
down_revision = "3"


def upgrade() -> None:
    """Add the table."""
    make(
        "residuals",
        refers_to("diagnoses", "diagnosis_id"),
        refers_to("robots", "robot_id"),
        *needed(TIME, "at"),
        *needed(TEXT, "motor", "unit"),
        *needed(JSON, "movements"),
    )
    op.create_index("ix_residuals_diagnosis_id", "residuals", ["diagnosis_id"])
    guard(("residuals",))
