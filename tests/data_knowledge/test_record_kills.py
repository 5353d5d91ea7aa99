"""Writers to the store that are killed at random instants, on SQLite and PostgreSQL."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.schema import Basis
from failuretwin.data_knowledge.records.sessions import Note
from killed_writers import calls_before_kill
from store_places import diagnosis

START = datetime(2026, 3, 2, tzinfo=UTC)
RUNS = 40
LATEST = 4.0
"""Latest kill after the first call, in times that this took."""


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


@pytest.fixture(params=[2, pytest.param(100, marks=pytest.mark.slow)])
def delays(request):
    """Random instants of kills, in times that the first call took."""
    return np.random.default_rng(7).uniform(0.0, LATEST, request.param)


def at(minutes):
    return START + timedelta(minutes=minutes)


def fault(number):
    """Return what is found: a fault, and no fault in turn."""
    return "healthy" if number % 2 else "motor_1:stuck"


def counts(place, robot, *tables):
    """Return the number of rows of tables with a robot, at one instant."""
    each = (
        f"(SELECT count(*) FROM {table} WHERE {column} IN ({rows}))"
        for table, column, rows in tables
    )
    name = f"SELECT id FROM robots WHERE name = '{robot}'"
    (row,) = place.sql(f"SELECT {', '.join(each)}".replace("ROBOT", name))
    return [int(cell) for cell in row]


OF_ROBOT = tuple(
    (table, "robot_id", "ROBOT") for table in ("logs", "sessions", "diagnoses", "episodes", "notes")
)
RUNS_OF = ("runs", "log_id", "SELECT id FROM logs WHERE robot_id IN (ROBOT)")
EVENTS_OF = ("episode_events", "episode_id", "SELECT id FROM episodes WHERE robot_id IN (ROBOT)")


def test_diagnoses_are_stored_as_whole_calls(place, store, delays):
    for kill, delay in enumerate(delays):

        def remember(number, robot=f"arm {kill}"):
            given = [diagnosis(f"run {k}", fault(number)) for k in range(RUNS)]
            log = LogFile(f"/{number}", None, 0, at(number))
            ft.open_store(place.url).remember(given, robot, log=log)

        told = calls_before_kill(remember, delay)
        found = counts(place, f"arm {kill}", *OF_ROBOT, RUNS_OF, EVENTS_OF)
        calls = found[0]
        assert told <= calls <= told + 1
        assert found == [calls, calls, RUNS * calls, (calls + 1) // 2, 0, RUNS * calls, calls]
        if calls:
            stated = store.history(f"arm {kill}").counts
            assert sum(stated.values()) == RUNS * calls
    assert store.check().problems == ()


def test_notes_are_stored_as_whole_calls(place, store, delays):
    for kill, delay in enumerate(delays):
        begun = Note(at(0), "begins: ros1")
        log = LogFile("ros1", None, 0, at(0))
        session = store.begin(f"arm {kill}", Basis("watch"), begun, log=log, runs=["watch"])

        def note(number, session=session):
            name = fault(number)
            alarm = "" if name == "healthy" else name
            session.note(Note(at(number + 1), "a change", diagnosis("watch", name), alarm))

        told = calls_before_kill(note, delay)
        found = counts(place, f"arm {kill}", *OF_ROBOT, RUNS_OF, EVENTS_OF)
        calls = found[2]
        assert told <= calls <= told + 1
        assert found == [1, 1, calls, (calls + 1) // 2, calls + 1, 1, calls]
    assert store.check().problems == ()
