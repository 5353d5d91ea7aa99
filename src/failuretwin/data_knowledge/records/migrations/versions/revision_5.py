"""Revision 5: the schema of the first release; a new store gets it as a whole."""

from __future__ import annotations

revision = "5"
down_revision = None


def upgrade() -> None:
    """Change nothing: there is no older schema."""
