"""What the robots of a kind have gone through together: faults, ages, calibrations.

Section: docs/store.md#learned-rates-of-faults
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np
import sqlalchemy as sa

from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.records import writing
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.history import (
    OTHER_CAUSE,
    WRONG,
    StoredCalibration,
    stored_calibration,
)
from failuretwin.data_knowledge.records.schema import (
    STANDING,
    calibrations,
    diagnoses,
    episodes,
    findings,
    profiles,
    repairs,
    robots,
)

DAY_S, HOUR_S = 86_400.0, 3_600.0
AGE_BANDS_H = (0.0, 168.0, 2184.0, float("inf"))
"""Ages of a motor between which its rates of faults are constant [h]: a week, 13 weeks; assumed."""


# Parts of the questions: the profile in force, and the finding that stands.

_last_profile = (
    sa.select(profiles.c.robot_id, sa.func.max(profiles.c.id).label("profile"))
    .group_by(profiles.c.robot_id)
    .subquery()
)
kinds = (
    sa.select(robots.c.id.label("robot_id"), robots.c.name.label("robot"))
    .add_columns(sa.func.coalesce(profiles.c.name, "").label("kind"))
    .outerjoin(_last_profile, _last_profile.c.robot_id == robots.c.id)
    .outerjoin(profiles, profiles.c.id == _last_profile.c.profile)
    .subquery()
)
"""Robots with the name of their profile."""
_withdrawing = findings.alias("withdrawing")
_standing = (
    sa.select(findings.c.episode_id, sa.func.max(findings.c.id).label("finding"))
    .where(
        findings.c.withdraws.is_(None),
        ~sa.exists().where(_withdrawing.c.withdraws == findings.c.id),
    )
    .group_by(findings.c.episode_id)
    .subquery()
)
judged = (
    sa.select(episodes, findings.c.verdict, findings.c.cause, findings.c.person)
    .outerjoin(_standing, _standing.c.episode_id == episodes.c.id)
    .outerjoin(findings, findings.c.id == _standing.c.finding)
    .subquery()
)
"""Episodes with the finding that stands; null where there is none."""
_of_the_robot = diagnoses.c.robot_id == kinds.c.robot_id
FIRST_RUN = sa.select(sa.func.min(diagnoses.c.at)).where(_of_the_robot).scalar_subquery()
LAST_RUN = sa.select(sa.func.max(diagnoses.c.at)).where(_of_the_robot).scalar_subquery()
"""Times of the first and last run of each robot of `kinds`: one look into the index each."""
REFUTED = judged.c.verdict.in_([WRONG, OTHER_CAUSE]).is_(True)


# Time at risk and confirmed faults.


@dataclass(frozen=True)
class AgeBand:
    """Confirmed faults of a motor at some ages, over all robots of a kind.

    The age of a motor counts from its last stated repair, else from the first run of its robot.

    Attributes:
        low_h: Lowest age [h].
        high_h: Highest age [h].
        hours: Time that the motors spent at these ages [h].
        confirmed: Number of confirmed faults by ``MOTOR:MODE``.
    """

    low_h: float
    high_h: float
    hours: float
    confirmed: Mapping[str, int]


@dataclass(frozen=True)
class FleetFaults:
    """Confirmed faults of the robots of a kind.

    Attributes:
        kind: Name of their profile.
        robots: Number of robots.
        hours: Time from the first to the last run of each, in all [h].
        confirmed: Number of confirmed faults by ``MOTOR:MODE``.
        by_age: The same of each motor, by its age.
    """

    kind: str
    robots: int
    hours: float
    confirmed: Mapping[str, int]
    by_age: Mapping[str, Sequence[AgeBand]] = field(default_factory=dict)

    def at_risk(self, motor: str, age_h: float | None) -> AgeBand:
        """Return the time and the confirmed faults that tell the rates of a motor.

        Args:
            motor: The motor.
            age_h: Its age [h]; None: unknown, all ages count.
        """
        if age_h is not None:
            for band in self.by_age.get(motor, ()):
                if band.low_h <= age_h < band.high_h:
                    return band
        return AgeBand(0.0, float("inf"), self.hours, self.confirmed)


def fleet_faults(connection: sa.Connection, kind: str) -> FleetFaults:
    """Return the confirmed faults of the robots of a kind."""
    robot_count, days = watched_days(connection).get(kind, (0, 0.0))
    query = (
        sa.select(judged.c.robot_id, judged.c.motor, judged.c.mode, judged.c.since)
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .where(kinds.c.kind == kind, judged.c.verdict == CONFIRMED)
        .order_by(judged.c.motor, judged.c.mode, judged.c.since)
    )
    found = connection.execute(query).all()
    lives = [life for life in _lives(connection) if life.kind == kind]
    motors = sorted({motor for life in lives for motor in life.motors})
    by_age = {motor: _by_age(motor, lives, found) for motor in motors}
    return FleetFaults(kind, robot_count, 24.0 * days, _count(found), by_age)


@dataclass(frozen=True)
class _Life:
    """What a robot has lived: its row, kind, motors, first and last run, repairs by motor."""

    robot: int
    kind: str
    motors: Sequence[str]
    first: datetime
    last: datetime
    repairs: Mapping[str, Sequence[datetime]]

    def starts(self, motor: str) -> list[datetime]:
        """Return when a motor was new to the store or repaired, up to the last run."""
        known = (at for at in self.repairs.get(motor, ()) if self.first < at < self.last)
        return [self.first, *known]

    def age_h(self, motor: str, at: datetime) -> float:
        """Return the age of a motor [h]."""
        start = max((one for one in self.starts(motor) if one <= at), default=at)
        return (at - start).total_seconds() / HOUR_S


def _lives(connection: sa.Connection, robot: int | None = None) -> list[_Life]:
    """Return the lives of all robots with a run, or of one."""
    query = sa.select(kinds, FIRST_RUN.label("first"), LAST_RUN.label("last"))
    query = query.where(FIRST_RUN.is_not(None))
    if robot is not None:
        query = query.where(kinds.c.robot_id == robot)
    repaired: dict[int, dict[str, list[datetime]]] = {}
    for one in connection.execute(sa.select(repairs).where(STANDING).order_by(repairs.c.at)):
        repaired.setdefault(one.robot_id, {}).setdefault(one.motor, []).append(one.at)
    return [
        _Life(
            row.robot_id,
            row.kind,
            writing.motors_of(connection, row.robot_id),
            row.first,
            row.last,
            repaired.get(row.robot_id, {}),
        )
        for row in connection.execute(query)
    ]


def _by_age(motor: str, lives: Sequence[_Life], found: Sequence[Any]) -> list[AgeBand]:
    """Return the faults of a motor, and its time at risk, in each of `AGE_BANDS_H`."""
    hours = np.zeros(len(AGE_BANDS_H) - 1)
    for life in lives:
        hours += sum(_in_bands(span) for span in pairwise([*life.starts(motor), life.last]))
    of_robot = {life.robot: life for life in lives}
    own = [one for one in found if one.motor == motor and one.robot_id in of_robot]
    ages = [of_robot[one.robot_id].age_h(motor, one.since) for one in own]
    bands = list(pairwise(AGE_BANDS_H))
    inside = [[one for one, a in zip(own, ages, strict=True) if b[0] <= a < b[1]] for b in bands]
    return [AgeBand(*bands[k], float(hours[k]), _count(inside[k])) for k in range(len(bands))]


def _in_bands(span: tuple[datetime, datetime]) -> FloatArray:
    """Return the time from a start to an end at the ages of each band [h]."""
    length = (span[1] - span[0]).total_seconds() / HOUR_S
    return np.diff(np.minimum(AGE_BANDS_H, length))


def _count(found: Sequence[Any]) -> dict[str, int]:
    return dict(Counter(f"{one.motor}:{one.mode}" for one in found))


def motor_ages(connection: sa.Connection, robot: int) -> dict[str, float]:
    """Return the age of each motor of a robot at its last run [h]; empty if it has none."""
    return {
        motor: life.age_h(motor, life.last)
        for life in _lives(connection, robot)
        for motor in life.motors
    }


def watched_days(connection: sa.Connection) -> dict[str, tuple[int, float]]:
    """Return the number of robots of each kind, and the time they were watched in all [days]."""
    query = sa.select(kinds.c.kind, FIRST_RUN, LAST_RUN)
    found: dict[str, tuple[int, float]] = {}
    for kind, begin, end in connection.execute(query.where(FIRST_RUN.is_not(None))):
        count, days = found.get(kind, (0, 0.0))
        found[kind] = (count + 1, round(days + (end - begin).total_seconds() / DAY_S, 3))
    return found


# Calibrations.


def fleet_calibrations(connection: sa.Connection, kind: str) -> dict[str, StoredCalibration]:
    """Return the calibrations in force of the robots of a kind, each file once, by robot."""
    query = (
        sa.select(kinds.c.robot, calibrations)
        .join(kinds, kinds.c.robot_id == calibrations.c.robot_id)
        .where(kinds.c.kind == kind, calibrations.c.valid_to.is_(None))
        .order_by(calibrations.c.id.desc())
    )
    of_file = {one.sha256: (one.robot, one) for one in connection.execute(query)}
    return {robot: stored_calibration(one) for robot, one in list(of_file.values())[::-1]}
