"""Offsets of the motors over time: what checks measured and what runs taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from failuretwin.data_knowledge.records.schema import SessionRows, add_rows, offsets, sessions

POINTS = 20
"""Sessions that a drift shows at most."""


@dataclass(frozen=True)
class MotorOffset:
    """An offset of a motor.

    Attributes:
        motor: The motor.
        name: ``zero`` or ``play`` of a check; ``bias``, ``compliance`` or ``friction`` of theta.
        value: Posterior mean.
        deviation: Posterior standard deviation.
        unit: Unit of both.
    """

    motor: str
    name: str
    value: float
    deviation: float
    unit: str


@dataclass(frozen=True)
class Drift:
    """An offset of a motor over time, at most `POINTS` sessions, first and last among them.

    Attributes:
        motor: The motor.
        name: Name of the offset.
        unit: Unit of values and deviations.
        at: Times (UTC), the oldest first.
        values: Posterior means.
        deviations: Posterior standard deviations.
    """

    motor: str
    name: str
    unit: str
    at: tuple[datetime, ...]
    values: tuple[float, ...]
    deviations: tuple[float, ...]

    @property
    def change(self) -> float:
        """Last value minus the first."""
        return self.values[-1] - self.values[0]


def add_offsets(
    connection: sa.Connection,
    rows: SessionRows,
    at: datetime,
    found: Sequence[MotorOffset],
) -> None:
    """Store the offsets that a session found at a time (UTC)."""
    of = {**rows.columns, "at": at}
    add_rows(connection, offsets, [{**asdict(one), **of} for one in found])


def read_drifts(connection: sa.Connection, robot: int) -> tuple[Drift, ...]:
    """Return the offsets of a robot over time, motor by motor.

    Offsets of sessions with another healthy behaviour than the last have another reference, and
    are left out.
    """
    of = offsets.c.robot_id == robot
    query = sa.select(offsets.c.name, offsets.c.at, offsets.c.session_id, sessions.c.method)
    query = query.join(sessions).distinct().where(of).order_by(offsets.c.at, offsets.c.session_id)
    every = connection.execute(query).all()
    last = {name: method for name, _, _, method in every}
    times: dict[str, list[tuple[datetime, int]]] = {}
    for name, at, session, method in every:
        if method == last[name]:
            times.setdefault(name, []).append((at, session))
    found: dict[tuple[str, str, str], list[Any]] = {}
    for name, known in times.items():
        shown = _thinned(known)
        rows = sa.select(offsets).where(of, offsets.c.name == name)
        rows = rows.where(offsets.c.at.in_([at for at, _ in shown]))
        rows = rows.where(offsets.c.session_id.in_([session for _, session in shown]))
        for one in connection.execute(rows.order_by(offsets.c.at, offsets.c.id)):
            found.setdefault((one.motor, one.name, one.unit), []).append(one)
    columns = ("at", "value", "deviation")
    return tuple(
        Drift(*key, *(tuple(getattr(one, column) for one in rows) for column in columns))
        for key, rows in sorted(found.items())
    )


def _thinned(known: Sequence[tuple[datetime, int]]) -> list[tuple[datetime, int]]:
    """Return at most `POINTS` of some sessions, evenly, first and last among them."""
    count = min(POINTS, len(known))
    return [known[(len(known) - 1) * k // max(1, count - 1)] for k in range(count)]
