"""Ready questions to the store."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import sqlalchemy as sa

from failuretwin.core.errors import check_name
from failuretwin.data_knowledge.records import CHECK_DAYS
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
        (kind, motor, _ages(band), round(band.hours / 24.0, 3), count, _per_1000_h(band, count))
        for kind in sorted(watched_days(connection))
        for motor, bands in fleet_faults(connection, kind).by_age.items()
        for band in bands
        if (count := sum(band.confirmed.values())) or band.hours
    ]


def _ages(band: AgeBand) -> str:
    """Return the ages of a band in words."""
    low, high = band.low_h / 24.0, band.high_h / 24.0
    return f"from {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def _per_1000_h(band: AgeBand, count: int) -> float | None:
    return 1000.0 * count / band.hours if band.hours else None


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
"""Ready questions by name."""


def ask(connection: sa.Connection, name: str, days: float = CHECK_DAYS) -> QueryAnswer:
    """Return the answer to a ready question.

    Args:
        connection: Connection to the store.
        name: Name of the question, see `QUESTIONS`.
        days: Time without a run after which a robot is due [days].

    Raises:
        InputError: If there is no such question.
    """
    check_name("query", name, QUESTIONS)
    question = QUESTIONS[name]
    rows = question.ask(connection, datetime.now(UTC), days)
    return QueryAnswer(name, question.title, question.columns, tuple(rows))
