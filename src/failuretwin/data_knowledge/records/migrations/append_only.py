"""Triggers that keep evidence append-only, also from other programs."""

from __future__ import annotations

import sqlalchemy as sa

from failuretwin.data_knowledge.records.schema import CLOSES, metadata

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


def guard(connection: sa.Connection) -> None:
    """Add triggers that refuse changes; the end of an interval (`CLOSES`) may be set once."""
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(FUNCTION.replace("%", "%%"))
    for table in metadata.sorted_tables:
        guard_table(connection, table)


def guard_table(connection: sa.Connection, table: sa.Table) -> None:
    """Add the triggers of one table."""
    if connection.dialect.name == "sqlite":
        _on_sqlite(connection, table)
    else:
        _on_postgresql(connection, table.name)


def _on_sqlite(connection: sa.Connection, table: sa.Table) -> None:
    name, end = table.name, CLOSES.get(table.name)
    closes = "0"
    if end is not None:
        others = (column.name for column in table.columns if column.name != end)
        same = " AND ".join(f'OLD."{other}" IS NEW."{other}"' for other in others)
        closes = f'OLD."{end}" IS NULL AND NEW."{end}" IS NOT NULL AND {same}'
    refused = {
        "UPDATE": f"NOT ({closes})",
        "DELETE": "1",
        # INSERT OR REPLACE deletes without a trigger of its own.
        "INSERT": f"EXISTS (SELECT 1 FROM {name} WHERE id = NEW.id)",
    }
    for event, when in refused.items():
        connection.exec_driver_sql(
            f"CREATE TRIGGER {name}_no_{event.lower()} BEFORE {event} ON {name} WHEN {when} "
            f"BEGIN SELECT RAISE(ABORT, '{REFUSAL.replace('%', name)}'); END"
        )


def _on_postgresql(connection: sa.Connection, name: str) -> None:
    call = "EXECUTE FUNCTION failuretwin_append_only"
    end = f"'{CLOSES[name]}'" if name in CLOSES else ""
    connection.exec_driver_sql(
        f"CREATE TRIGGER {name}_append_only BEFORE UPDATE OR DELETE ON {name} "
        f"FOR EACH ROW {call}({end})"
    )
    connection.exec_driver_sql(
        f"CREATE TRIGGER {name}_no_truncate BEFORE TRUNCATE ON {name} FOR EACH STATEMENT {call}()"
    )
