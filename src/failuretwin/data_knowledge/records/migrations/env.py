"""Environment of alembic: runs the revisions on the connection that it is given."""

from __future__ import annotations

from alembic import context

from failuretwin.data_knowledge.records.schema import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    transactional_ddl=False,  # the caller holds the transaction
)
context.run_migrations()
