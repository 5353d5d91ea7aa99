"""Revision 2: triggers that keep evidence append-only, also from other programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from alembic import op

revision = "2"
down_revision = "1"

APPEND_ONLY: tuple[str, ...] = (
    *("robots", "profiles", "sensors", "sessions", "logs", "runs", "diagnoses"),
    *("episode_events", "findings", "repairs"),
)
Closing = Mapping[str, tuple[str, tuple[str, ...]]]
"""Tables with an interval: column of its end, and the columns that stay as they are."""
CLOSING: Closing = {
    "calibrations": (
        "valid_to",
        ("id", "robot_id", "name", "protocol", "document", "sha256", "version", "valid_from"),
    ),
    "episodes": ("until", ("id", "robot_id", "number", "motor", "mode", "since")),
}
REFUSAL = "append-only: rows of % are neither changed nor deleted"

FUNCTION = f"""
CREATE FUNCTION failuretwin_append_only() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'UPDATE' AND TG_NARGS = 1 THEN
        IF to_jsonb(OLD) ->> TG_ARGV[0] IS NULL AND to_jsonb(NEW) ->> TG_ARGV[0] IS NOT NULL
            AND to_jsonb(OLD) - TG_ARGV[0] = to_jsonb(NEW) - TG_ARGV[0] THEN
            RETURN NEW;
        END IF;
    END IF;
    RAISE EXCEPTION '{REFUSAL}', TG_TABLE_NAME;
END $$
"""


def upgrade() -> None:
    """Add the triggers."""
    if op.get_bind().dialect.name == "postgresql":
        op.execute(FUNCTION)
    guard(APPEND_ONLY, CLOSING)


def guard(tables: Iterable[str], closing: Closing | None = None) -> None:
    """Add triggers that refuse changes to tables; the ends of `closing` may be set once."""
    closing = {} if closing is None else closing
    if op.get_bind().dialect.name == "sqlite":
        _on_sqlite(tables, closing)
    else:
        _on_postgresql(tables, closing)


def _on_sqlite(tables: Iterable[str], closing: Closing) -> None:
    for table in tables:
        _sqlite_trigger(table, "UPDATE")
    for table, (end, others) in closing.items():
        same = " AND ".join(f'OLD."{name}" IS NEW."{name}"' for name in others)
        closes = f'OLD."{end}" IS NULL AND NEW."{end}" IS NOT NULL AND {same}'
        _sqlite_trigger(table, "UPDATE", f"WHEN NOT ({closes})")
    for table in (*tables, *closing):
        _sqlite_trigger(table, "DELETE")
        # INSERT OR REPLACE deletes without a trigger of its own.
        _sqlite_trigger(table, "INSERT", f"WHEN EXISTS (SELECT 1 FROM {table} WHERE id = NEW.id)")


def _sqlite_trigger(table: str, event: str, when: str = "") -> None:
    refusal = REFUSAL.replace("%", table)
    op.execute(
        f"CREATE TRIGGER {table}_no_{event.lower()} BEFORE {event} ON {table} {when} "
        f"BEGIN SELECT RAISE(ABORT, '{refusal}'); END"
    )


def _on_postgresql(tables: Iterable[str], closing: Closing) -> None:
    ends = dict.fromkeys(tables, "") | {t: f"'{end}'" for t, (end, _) in closing.items()}
    for table, end in ends.items():
        call = "EXECUTE FUNCTION failuretwin_append_only"
        op.execute(
            f"CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE ON {table} "
            f"FOR EACH ROW {call}({end})"
        )
        op.execute(
            f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
            f"FOR EACH STATEMENT {call}()"
        )
