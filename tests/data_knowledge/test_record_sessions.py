"""Sessions, offsets and beliefs in the store, on SQLite and PostgreSQL."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.records import beliefs
from failuretwin.data_knowledge.records.beliefs import Belief, BeliefLine
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.schema import Basis
from failuretwin.data_knowledge.records.sessions import Note
from store_places import diagnosis

START = datetime(2026, 3, 2, tzinfo=UTC)
HEALTHY = diagnosis("stream", "healthy")
STUCK = diagnosis("stream", "motor_1:stuck")


def at(minutes):
    return START + timedelta(minutes=minutes)


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


def watch(store, robot="arm_7", minutes=0):
    """Begin the session of a watch."""
    log = LogFile("ros1", None, 0, at(minutes))
    note = Note(at(minutes), "begins: ros1")
    return store.begin(robot, Basis("watch", None, "watch"), note, log=log, runs=["watch"])


def told(history):
    return [(one.kind, one.text) for one in history.timeline]


def test_a_watch_is_stored_as_it_happens(store, place):
    session = watch(store)
    assert told(store.history("arm_7")) == [("watch", "begins: ros1")]
    session.note(Note(at(1), "OK: healthy", HEALTHY, ""))
    (raised,) = session.note(Note(at(2), "ALARM: stuck", STUCK, "motor_1:stuck"))
    assert (raised.motor, raised.mode, raised.state) == ("motor_1", "stuck", "raised")
    (cleared,) = session.note(Note(at(3), "CLEARED: stuck", HEALTHY, ""))
    assert (cleared.number, cleared.state, cleared.until) == (1, "cleared", at(3))
    session.note(Note(at(4), "ends: OK", HEALTHY, final=True))
    found = store.history("arm_7")
    assert told(found) == [
        ("watch", "begins: ros1"),
        ("watch", "OK: healthy"),
        ("watch", "ALARM: stuck"),
        ("episode", "episode 1 begins: motor 1 stuck"),
        ("watch", "CLEARED: stuck"),
        ("episode", "episode 1 cleared"),
        ("watch", "ends: OK"),
    ]
    assert (found.counts, found.recent) == ({}, ())
    events = place.sql(
        "SELECT episode_events.state, verdict FROM episode_events JOIN diagnoses "
        "ON diagnosis_id = diagnoses.id ORDER BY episode_events.id"
    )
    assert events == [("raised", "motor_1:stuck for sure"), ("cleared", "healthy for sure")]
    assert place.sql("SELECT command, method FROM sessions") == [("watch", "watch")]


def test_a_suspicion_is_noted_and_begins_no_episode(store):
    session = watch(store)
    session.note(Note(at(1), "SUSPECTED: stuck", diagnosis("stream", "motor_1:stuck", 0.3), ""))
    found = store.history("arm_7")
    assert found.episodes == ()
    assert told(found)[-1] == ("watch", "SUSPECTED: stuck")


def test_an_alarm_clears_only_what_it_has_named(store):
    """A fault of another motor stays open until a whole run is healthy."""
    store.remember([diagnosis("run", "motor_2:stuck")], "arm_7", log=LogFile("a", "f", 1, at(0)))
    session = watch(store, minutes=1)
    session.note(Note(at(2), "OK", HEALTHY, ""))
    session.note(Note(at(3), "ALARM", STUCK, "motor_1:stuck"))
    session.note(Note(at(4), "CLEARED", HEALTHY, ""))
    assert [one.motor for one in store.history("arm_7").open_episodes] == ["motor_2"]
    session.note(Note(at(5), "ends", HEALTHY, final=True))
    assert store.history("arm_7").open_episodes == []


def test_an_alarm_that_names_another_fault_begins_another_episode(store):
    session = watch(store)
    session.note(
        Note(at(1), "ALARM", STUCK, "motor_1:stuck"),
        Note(at(2), "ALARM", STUCK, "motor_2:stuck"),
    )
    states = [(one.motor, one.state) for one in store.history("arm_7").episodes]
    assert states == [("motor_1", "cleared"), ("motor_2", "raised")]


def test_a_watch_goes_on_with_the_episode_that_one_before_it_left_open(store):
    watch(store).note(Note(at(1), "ALARM", STUCK, "motor_1:stuck"))  # and is killed
    again = watch(store, minutes=2)
    again.note(Note(at(3), "ALARM", STUCK, "motor_1:stuck"))
    again.note(Note(at(4), "CLEARED", HEALTHY, ""))
    states = [(one.since, one.until) for one in store.history("arm_7").episodes]
    assert states == [(at(1), at(4))]


def test_a_log_that_is_replayed_later_changes_no_episode(store):
    store.remember([diagnosis("run", "healthy")], "arm_7", log=LogFile("a", "f", 1, at(60)))
    watch(store).note(Note(at(1), "ALARM", STUCK, "motor_1:stuck"))
    assert store.history("arm_7").episodes == ()


def test_work_is_a_session_without_diagnoses(store, place):
    notes = [Note(at(k), f"target {k}: reached") for k in range(3)]
    store.begin("arm_7", Basis("act", None, "diagnose"), *notes)
    assert told(store.history("arm_7")) == [("act", f"target {k}: reached") for k in range(3)]
    assert store.history("arm_7").health == "no open fault"


def test_alarms_of_work_that_is_over_begin_and_clear_episodes(store):
    """As `act` stores them: all notes at once."""
    unsure = Note(at(1), "ALARM", diagnosis("act", "motor_1:stuck", 0.9), "motor_1:stuck", False)
    over, again = Note(at(2), "CLEARED", HEALTHY, ""), Note(at(3), "ALARM", STUCK, "motor_1:stuck")
    log = LogFile("act", None, 0, at(0))
    session = store.begin("arm_7", Basis("act"), unsure, over, again, log=log, runs=["act"])
    found = store.history("arm_7")
    assert [(one.state, one.raised) for one in found.episodes] == [
        ("cleared", False),
        ("raised", True),
    ]
    assert session.changed == found.episodes
    (over,) = session.note(Note(at(4), "CLEARED", HEALTHY, ""))
    assert (over.number, over.state) == (2, "cleared")
    assert found.counts == {}


def test_registered_runs_are_not_known_before_they_are_diagnosed(store, place):
    """Their first diagnosis begins episodes as that of any run."""
    log = LogFile("/out.nc", "f00", 9, at(0))
    note = Note(at(0), "2 runs written to out.nc")
    store.begin("arm_7", Basis("import"), note, log=log, runs=["a", "b"])
    assert place.sql("SELECT name FROM runs ORDER BY id") == [("a",), ("b",)]
    assert told(store.history("arm_7")) == [("import", "2 runs written to out.nc")]
    given = [diagnosis("a", "motor_1:stuck"), diagnosis("b", "motor_1:stuck")]
    assert store.remember(given, "arm_7", log=log).added == 2
    assert place.sql("SELECT count(*) FROM runs") == [("2",)]
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]


def test_a_check_is_stored_with_its_zeros(store, place):
    zero = MotorOffset("motor_1", "zero", 0.125, 0.0625, "rad")
    told_of = diagnosis("check", "healthy")
    log = LogFile("", None, 0, at(0))
    store.remember([told_of], "arm_7", log=log, command="check", offsets=[zero])
    rows = place.sql("SELECT motor, name, value, deviation, unit FROM offsets")
    assert rows == [("motor_1", "zero", "0.125", "0.0625", "rad")]
    assert told(store.history("arm_7")) == [("check", "check: healthy for sure")]


# Beliefs.

LINE = BeliefLine("diagnose", "start")


def belief(number, after=None):
    rng = np.random.default_rng(number)
    arrays = {"mean": rng.normal(size=(2, 3)), "counted": rng.random(4) > 0.5, "alarm": "ö x"}
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    return Belief(number, arrays, [{"key": f"run {number}"}], after)


def keep(store, given, line=LINE):
    store.keep_belief("arm_7", Basis("track"), line, given, at(given.runs))


def test_a_belief_comes_back_digit_for_digit_and_is_never_overwritten(store, place):
    assert store.belief("arm_7", LINE) == (None, "")
    after = None
    for number in (1, 2, 3):
        keep(store, belief(number, after))
        found, unused = store.belief("arm_7", LINE)
        assert unused == ""
        after = found.number
    assert found.runs == 3
    assert [row["key"] for row in found.rows] == ["run 1", "run 2", "run 3"]
    for name, array in belief(3).arrays.items():
        np.testing.assert_array_equal(found.arrays[name], array)
        assert found.arrays[name].dtype == array.dtype
    assert place.sql("SELECT count(*) FROM beliefs") == [("3",)]


def test_two_that_go_on_from_the_same_belief_are_not_mixed(store, place):
    keep(store, belief(1))
    with pytest.raises(OutputError, match=r"another session has followed.*Run the command again"):
        keep(store, belief(2))
    assert place.sql("SELECT count(*) FROM beliefs") == [("1",)]
    assert place.sql("SELECT count(*) FROM sessions") == [("1",)]


def test_a_belief_of_another_start_or_version_is_not_used(store, monkeypatch):
    keep(store, belief(1))
    other = BeliefLine("diagnose", "another")
    assert store.belief("arm_7", other) == (None, "it began with another calibration")
    assert store.belief("arm_7", BeliefLine("watch", "start")) == (None, "")
    monkeypatch.setattr(beliefs, "__version__", "9.9")
    found, unused = store.belief("arm_7", LINE)
    assert found is None
    assert unused == f"failuretwin {ft.__version__} made it, and this is 9.9"


def test_a_damaged_belief_gives_one_line(store, monkeypatch):
    monkeypatch.setattr(beliefs, "_packed", lambda arrays: b"nothing")
    keep(store, belief(1))
    with pytest.raises(InputError, match=r"damaged.*Restore the store from a copy"):
        store.belief("arm_7", LINE)


# Wear.


def test_the_history_shows_how_offsets_drift(store):
    for number in range(101):
        zero = MotorOffset("motor_1", "zero", 0.01 * number, 0.002, "rad")
        log = LogFile("", None, 0, at(number))
        told_of = [diagnosis(f"check {number}", "healthy")]
        store.remember(told_of, "arm_7", log=log, command="check", offsets=[zero])
    (drift,) = store.history("arm_7").drifts
    assert (drift.motor, drift.name, drift.unit) == ("motor_1", "zero", "rad")
    assert drift.change == pytest.approx(1.0)
    assert len(drift.at) == 20
    assert (drift.at[0], drift.at[-1]) == (at(0), at(100))
    assert sorted(drift.values) == list(drift.values)


def test_offsets_with_another_reference_are_left_out(store):
    for number, method in enumerate(("old", "new", "new")):
        bias = MotorOffset("motor_1", "bias", float(number), 0.002, "rad")
        line = BeliefLine("diagnose", method)
        given = belief(1, None if number < 2 else 2)
        store.keep_belief("arm_7", Basis("track", None, method), line, given, at(number), [bias])
    (drift,) = store.history("arm_7").drifts
    assert drift.values == (1.0, 2.0)


# What a fleet teaches.


def test_confirmed_faults_of_a_kind_are_counted_until_they_are_withdrawn(store, armpi):
    for number in range(4):
        for day, name in enumerate(("motor_1:stuck", "healthy")):
            log = LogFile(f"/{number} {day}", f"{number} {day}", 1, at(1440 * day))
            store.remember([diagnosis("run", name)], f"arm_{number}", log=log, profile=armpi)
    for number in range(3):
        store.found(f"arm_{number}", 1, "confirmed")
    store.found("arm_3", 1, "wrong")
    seen = store.fleet_faults("armpi_fpv")
    assert (seen.robots, seen.hours) == (4, pytest.approx(96.0))
    assert seen.confirmed == {"motor_1:stuck": 3}
    store.withdraw("arm_0", 1)
    assert store.fleet_faults("armpi_fpv").confirmed == {"motor_1:stuck": 2}
    other = store.fleet_faults("ur5e")
    assert (other.robots, other.hours, other.confirmed) == (0, 0.0, {})
