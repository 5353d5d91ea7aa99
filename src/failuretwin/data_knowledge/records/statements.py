"""What people state: findings about episodes, and calibrations that replace each other."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.records import writing
from failuretwin.data_knowledge.records.history import (
    FaultEpisode,
    StoredCalibration,
    read_calibrations,
    read_episodes,
)
from failuretwin.data_knowledge.records.rows import add_rows
from failuretwin.data_knowledge.records.schema import (
    STANDING,
    calibrations,
    findings,
    repairs,
    withdrawals,
)


def add_finding(
    connection: sa.Connection,
    robot: str,
    number: int,
    stated: Mapping[str, Any],
    withdraw: bool = False,
) -> FaultEpisode:
    """Store a finding about an episode, or withdraw the last one; return the episode.

    Raises:
        InputError: If there is no such robot or episode, or no finding to withdraw.
    """
    row = writing.find_locked(connection, robot)
    episode = _episode(connection, row, robot, number)
    standing = episode.finding if withdraw else None
    if withdraw and standing is None:
        raise InputError(
            f"episode {number} of {robot!r} has no finding to withdraw. Expected one of "
            "`failuretwin found`."
        )
    of = {"episode_id": episode.row, "withdraws": standing and standing.number}
    add_rows(connection, findings, [{**stated, **of}])
    return _episode(connection, row, robot, number)


def _episode(connection: sa.Connection, row: int, robot: str, number: int) -> FaultEpisode:
    all_of_it = read_episodes(connection, row)
    found = next((one for one in all_of_it if one.number == number), None)
    if found is None:
        valid = ", ".join(str(one.number) for one in all_of_it) or "none so far"
        raise InputError(f"robot {robot!r} has no episode {number}. Its episodes: {valid}.")
    return found


def withdraw_last_repair(
    connection: sa.Connection, robot: str, motor: str, stated: Mapping[str, Any]
) -> None:
    """Take back the last repair of a motor that stands.

    Raises:
        InputError: If there is no such robot, or no repair of that motor.
    """
    row = writing.find_locked(connection, robot)
    query = sa.select(repairs.c.id).where(repairs.c.robot_id == row, STANDING)
    query = query.where(repairs.c.motor == motor).order_by(repairs.c.id.desc()).limit(1)
    last = connection.scalar(query)
    if last is None:
        raise InputError(
            f"{motor} of {robot!r} has no repair to withdraw. Expected one of "
            "`failuretwin repaired`."
        )
    add_rows(connection, withdrawals, [{**stated, "repair_id": last, "at": datetime.now(UTC)}])


def calibration_in_force(connection: sa.Connection, robot: int) -> StoredCalibration | None:
    """Return the calibration of a robot whose validity has no end; None: it has none."""
    stored = read_calibrations(connection, robot)
    return next((one for one in stored if one.valid_to is None), None)


def replace_calibration(
    connection: sa.Connection, robot: int, stated: Mapping[str, Any], start: datetime
) -> StoredCalibration:
    """Store a calibration that is valid from `start` on, and return the one in force.

    Raises:
        InputError: If the calibration in force is newer.
    """
    current = calibration_in_force(connection, robot)
    if current is not None and current.document == stated["document"]:
        return current
    if current is not None:
        _close(connection, current, start)
    row = {**stated, "robot_id": robot, "valid_from": start}
    add_rows(connection, calibrations, [row])
    return read_calibrations(connection, robot)[-1]


def _close(connection: sa.Connection, current: StoredCalibration, end: datetime) -> None:
    if end < current.valid_from:
        raise InputError(
            f"calibration {current.name!r} is valid from {current.valid_from:%Y-%m-%d %H:%M}, "
            f"after {end:%Y-%m-%d %H:%M}. Expected a later time."
        )
    row = calibrations.c.id == current.number
    connection.execute(sa.update(calibrations).where(row).values(valid_to=end))
