"""Revision 6: repairs that were withdrawn."""

from __future__ import annotations

from failuretwin.data_knowledge.records.migrations.versions.revision_1 import (
    TEXT,
    TIME,
    make,
    needed,
    refers_to,
)
from failuretwin.data_knowledge.records.migrations.versions.revision_2 import guard

revision = "6"
down_revision = "5"


def upgrade() -> None:
    """Add the table."""
    make(
        "withdrawals",
        refers_to("repairs", "repair_id"),
        *needed(TEXT, "person", "note"),
        *needed(TIME, "at"),
    )
    guard(("withdrawals",))
