"""Revision 6: repairs that were withdrawn."""

from __future__ import annotations

from alembic import op

from failuretwin.data_knowledge.records.migrations.append_only import guard_table
from failuretwin.data_knowledge.records.schema import withdrawals

revision = "6"
down_revision = "5"


def upgrade() -> None:
    """Add the table."""
    connection = op.get_bind()
    withdrawals.create(connection)
    guard_table(connection, withdrawals)
