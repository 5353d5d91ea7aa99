"""Questions to the store: ready ones, all robots at a glance, and the runs of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.fleet import (
    LAST_RUN,
    REFUTED,
    AgeBand,
    fleet_faults,
    judged,
    kinds,
    watched_days,
)
from failuretwin.data_knowledge.records.schema import (
    calibrations,
    diagnoses,
    episode_events,
    logs,
    runs,
)
from failuretwin.data_knowledge.records.unknown_faults import (
    read_episodes_of_unknown,
    unknown_groups,
)


@dataclass(frozen=True)
class QueryAnswer:
    """Answer to a ready question.

    Attributes:
        name: Name of the question.
        title: The question in words.
        columns: Names of the columns, with units.
        rows: Values; times are UTC, None is unknown.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


def _count(condition: sa.ColumnElement[bool]) -> sa.ColumnElement[int]:
    return sa.func.coalesce(sa.func.sum(sa.case((condition, 1), else_=0)), 0)


def _failing_motors(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    count = sa.func.count()
    query = (
        sa.select(kinds.c.kind, judged.c.motor, judged.c.mode, count)
        .add_columns(sa.func.count(sa.distinct(judged.c.robot_id)))
        .add_columns(_count(judged.c.verdict == CONFIRMED), _count(REFUTED))
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .group_by(kinds.c.kind, judged.c.motor, judged.c.mode)
        .order_by(count.desc(), kinds.c.kind, judged.c.motor, judged.c.mode)
    )
    return [tuple(row) for row in connection.execute(query)]


def _time_between(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    """Time from the first to the last run of all robots of a kind, over the failures of a motor."""
    watched = watched_days(connection)
    count = sa.func.count()
    query = (
        sa.select(kinds.c.kind, judged.c.motor, count)
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .where(~REFUTED)
        .group_by(kinds.c.kind, judged.c.motor)
        .order_by(kinds.c.kind, count.desc(), judged.c.motor)
    )
    rows = connection.execute(query).all()
    return [
        (kind, motor, *watched[kind], failures, _between(watched[kind][1], failures))
        for kind, motor, failures in rows
    ]


def _between(days: float, failures: int) -> float | None:
    """Return the mean time between failures [days]; None: watched for no time yet."""
    return round(days / failures, 3) if days > 0.0 else None


def _wrong(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    first = (
        sa.select(sa.func.min(episode_events.c.diagnosis_id))
        .where(episode_events.c.episode_id == judged.c.id)
        .scalar_subquery()
    )
    query = (
        sa.select(kinds.c.robot, judged.c.number, judged.c.since, diagnoses.c.verdict)
        .add_columns(judged.c.verdict, judged.c.cause, judged.c.person)
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .join(diagnoses, diagnoses.c.id == first)
        .where(REFUTED)
        .order_by(kinds.c.robot, judged.c.number)
    )
    return [tuple(row) for row in connection.execute(query)]


def _due(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    query = sa.select(kinds.c.robot_id, kinds.c.robot, LAST_RUN).order_by(kinds.c.robot)
    is_open = sa.select(judged.c.robot_id).where(judged.c.until.is_(None), ~REFUTED)
    faulty = set(connection.scalars(is_open))
    in_force = sa.select(calibrations.c.robot_id).where(calibrations.c.valid_to.is_(None))
    calibrated = set(connection.scalars(in_force))
    limit, found = now - timedelta(days=days), []
    for row, robot, seen in connection.execute(query):
        reasons = {
            "open fault": row in faulty,
            "no run yet": seen is None,
            f"no run for {days:g} days": seen is not None and seen < limit,
            "no calibration": row not in calibrated,
        }
        if any(reasons.values()):
            found.append((robot, seen, ", ".join(name for name, true in reasons.items() if true)))
    return found


def _unknown(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    names = {row: kind for row, _, kind in connection.execute(sa.select(kinds))}
    return [group.row for group in unknown_groups(read_episodes_of_unknown(connection), names)]


def _by_age(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    return [
        (
            *(kind, motor, _ages(band), round(band.hours / 24.0, 3), count),
            1000.0 * count / band.hours if band.hours else None,
        )
        for kind in sorted(watched_days(connection))
        for motor, bands in fleet_faults(connection, kind).by_age.items()
        for band in bands
        if (count := sum(band.confirmed.values())) or band.hours
    ]


def _ages(band: AgeBand) -> str:
    """Return the ages of a band in words."""
    low, high = band.low_h / 24.0, band.high_h / 24.0
    return f"from {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


@dataclass(frozen=True)
class _Question:
    title: str
    columns: tuple[str, ...]
    ask: Callable[[sa.Connection, datetime, float], list[tuple[Any, ...]]]


QUESTIONS = {
    "failing-motors": _Question(
        "Which motors fail most?",
        ("kind", "motor", "mode", "episodes", "robots", "confirmed", "refuted"),
        _failing_motors,
    ),
    "time-between-failures": _Question(
        "Mean time between failures of each motor; refuted episodes do not count",
        ("kind", "motor", "robots", "watched_days", "failures", "days_between"),
        _time_between,
    ),
    "rates-by-age": _Question(
        "Confirmed faults of each motor by its age, since its last repair or the first run",
        ("kind", "motor", "age_days", "motor_days", "confirmed", "per_1000_h"),
        _by_age,
    ),
    "wrong-diagnoses": _Question(
        "Which diagnoses were wrong?",
        ("robot", "episode", "since", "diagnosis", "finding", "cause", "person"),
        _wrong,
    ),
    "unknown-faults": _Question(
        "Which faults does no known mode explain? Each group may be a mode of its own",
        (
            *("kind", "motor", "episodes", "runs", "robots", "size", "sign", "law"),
            *("since", "until", "alike"),
        ),
        _unknown,
    ),
    "due": _Question("Which robots are due for a check?", ("robot", "last_run", "why"), _due),
}
"""Ready questions by name; they are asked at a time (UTC), a robot is due after some days."""


# All robots at a glance, and the runs of one.

NEWEST = 200
"""Number of runs that are listed at most."""


@dataclass(frozen=True)
class RobotGlance:
    """A robot and its last diagnosis.

    Attributes:
        robot: Its name.
        kind: Name of its profile; empty if it has none.
        at: When its last run was (UTC); None: it has none.
        state: State of that diagnosis; empty: none.
        verdict: Its verdict.
        faults: Open episodes that nobody refuted, ``MOTOR:MODE`` with whether each is confirmed.
        remarks: Why it allows no verdict, and problems of its log, a line each.
    """

    robot: str
    kind: str
    at: datetime | None
    state: str
    verdict: str
    faults: Mapping[str, bool]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredRun:
    """A diagnosed run of a robot.

    Attributes:
        row: Row of the diagnosis in the store.
        at: When it was recorded (UTC).
        log: Path of its log.
        position: Its number in the log.
        name: Its name.
        verdict: The verdict.
        posterior: Probability of every hypothesis.
        onset_s: Onset of the fault [s]; None: not known.
    """

    row: int
    at: datetime
    log: str
    position: int
    name: str
    verdict: str
    posterior: Mapping[str, float]
    onset_s: float | None


def read_overview(connection: sa.Connection) -> tuple[RobotGlance, ...]:
    """Return all robots, by name."""
    own = diagnoses.alias()
    last = (
        sa.select(own.c.id)
        .where(own.c.robot_id == kinds.c.robot_id)
        .order_by(own.c.at.desc(), own.c.id.desc())
        .limit(1)
        .scalar_subquery()
    )
    query = (
        sa.select(kinds.c.robot_id, kinds.c.robot, kinds.c.kind)
        .add_columns(diagnoses.c.at, diagnoses.c.state, diagnoses.c.verdict)
        .add_columns(diagnoses.c.undecided, diagnoses.c.quality)
        .select_from(kinds.outerjoin(diagnoses, diagnoses.c.id == last))
        .order_by(kinds.c.robot)
    )
    faults: dict[int, dict[str, bool]] = {}
    standing = sa.select(judged).where(judged.c.until.is_(None), ~REFUTED)
    for one in connection.execute(standing):
        name = f"{one.motor}:{one.mode}"
        faults.setdefault(one.robot_id, {})[name] = one.verdict == CONFIRMED
    return tuple(
        RobotGlance(
            one.robot,
            one.kind,
            one.at,
            one.state or "",
            one.verdict or "",
            faults.get(one.robot_id, {}),
            (one.undecided or "", *(one.quality or ())),
        )
        for one in connection.execute(query)
    )


def read_runs_of(connection: sa.Connection, row: int) -> tuple[StoredRun, ...]:
    """Return the last `NEWEST` diagnosed runs of a robot, the newest first."""
    query = (
        sa.select(diagnoses.c.id, diagnoses.c.at, logs.c.path, runs.c.position, runs.c.name)
        .add_columns(diagnoses.c.verdict, diagnoses.c.posterior, diagnoses.c.onset_s)
        .join(runs, runs.c.id == diagnoses.c.run_id)
        .join(logs, logs.c.id == runs.c.log_id)
        .where(diagnoses.c.robot_id == row)
        .order_by(diagnoses.c.at.desc(), diagnoses.c.id.desc())
        .limit(NEWEST)
    )
    return tuple(StoredRun(*one) for one in connection.execute(query))
