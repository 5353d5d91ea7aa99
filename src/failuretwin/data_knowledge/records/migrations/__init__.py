"""Migrations of the store's schema by alembic, which is loaded only to change tables.

A new store gets the tables of `schema`; an older one is brought there by the revisions after its
own. A new revision is a module in `versions` and the name in `HEAD`.
"""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING

import sqlalchemy as sa

from failuretwin.core.errors import needs_extra
from failuretwin.data_knowledge.records.migrations.append_only import guard
from failuretwin.data_knowledge.records.schema import metadata

if TYPE_CHECKING:
    from alembic.config import Config

HEAD = "6"
"""Revision that this version of the package reads and writes."""
REVISION_TABLE = "alembic_version"
"""Table in which alembic keeps the revision."""


def _config() -> Config:
    with needs_extra("tables of the store need alembic", "store"):
        from alembic.config import Config
    config = Config()
    config.set_main_option("script_location", str(files(__package__)).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def revisions() -> list[str]:
    """Return the known revisions, the oldest first."""
    config = _config()
    from alembic.script import ScriptDirectory

    script = ScriptDirectory.from_config(config)
    return [one.revision for one in script.walk_revisions()][::-1]


def revision_of(connection: sa.Connection) -> str | None:
    """Return the revision of a database; None where no store has been made."""
    if not sa.inspect(connection).has_table(REVISION_TABLE):
        return None
    return stated_revision(connection)


def stated_revision(connection: sa.Connection) -> str | None:
    """Return what the table of the revision states.

    Raises:
        sqlalchemy.exc.SQLAlchemyError: If there is no such table.
    """
    revision = sa.column("version_num", sa.String)
    return connection.scalar(sa.select(revision).select_from(sa.table(REVISION_TABLE)))


def upgrade(connection: sa.Connection) -> None:
    """Make the tables of a new store, or bring an older one to `HEAD`, in one transaction."""
    config = _config()
    from alembic import command

    config.attributes["connection"] = connection
    if revision_of(connection) is None:
        metadata.create_all(connection)
        guard(connection)
        command.stamp(config, HEAD)
    else:
        command.upgrade(config, HEAD)
