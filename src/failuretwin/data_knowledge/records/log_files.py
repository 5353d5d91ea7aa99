"""Logs by reference: path, checksum, size and time; and whether a store and they are undamaged."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sa

from failuretwin.core.errors import InputError, reason
from failuretwin.data_knowledge.records import migrations
from failuretwin.data_knowledge.records.schema import logs, metadata


@dataclass(frozen=True)
class LogFile:
    """A log that runs were read from.

    Attributes:
        path: Absolute path of the file or folder.
        sha256: Checksum of its contents; None: there is no file.
        size_bytes: Size of its contents [bytes].
        recorded: When it was recorded (UTC).
    """

    path: str
    sha256: str | None
    size_bytes: int
    recorded: datetime


def log_file(path: str | Path, recorded: datetime | None = None) -> LogFile:
    """Return the reference to a file, or to a folder with all files below it.

    Args:
        path: The log.
        recorded: When it was recorded; None: when it was last modified.

    Raises:
        InputError: If it cannot be read.
    """
    path = Path(path)
    try:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        sizes = [(file.stat().st_size, file.stat().st_mtime) for file in files]
        if recorded is None:
            latest = max((modified for _, modified in sizes), default=path.stat().st_mtime)
            recorded = datetime.fromtimestamp(latest, UTC)
        size = sum(count for count, _ in sizes)
        return LogFile(str(path.absolute()), _checksum(path, files), size, utc(recorded))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({reason(error)}). Expected a log that exists."
        ) from error


def _checksum(path: Path, files: list[Path]) -> str:
    """Return the SHA-256 of a file, or of the names and checksums of the files of a folder."""
    if files == [path]:
        return _sha256(path)
    lines = [f"{_sha256(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256(os.fsencode("".join(lines))).hexdigest()


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def utc(time: datetime) -> datetime:
    """Return an instant in UTC; a time without a zone is UTC already."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


# Checks.


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
