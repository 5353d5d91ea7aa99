"""Revision 5: sessions count the diagnoses of their robot, so that a history need not."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from failuretwin.data_knowledge.records.migrations.versions.revision_1 import JSON
from failuretwin.data_knowledge.records.migrations.versions.revision_2 import guard

revision = "5"
down_revision = "4"

COUNT = """
UPDATE sessions SET diagnosed = (
    SELECT coalesce(AGGREGATE(state, runs), '{}') FROM (
        SELECT state, count(*) AS runs FROM diagnoses
        WHERE diagnoses.robot_id = sessions.robot_id
        AND NOT EXISTS (SELECT 1 FROM notes WHERE notes.diagnosis_id = diagnoses.id)
        GROUP BY state
    ) AS states
) WHERE id IN (SELECT max(id) FROM sessions GROUP BY robot_id)
"""
"""The last session of each robot gets the counts; earlier ones keep none."""


def upgrade() -> None:
    """Add the counts, and replace the index by which they were counted."""
    diagnosed = sa.Column("diagnosed", JSON, nullable=False, server_default="{}")
    op.add_column("sessions", diagnosed)
    _count()
    op.create_index("ix_sessions_robot", "sessions", ["robot_id", "id"])
    op.drop_index("ix_diagnoses_state", "diagnoses")


def _count() -> None:
    """Fill the counts; the guard of the table lets nobody change it but this."""
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE sessions DISABLE TRIGGER sessions_append_only")
        op.execute(COUNT.replace("AGGREGATE", "jsonb_object_agg"))
        op.execute("ALTER TABLE sessions ENABLE TRIGGER sessions_append_only")
        return
    for event in ("update", "delete", "insert"):
        op.execute(f"DROP TRIGGER sessions_no_{event}")
    op.execute(COUNT.replace("AGGREGATE", "json_group_object"))
    guard(("sessions",))
