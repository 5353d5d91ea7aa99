"""The database of a store: its URL, transactions, revision, and errors in plain words."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, SQLAlchemyError
from sqlalchemy.pool import NullPool

from failuretwin import __version__
from failuretwin.core.errors import InputError, OutputError, needs_extra, one_line
from failuretwin.data_knowledge.records import migrations
from failuretwin.data_knowledge.records.schema import storable
from failuretwin.data_knowledge.store import PATIENCE_S, check_writable

EXPECTED = "Expected the path of an SQLite file or postgresql://USER@HOST/DATABASE."
DRIVERS = {
    "sqlite": "sqlite+pysqlite",
    "postgresql": "postgresql+psycopg",
    "postgres": "postgresql+psycopg",
}
LOCK = 0x6661696C  # of the upgrade; any fixed number
CAUSES = (
    (
        ("locked", "lock timeout"),
        f"another program has been writing to it for {PATIENCE_S:g} s",
        "Wait until it is done and run the command again.",
    ),
    (
        ("is full", "no space left", "disk i/o", "file too large"),
        "the disk is full",
        "Free some space and run the command again.",
    ),
    (
        ("readonly", "read-only", "permission denied"),
        "it cannot be written",
        "Allow writing to it and its folder, or choose another store.",
    ),
    (
        ("unable to open",),
        "it cannot be opened",
        "Check that the file and its folder can be read and written.",
    ),
    (
        ("not a database", "malformed"),
        "it is not an SQLite database, or is damaged",
        "Expected a file of `failuretwin store init`; restore it from a copy.",
    ),
    (
        ("append-only",),
        "evidence is neither changed nor deleted",
        "Add a new row that says what is true now.",
    ),
)
"""Words in errors of databases, what they mean, and how to fix it."""


def parse_url(url: str | Path) -> sa.URL:
    """Return the URL of a store with its driver; a plain path is that of an SQLite file.

    Raises:
        InputError: If it is no URL, or one of another kind of database.
    """
    text = str(url)
    if "://" not in text:
        return sa.URL.create(DRIVERS["sqlite"], database=text or None)
    try:
        parsed = sa.make_url(text)
    except (ArgumentError, ValueError) as error:
        raise InputError(f"the store's URL cannot be read. {EXPECTED}") from error
    kind = parsed.get_backend_name()
    if kind not in DRIVERS:
        raise InputError(f"store of kind {kind!r} is not supported. {EXPECTED}")
    return parsed.set(drivername=DRIVERS[kind])


class Database:
    """Transactions on the database of a store; no connection is held between them.

    Attributes:
        file: The SQLite file, absolute; None: a server.
        name: Path as given, or URL without the password, for texts.
    """

    def __init__(self, url: str | Path) -> None:
        parsed = parse_url(url)
        sqlite = parsed.get_backend_name() == "sqlite"
        if not parsed.database or parsed.database == ":memory:":
            raise InputError(f"the store's URL names no database. {EXPECTED}")
        path = Path(parsed.database)
        self.name = str(path) if sqlite else _shown(parsed)
        self.file = path.absolute() if sqlite else None
        if self.file is not None:  # engines are kept, whatever folder a process goes to
            parsed = parsed.set(database=str(self.file))
        with needs_extra("stores on PostgreSQL need psycopg", "store"):
            self._engine = _engine(parsed, PATIENCE_S)
        self._one_state = {} if sqlite else {"isolation_level": "REPEATABLE READ"}

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Give a connection that sees one state of the store.

        Raises:
            InputError: If the database fails.
        """
        try:
            with self._engine.connect() as plain:
                connection = plain.execution_options(**self._one_state)
                with connection.begin():
                    yield connection
        except SQLAlchemyError as error:
            raise InputError(self._in_words(error, "")) from error

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Give a connection whose changes are stored together at the end, or not at all.

        Raises:
            OutputError: If the database fails.
        """
        try:
            with self._engine.connect() as plain:
                connection = plain.execution_options(writing=True)
                with connection.begin():
                    yield connection
        except SQLAlchemyError as error:
            raise OutputError(self._in_words(error, " Nothing of this was stored.")) from error

    def _in_words(self, error: SQLAlchemyError, end: str) -> str:
        text = str(getattr(error, "orig", None) or error)
        for words, meaning, fix in CAUSES:
            if any(word in text.lower() for word in words):
                return f"{self.name}: {meaning} ({one_line(text)}).{end} {fix}"
        server = "that the server runs, and user, password and database"
        place = "the file" if self.file else server
        said = one_line(text).rstrip(".?")
        return f"{self.name}: {said}.{end} Check {place}, then run the command again."

    # The schema.

    def create(self) -> None:
        """Make the tables; a store that is there already stays as it is.

        Raises:
            InputError: If it is a store of another revision, or another kind of database.
            OutputError: If it cannot be made; no file is left behind.
        """
        new = self.file is not None and not self.file.exists()
        if self.file is not None:
            check_writable(self.file)
        try:
            self._make_tables()
        except (InputError, OutputError):
            if self.file is not None and new:
                for end in ("", "-wal", "-shm", "-journal"):
                    with suppress(OSError):
                        self.file.with_name(self.file.name + end).unlink()
            raise
        self.check_revision()
        if self.file is not None:
            self._let_readers_in()

    def _let_readers_in(self) -> None:
        """Let SQLite read while another program writes (write-ahead log)."""
        connection = self._engine.raw_connection()
        try:
            connection.cursor().execute("PRAGMA journal_mode=WAL")
        finally:
            connection.close()

    def _make_tables(self) -> None:
        with self.writing() as connection:
            _only_upgrade(connection)
            if migrations.revision_of(connection) is None and not _tables(connection):
                migrations.upgrade(connection)

    def upgrade(self) -> tuple[str, str]:
        """Bring the tables to the revision of this version; return the revisions before and after.

        Raises:
            InputError: If there is no store, or it is newer than this version.
            OutputError: If it cannot be written; it is as before.
        """
        self._check_file()
        with self.writing() as connection:
            _only_upgrade(connection)
            before = self._known_revision(connection)
            migrations.upgrade(connection)
        return before, migrations.HEAD

    def check_revision(self) -> None:
        """Raise InputError unless this is a store of the revision of this version."""
        self._check_file()
        with suppress(SQLAlchemyError), self._engine.connect() as connection:
            if migrations.stated_revision(connection) == migrations.HEAD:
                return
        with self.reading() as connection:
            revision = self._known_revision(connection)
        if revision != migrations.HEAD:
            raise InputError(
                f"{self.name}: has schema revision {revision}, expected {migrations.HEAD}. Bring "
                f"it up to date: failuretwin store upgrade --store {self.name}"
            )

    def _check_file(self) -> None:
        if self.file is not None and self.file.is_dir():
            raise InputError(f"{self.name}: is a folder. {EXPECTED}")
        if self.file is not None and not self.file.exists():
            raise InputError(f"{self.name}: does not exist. {self._make_it}")

    @property
    def _make_it(self) -> str:
        return f"Make it first: failuretwin store init --store {self.name}"

    def _known_revision(self, connection: sa.Connection) -> str:
        revision = migrations.revision_of(connection)
        if revision is None and _tables(connection):
            raise InputError(
                f"{self.name}: is a database with other tables, expected a store. Choose another "
                "name, or another database of the server."
            )
        if revision is None:
            raise InputError(f"{self.name}: holds no store yet. {self._make_it}")
        if revision != migrations.HEAD and revision not in migrations.revisions():
            raise InputError(
                f"{self.name}: has schema revision {revision!r}, which failuretwin {__version__} "
                f"does not know (its own is {migrations.HEAD}). Install a newer failuretwin."
            )
        return revision


def _json(value: Any) -> str:
    return storable(json.dumps(value, ensure_ascii=False))


def _shown(url: sa.URL) -> str:
    """Return a URL as users write it, without the password."""
    return url.set(drivername=url.get_backend_name()).render_as_string(hide_password=True)


def _tables(connection: sa.Connection) -> list[str]:
    return sa.inspect(connection).get_table_names()


@cache
def _engine(url: sa.URL, patience_s: float) -> sa.Engine:
    """Return the engine of a database, which remembers compiled statements but no connection."""
    sqlite = url.get_backend_name() == "sqlite"
    own: dict[str, Any] = {} if sqlite else {"use_native_hstore": False}
    engine = sa.create_engine(
        url,
        poolclass=NullPool,
        connect_args=_arguments(url, patience_s),
        json_serializer=_json,
        **own,
    )
    if sqlite:
        sa.event.listen(engine, "connect", _set_up_sqlite)
        sa.event.listen(engine, "begin", _begin_sqlite)
    return engine


def _arguments(url: sa.URL, patience_s: float) -> dict[str, Any]:
    """Return how long the driver waits for a connection and for other writers [s]."""
    if url.get_backend_name() == "sqlite":
        return {"timeout": patience_s}
    waits = {
        "connect_timeout": int(patience_s),
        "options": f"-c lock_timeout={1000 * patience_s:.0f}",
    }
    return {name: value for name, value in waits.items() if name not in url.query}


def _set_up_sqlite(connection: Any, record: object) -> None:
    """Let SQLAlchemy alone begin transactions; check references; wait for the disk."""
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.close()


def _begin_sqlite(connection: sa.Connection) -> None:
    """Take the lock of a writer at once, so that it never has to give up what it has read."""
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _only_upgrade(connection: sa.Connection) -> None:
    """Keep other programs from making or upgrading the tables of a server meanwhile."""
    if connection.dialect.name == "postgresql":
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(LOCK)))
