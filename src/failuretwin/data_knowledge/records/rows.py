"""Rows that refer to each other, and how they are inserted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa


@dataclass(frozen=True)
class SessionRows:
    """Rows that a session refers to: its own, that of its robot, and that of its run."""

    session: int
    robot: int
    run: int | None = None

    @property
    def columns(self) -> dict[str, Any]:
        """Columns by which rows of the session refer to it and its robot."""
        return {"session_id": self.session, "robot_id": self.robot}


@dataclass(frozen=True)
class Basis:
    """What the results of a session rest on.

    Attributes:
        command: The command.
        calibration: Row of the calibration; None: none of the store.
        method: Method of diagnosis; empty: nothing is diagnosed.
        protocol: Real data that it uses: P0, P0c, P1 or P2; empty: nothing is diagnosed.
    """

    command: str
    calibration: int | None = None
    method: str = ""
    protocol: str = ""


def add_rows(
    connection: sa.Connection, table: sa.Table, rows: Sequence[Mapping[str, Any]]
) -> list[int]:
    """Insert rows and return their ids in the same order.

    The ids of several rows are taken beforehand, so that the rows need no answer: drivers send such
    rows several times as fast.
    """
    if not rows:
        return []
    if len(rows) == 1:
        statement = sa.insert(table).returning(table.c.id)
        return [connection.scalars(statement, dict(rows[0])).one()]
    ids = _new_ids(connection, table, len(rows))
    numbered = [{**row, "id": number} for row, number in zip(rows, ids, strict=True)]
    connection.execute(sa.insert(table), numbered)
    return ids


def _new_ids(connection: sa.Connection, table: sa.Table, count: int) -> list[int]:
    """Return ids that no other row has or gets, ascending."""
    if connection.dialect.name == "sqlite":  # there is one writer at a time
        last = connection.scalar(sa.select(sa.func.max(table.c.id))) or 0
        return list(range(last + 1, last + 1 + count))
    sequence = sa.func.nextval(f"{table.name}_id_seq")
    numbers = sa.func.generate_series(1, count).table_valued("number")
    return sorted(connection.scalars(sa.select(sequence).select_from(numbers)))
