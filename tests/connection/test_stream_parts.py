"""Small parts of the live loop: link, clock, order of events, statuses, beat."""

from __future__ import annotations

import importlib
import sys
import textwrap
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from failuretwin.connection.links import ros_messages
from failuretwin.connection.links.base import (
    OK,
    STALE,
    Answer,
    CommandSent,
    Link,
    Reading,
    Sink,
    Source,
    source_from_text,
)
from failuretwin.connection.links.replay import Pace
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics, load_topics
from failuretwin.connection.links.statuses import (
    LEVEL_ERROR,
    LEVEL_OK,
    LEVEL_STALE,
    LEVEL_WARN,
    statuses,
)
from failuretwin.connection.links.stream_time import ReorderBuffer, StreamClock
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    ALL_CLEAR,
    CLEAR,
    RAISED,
    SUSPECTED,
    Alarm,
    Diagnosis,
    Episode,
)

YEAR_S = 3.15e7


def reading(t):
    return Reading(t, np.zeros(3))


def command(t):
    return CommandSent(t, np.zeros(4), np.ones(4))


def test_a_full_link_gives_up_the_oldest_readings_and_keeps_commands():
    link = Link("slow", capacity=3)
    for event in (command(0.0), reading(1.0), reading(2.0), reading(3.0), command(4.0)):
        link.put(event)
    assert [link.poll(0.0).time for _ in range(3)] == [0.0, 3.0, 4.0]
    assert link.poll(0.0) is None
    assert (link.counts.received, link.counts.dropped) == (5, 2)


def test_a_slow_consumer_costs_no_memory():
    link = Link("slow", capacity=100)
    for t in range(10_000):
        link.put(reading(float(t)))
    assert link.counts.dropped == 9_900
    assert [link.poll(0.0).time for _ in range(100)] == list(range(9_900, 10_000))
    assert link.poll(0.0) is None


def test_a_link_of_commands_alone_stays_bounded():
    link = Link("slow", capacity=2)
    for t in range(5):
        link.put(command(float(t)))
    assert [link.poll(0.0).time for _ in range(2)] == [3.0, 4.0]


def test_a_link_wakes_who_waits():
    link = Link("waited for")
    threading.Timer(0.1, link.put, [reading(1.0)]).start()
    assert link.poll(threading.TIMEOUT_MAX).time == 1.0  # never, if nobody wakes it


@pytest.mark.parametrize("jump", [YEAR_S, -YEAR_S, 3600.0, -30.0])
def test_a_clock_that_is_set_does_not_move_the_stream(jump):
    clock = StreamClock()
    placed = [clock.to_stream_time(100.0 + 0.1 * k, 0.1 * k) for k in range(50)]
    placed += [clock.to_stream_time(100.0 + jump + 0.1 * k, 0.1 * k) for k in range(50, 100)]
    np.testing.assert_allclose(placed, 0.1 * np.arange(100), atol=1e-6)
    assert (clock.jumps, clock.senseless) == (1, 0)


def test_one_senseless_stamp_does_not_move_the_stream():
    clock = StreamClock()
    stamps = [0.0, 0.1, 1e12, 0.3, 0.4]
    placed = [clock.to_stream_time(stamp, 0.1 * k) for k, stamp in enumerate(stamps)]
    np.testing.assert_allclose(placed, 0.1 * np.arange(5), atol=1e-6)
    assert (clock.jumps, clock.senseless) == (0, 1)


def test_late_messages_and_silences_are_no_jumps():
    clock = StreamClock()
    placed = [clock.to_stream_time(stamp, 0.0) for stamp in (50.0, 52.0, 50.5, 80.0)]
    assert placed == [0.0, 2.0, 0.5, 30.0]
    assert clock.jumps == 0
    assert clock.stamp(30.0) == 80.0


def test_a_clock_that_is_set_back_a_little_is_noticed_by_readings_that_stay_behind():
    """Two late ones are late; the third is not, and from then on time runs as it did."""
    clock, told = StreamClock(), []
    for k in range(40):
        stamp = 50.0 + 0.1 * k - (2.0 if k >= 20 else 0.0)
        told.append(clock.to_stream_time(stamp, 0.1 * k, reading=True))
    np.testing.assert_allclose(told[:20], 0.1 * np.arange(20), atol=1e-9)
    np.testing.assert_allclose(told[22:], 0.1 * np.arange(22, 40), atol=1e-9)
    assert clock.jumps == 1


def test_commands_that_come_late_are_no_clock_that_was_set_back():
    clock = StreamClock()
    for k in range(40):
        clock.to_stream_time(50.0 + 0.1 * k, 0.1 * k, reading=True)
        assert clock.to_stream_time(48.0 + 0.1 * k, 0.1 * k) == pytest.approx(0.1 * k - 2.0)
    assert clock.jumps == 0


def test_without_events_the_stream_goes_on_by_our_own_clock():
    clock = StreamClock()
    clock.to_stream_time(100.0, 7.0)
    assert clock.at(10.0) == 3.0


def test_commands_that_come_late_take_their_place():
    sequencer = ReorderBuffer(hold_s=2.0)
    for event in (reading(0.0), reading(1.0), reading(2.0), command(0.5), reading(3.0)):
        sequencer.add(event)
    assert [event.time for event in sequencer.ready(3.0)] == [0.0, 0.5, 1.0]
    assert [event.time for event in sequencer.ready(np.inf)] == [2.0, 3.0]


def test_a_command_goes_before_a_reading_of_its_time():
    sequencer = ReorderBuffer()
    sequencer.add(reading(1.0))
    sequencer.add(command(1.0))
    assert [type(event) for event in sequencer.ready(1.0)] == [CommandSent, Reading]


@pytest.mark.parametrize("speed", [-1.0, np.inf, np.nan])
def test_a_senseless_speed_is_refused(speed):
    with pytest.raises(InputError, match="expected a factor above 0"):
        Pace(speed)


def answer(posterior, state=OK, alarm=ALL_CLEAR, **more):
    return Answer(5.0, state, Diagnosis("run", posterior, verdict="the verdict", **more), alarm)


MOTORS = ["motor_1", "motor_2"]


def test_the_statuses_of_a_fault():
    posterior = {"healthy": 0.03, "motor_2:stuck": 0.92, "motor_2:drift": 0.05}
    alarm = Alarm(RAISED, "motor_2:stuck", Episode(2, "motor_2:stuck", 4.5))
    told = answer(posterior, OK, alarm, magnitude=-0.2, magnitude_unit="rad", onset_s=3.25)
    arm, first, second = statuses(told, MOTORS)
    assert [s.name for s in (arm, first, second)] == ["arm", "motor_1", "motor_2"]
    assert [s.level for s in (arm, first, second)] == [LEVEL_ERROR, LEVEL_OK, LEVEL_ERROR]
    assert arm.message == "the verdict"
    assert arm.values == {
        "alarm": "alarm",
        "episode": "2",
        "episode_cause": "motor_2:stuck",
        "raised_s": "4.50",
        "diagnosis": "motor_2:stuck",
        "probability": "0.92",
        "magnitude": "-0.2",
        "magnitude_unit": "rad",
        "onset_s": "3.25",
        "runner_up": "motor_2:drift",
        "runner_up_probability": "0.05",
    }
    assert second.values == {
        "probability": "0.97",
        "mode": "stuck",
        "magnitude": "-0.2",
        "magnitude_unit": "rad",
        "onset_s": "3.25",
        "runner_up": "drift",
    }


@pytest.mark.parametrize(
    ("state", "level"), [(CLEAR, LEVEL_OK), (SUSPECTED, LEVEL_WARN), (RAISED, LEVEL_ERROR)]
)
@pytest.mark.parametrize("healthy", [0.9, 0.1])
def test_the_alarm_decides_the_level_not_the_probability(healthy, state, level):
    alarm = Alarm(state, "" if state == CLEAR else "motor_1:stuck")
    told = answer({"healthy": healthy, "motor_1:stuck": 1 - healthy}, OK, alarm)
    assert [s.level for s in statuses(told, MOTORS)] == [level, level, LEVEL_OK]


def test_an_alarm_stands_while_nothing_can_be_said():
    alarm = Alarm(RAISED, "motor_1:stuck")
    told = answer({"healthy": 0.5, "motor_1:stuck": 0.5}, OK, alarm, undecided="too dark")
    assert [s.level for s in statuses(told, MOTORS)] == [LEVEL_ERROR, LEVEL_ERROR, LEVEL_WARN]


def test_when_an_episode_ended_is_told():
    alarm = Alarm(CLEAR, "", Episode(1, "motor_1:stuck", 4.0, 9.25))
    assert statuses(answer({"healthy": 1.0}, OK, alarm), MOTORS)[0].values["cleared_s"] == "9.25"


def test_without_data_nothing_is_healthy_and_nothing_is_forgotten():
    found = statuses(answer({"healthy": 1.0, "motor_1:stuck": 0.0}, STALE), MOTORS)
    assert {s.level for s in found} == {LEVEL_STALE}
    assert found[0].message == "no data for a while; before that: the verdict"
    for state in (OK, STALE):
        assert {s.level for s in statuses(Answer(0.0, state, None), MOTORS)} == {LEVEL_STALE}


def test_a_run_that_cannot_be_judged_is_a_warning():
    told = answer({"healthy": 0.5, "motor_1:stuck": 0.5}, undecided="too dark")
    assert {s.level for s in statuses(told, MOTORS)} == {LEVEL_WARN}


def test_reports_come_every_second_and_at_once_when_it_gets_worse(armpi, monkeypatch):
    writer, now = DiagnosticsWriter(armpi, RosTopics()), [0.0]
    monkeypatch.setattr(ros_messages, "time", SimpleNamespace(monotonic=lambda: now[0]))
    posterior = {"healthy": 0.5, "motor_1:stuck": 0.5}
    alarms = {
        LEVEL_OK: ALL_CLEAR,
        LEVEL_WARN: Alarm(SUSPECTED, "motor_1:stuck"),
        LEVEL_ERROR: Alarm(RAISED, "motor_1:stuck"),
        LEVEL_STALE: ALL_CLEAR,
    }

    def due(level, now_s):
        now[0] = now_s
        state = STALE if level == LEVEL_STALE else OK
        return bool(writer.messages(answer(posterior, state, alarms[level])))

    assert due(LEVEL_OK, 0.0)
    assert not due(LEVEL_OK, 0.5)
    assert due(LEVEL_WARN, 0.6)
    assert due(LEVEL_ERROR, 0.7)
    assert not due(LEVEL_OK, 0.8)  # better news can wait
    assert due(LEVEL_OK, 1.7)
    assert due(LEVEL_STALE, 1.8)


def test_topics_from_a_file(tmp_path):
    path = tmp_path / "topics.toml"
    path.write_text('command = "/arm/command"\ncommand_type = "trajectory_msgs/JointTrajectory"\n')
    assert load_topics(path) == RosTopics("/arm/command", "trajectory_msgs/JointTrajectory")


def test_readings_wait_for_set_points_unless_the_user_says_otherwise():
    streamed = RosTopics(command_type="sensor_msgs/JointState")
    assert streamed.wait_s == 0.5
    assert replace(streamed, commands_late_s=0.1).wait_s == 0.1
    assert RosTopics().wait_s == 0.0


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('comand = "x"', "Did you mean 'command'"),
        ('command = ""', "no topic of commands"),
        ('position = ""', "neither a topic of motor readings"),
        ('tool_type = "sensor_msgs/JointState"\ntool = "/t"', "cannot be the tool"),
        ("commands_late_s = 100.0", r"expected 0 to 60"),
        ('command_type = "std_msgs/String"', "cannot be the command"),
        ('command = "has space"', "is not a topic name"),
    ],
)
def test_topics_that_make_no_sense_are_refused(tmp_path, text, match):
    path = tmp_path / "topics.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        load_topics(path)
    assert str(path) in str(caught.value)


# Sources and sinks of other people

PREAMBLE = """
from __future__ import annotations
import numpy as np
from failuretwin.connection.links.base import *
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """Write the example of a docstring as the module `own_link`."""

    def write(documented):
        example = textwrap.dedent((documented.__doc__ or "").partition("::\n")[2])
        (tmp_path / "own_link.py").write_text(
            f"from __future__ import annotations\n{PREAMBLE}{example}"
        )
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "own_link", raising=False)

    return write


def test_the_documented_source_is_one(own_module, armpi):
    own_module(Source)
    with source_from_text("own_link:Replayed", armpi) as source:
        events = [source.poll(0.0) for _ in range(11)]
        assert source.ended
    assert [event.time for event in events[:-1]] == pytest.approx(0.1 * np.arange(10))
    assert events[-1] is None


def test_the_documented_sink_is_one(own_module, capsys):
    own_module(Sink)
    with importlib.import_module("own_link").Printed() as sink:
        sink.put(reading(1.0))
        sink.put(answer({"healthy": 1.0}))
        assert sink.trouble == ""
    assert capsys.readouterr().out == "5.0 the verdict\n"


@pytest.mark.parametrize(
    ("text", "trouble"),
    [
        ("no_such_module:Robot", "No module named 'no_such_module'"),
        ("failuretwin.connection.links.base:Nothing", "has no attribute 'Nothing'"),
        ("failuretwin.digital_model.twin:DigitalTwin", "lacks name, ended, counts, poll"),
    ],
)
def test_what_is_no_source_is_refused(armpi, text, trouble):
    with pytest.raises(InputError, match=f"source '{text}': .*{trouble}"):
        source_from_text(text, armpi)


def test_a_source_without_its_address_is_refused(armpi, tmp_path, monkeypatch):
    text = "def Port(robot, address):\n    open(address)\n"
    (tmp_path / "own_port.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        InputError, match=r"'own_port:Port:/dev/none' could not be opened: .*No such"
    ):
        source_from_text("own_port:Port:/dev/none", armpi)
