"""Posteriors of theta: what is believed of a robot after a session, to go on from.

Each session adds a row; the posterior of the last one is the prior of the next. A row goes on from
those with the same follower, start and version, and holds its new runs alone.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from failuretwin import __version__
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.records.schema import SessionRows, add_rows, beliefs, sessions

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class BeliefLine:
    """A line of beliefs that go on from each other.

    Attributes:
        follower: What follows the robot: ``diagnose`` or ``watch``.
        start: What was believed before any run, as a checksum.
    """

    follower: str
    start: str


@dataclass(frozen=True)
class Belief:
    """What is believed of a robot after a session.

    Attributes:
        runs: Number of runs that it has learned from.
        arrays: The state, by name.
        rows: What is kept of runs, the oldest first: of all of its line if it was read from the
            store, of the new ones if it is to be stored.
        number: Number of the last belief of its line in the store; None: the line is new.
    """

    runs: int
    arrays: Arrays
    rows: Sequence[Mapping[str, Any]]
    number: int | None = None


def read_belief(connection: sa.Connection, robot: int, line: BeliefLine) -> Belief | None:
    """Return the last belief of a line; None: the line is new.

    Raises:
        InputError: If it is damaged.
    """
    last = sa.select(beliefs).join(sessions).where(_of(robot, line, __version__))
    found = connection.execute(last.order_by(beliefs.c.id.desc()).limit(1)).first()
    if found is None:
        return None
    rows = _rows_of(connection, _of(robot, line, __version__))
    return Belief(found.runs, _unpacked(found.arrays), rows, found.id)


def _of(robot: int, line: BeliefLine, version: str) -> sa.ColumnElement[bool]:
    return sa.and_(
        beliefs.c.robot_id == robot,
        beliefs.c.follower == line.follower,
        beliefs.c.start == line.start,
        sessions.c.version == version,
    )


def _rows_of(connection: sa.Connection, of: sa.ColumnElement[bool]) -> tuple[dict[str, Any], ...]:
    query = sa.select(beliefs.c.rows).join(sessions).where(of).order_by(beliefs.c.id)
    return tuple(row for rows in connection.scalars(query) for row in rows)


def _last(connection: sa.Connection, robot: int, follower: str) -> Any:
    """Return start, runs and version of the last belief of a follower; None: there is none."""
    query = sa.select(beliefs.c.start, beliefs.c.runs, sessions.c.version).join(sessions)
    of = beliefs.c.robot_id == robot, beliefs.c.follower == follower
    return connection.execute(query.where(*of).order_by(beliefs.c.id.desc()).limit(1)).first()


def latest_rows(connection: sa.Connection, robot: int, follower: str) -> tuple[dict[str, Any], ...]:
    """Return what is kept of each run of the line that was followed last, the oldest first."""
    last = _last(connection, robot, follower)
    if last is None:
        return ()
    return _rows_of(connection, _of(robot, BeliefLine(follower, last.start), last.version))


def other_line(connection: sa.Connection, robot: int, line: BeliefLine) -> str:
    """Return why the last belief of another line is not used; empty: there is none."""
    last = _last(connection, robot, line.follower)
    if last is None:
        return ""
    if last.start == line.start:
        return f"failuretwin {last.version} made it, and this is {__version__}"
    return "it began with another calibration"


def add_belief(
    connection: sa.Connection, rows: SessionRows, line: BeliefLine, belief: Belief
) -> int:
    """Store what is believed now as the end of a line, and return its number.

    The robot is locked.

    Raises:
        OutputError: If another session went on from the same belief.
    """
    last = (
        sa.select(sa.func.max(beliefs.c.id))
        .join(sessions)
        .where(_of(rows.robot, line, __version__))
    )
    if connection.scalar(last) != belief.number:
        raise OutputError(
            "another session has followed this robot since its belief was read. Nothing of this "
            "was stored. Run the command again."
        )
    stated: dict[str, Any] = {"follower": line.follower, "start": line.start, "runs": belief.runs}
    stated |= {"rows": [dict(row) for row in belief.rows], "arrays": _packed(belief.arrays)}
    return add_rows(connection, beliefs, [{**stated, **rows.columns}])[0]


def _packed(arrays: Arrays) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _unpacked(content: bytes) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (ValueError, OSError, KeyError) as error:
        raise InputError(
            f"a belief in the store is damaged ({error}). Restore the store from a copy."
        ) from error
