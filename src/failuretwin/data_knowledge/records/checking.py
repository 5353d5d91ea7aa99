"""Whether a store is undamaged, and its logs are where they were and as they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import sqlalchemy as sa

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.records import migrations
from failuretwin.data_knowledge.records.log_files import log_file
from failuretwin.data_knowledge.records.schema import logs, metadata


@dataclass(frozen=True)
class StoreCheck:
    """Result of `Store.check`.

    Attributes:
        revision: Revision of the schema.
        rows: Number of rows of each table.
        problems: Damage of the database, and logs that are missing or changed, one a line.
    """

    revision: str
    rows: Mapping[str, int]
    problems: tuple[str, ...]


def checked(connection: sa.Connection) -> StoreCheck:
    """Return the result of a check of the database and of the logs that it refers to."""
    rows = {
        table.name: connection.scalar(sa.select(sa.func.count()).select_from(table)) or 0
        for table in metadata.sorted_tables
    }
    query = sa.select(logs.c.path, logs.c.sha256).where(logs.c.sha256.is_not(None))
    of_logs = (_log_problem(*one) for one in connection.execute(query).all())
    problems = (*_damage(connection), *filter(None, of_logs))
    return StoreCheck(migrations.revision_of(connection) or "", rows, problems)


def _damage(connection: sa.Connection) -> list[str]:
    """Return the damage that SQLite finds; a server checks its own pages."""
    if connection.dialect.name != "sqlite":
        return []
    found = [str(row[0]) for row in connection.exec_driver_sql("PRAGMA integrity_check")]
    broken = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    found += [
        f"row {row[1]} of {row[0]} refers to a row of {row[2]} that is lost" for row in broken
    ]
    return [line for line in found if line != "ok"]


def _log_problem(path: str, sha256: str) -> str:
    try:
        now = log_file(path)
    except InputError:
        return f"log {path}: is missing"
    return "" if now.sha256 == sha256 else f"log {path}: has changed since it was diagnosed"
