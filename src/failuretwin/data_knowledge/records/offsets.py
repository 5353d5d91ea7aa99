"""Offsets of the motors over time: what checks measured and what runs taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime

import sqlalchemy as sa

from failuretwin.data_knowledge.records.schema import offsets
from failuretwin.data_knowledge.records.writing import SessionRows, add_rows


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


def add_offsets(
    connection: sa.Connection,
    rows: SessionRows,
    at: datetime,
    found: Sequence[MotorOffset],
) -> None:
    """Store the offsets that a session found at a time (UTC)."""
    of = {"robot_id": rows.robot, "session_id": rows.session, "at": at}
    add_rows(connection, offsets, [{**asdict(one), **of} for one in found])
