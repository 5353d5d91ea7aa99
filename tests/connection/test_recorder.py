from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links import recorder
from failuretwin.connection.links.base import OK, Answer, CommandSent, Reading
from failuretwin.connection.links.recorder import Recorder
from failuretwin.connection.links.replay import Pace, replay
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.readers.bag_file import read_messages
from full_disks import full_disk

pytest.importorskip("mcap")
pytest.importorskip("mujoco")


def events(robot, imperfections, seconds):
    work = Shifts(break_s=0.0, duration_s=seconds)
    arm = EmulatedArm(Emulation(robot, imperfections), shifts=work)
    return list(iter(lambda: arm.poll(0.0), None))


def answer(time_, probability=0.25):
    posterior = {"healthy": 1 - probability, "motor_1:stuck": probability}
    return Answer(time_, OK, Diagnosis("live", posterior, verdict=f"as of {time_:.0f} s"))


def test_a_recording_is_a_log_like_any_other(armpi, measured_armpi, tmp_path):
    told = events(armpi, measured_armpi, 20.0)
    with Recorder(tmp_path / "live.mcap", armpi) as sink:
        for event in told:
            sink.put(event)
    source = replay(tmp_path / "live.mcap", armpi, Pace(0.0))
    again = []
    while not source.ended:
        event = source.poll(0.0)
        again += [] if event is None else [event]
    sound = [e for e in told if isinstance(e, Reading) and np.isfinite(e.tool).all()]
    read = [e for e in again if isinstance(e, Reading)]
    tools = [e for e in read if np.isfinite(e.tool).all()]
    goals = [e.goal for e in read if e.goal is not None]
    assert_allclose(goals, [e.goal for e in told if isinstance(e, Reading)], atol=1e-12)
    shift = sound[0].time - tools[0].time
    assert_allclose([e.time + shift for e in tools], [e.time for e in sound], atol=1e-6)
    assert_allclose([e.tool for e in tools], [e.tool for e in sound], atol=1e-12)
    # A command whose motors arrive at different times comes back as several; the last ends it.
    ends = [e.target for e in told if isinstance(e, CommandSent)]
    targets = [e.target for e in again if isinstance(e, CommandSent)]
    for target in ends:
        assert np.abs(np.array(targets) - target).max(axis=1).min() < 1e-12


def test_a_recording_by_the_eyes_of_the_mcap_library(armpi, measured_armpi, tmp_path):
    from mcap.reader import make_reader

    path = tmp_path / "live.mcap"
    with Recorder(path, armpi) as sink:
        for event in events(armpi, measured_armpi, 10.0):
            sink.put(event)
        sink.put(answer(10.0))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        found = {
            channel.topic: (summary.schemas[channel.schema_id].name, channel.message_encoding)
            for channel in summary.channels.values()
        }
        counted = sum(1 for _ in reader.iter_messages())
    assert found == {
        "/command": ("trajectory_msgs/msg/JointTrajectory", "cdr"),
        "/joint_states": ("sensor_msgs/msg/JointState", "cdr"),
        "/joint_goals": ("sensor_msgs/msg/JointState", "cdr"),
        "/tool_point": ("geometry_msgs/msg/PointStamped", "cdr"),
        "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "cdr"),
        "/failuretwin/probability/healthy": ("std_msgs/msg/Float64", "cdr"),
        "/failuretwin/probability/motor_1/stuck": ("std_msgs/msg/Float64", "cdr"),
    }
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert counted == summary.statistics.message_count > 100


def test_a_full_disk_costs_no_diagnosis_and_is_got_over(
    armpi, measured_armpi, tmp_path, monkeypatch
):
    told = events(armpi, measured_armpi, 120.0)
    now = [0.0]
    monkeypatch.setattr(recorder.time, "monotonic", lambda: now[0])

    def put(sink, begin, end):
        for event in told:
            if begin <= event.time < end:
                now[0] = event.time
                sink.put(event)
                sink.put(answer(event.time))

    with Recorder(tmp_path / "live.mcap", armpi) as sink:
        put(sink, 0.0, 40.0)
        with full_disk():
            put(sink, 40.0, 80.0)
            assert "live.mcap: cannot be written" in sink.trouble
        put(sink, 80.0, 90.0)  # it goes on within ten seconds
        assert sink.trouble == ""
        put(sink, 90.0, 120.0)
    assert [file.name for file in tmp_path.iterdir()] == ["live.mcap"]
    messages = read_messages(tmp_path / "live.mcap", ["/diagnostics"])["/diagnostics"]
    diagnosed = {m.content.header.stamp.sec for m in messages}
    with Recorder(tmp_path / "sound.mcap", armpi) as sink:
        now[0] = -10.0
        put(sink, 0.0, 120.0)
    messages = read_messages(tmp_path / "sound.mcap", ["/diagnostics"])["/diagnostics"]
    assert len(messages) > 80
    assert diagnosed == {m.content.header.stamp.sec for m in messages}


def test_a_recording_that_exists_is_not_overwritten(armpi, tmp_path):
    path = tmp_path / "live.mcap"
    path.write_text("precious")
    with pytest.raises(InputError, match="exists already"):
        Recorder(path, armpi)
    assert path.read_text() == "precious"


def test_a_recording_that_cannot_be_begun_is_an_error(armpi, tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        Recorder(tmp_path / "missing" / "live.mcap", armpi)


def test_a_recorder_that_is_killed_leaves_all_but_the_last_seconds(armpi, measured_armpi, tmp_path):
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader

    path = tmp_path / "live.mcap"
    sink = Recorder(path, armpi)
    for event in events(armpi, measured_armpi, 60.0):
        sink.put(event)
    newest = 0.0
    with path.open("rb") as file, pytest.raises(EndOfFile):
        for _, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            newest = message.log_time / 1e9
    assert 40.0 < newest < 60.0
    sink.__exit__()


def test_a_recording_that_begins_on_a_full_disk_is_an_error_and_leaves_no_file(armpi, tmp_path):
    with full_disk(), pytest.raises(OutputError, match="cannot be written"):
        Recorder(tmp_path / "live.mcap", armpi)
    assert not list(tmp_path.iterdir())
