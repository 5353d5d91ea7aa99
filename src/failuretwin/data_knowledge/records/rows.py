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
    """Insert rows and return their ids in the same order."""
    if not rows:
        return []
    statement = sa.insert(table).returning(table.c.id, sort_by_parameter_order=True)
    return list(connection.scalars(statement, [dict(row) for row in rows]))
