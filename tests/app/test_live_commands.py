from __future__ import annotations

import os
import re
import signal

import numpy as np
import pytest

from ros_peer import RosPeer
from roscores import free_port
from waiting import WAIT_S

pytest.importorskip("mcap")
pytest.importorskip("mujoco")

FAULT = ("--fault", "motor_3:stuck@12-22")
TOLD = re.compile(r"^ *([\d.]+) s  (.*)$", re.MULTILINE)


def told(answer):
    """Return what a live command said, as (time [s], text)."""
    return [(float(at), text) for at, text in TOLD.findall(answer.stdout)]


@pytest.fixture(scope="module")
def watched(failuretwin, tmp_path_factory):
    """What was said of the same robot while it was recorded, and the recording."""
    path = tmp_path_factory.mktemp("watched") / "live.mcap"
    answer = failuretwin(
        *("watch", "emulated", "--speed", 0, "--seconds", 38, "--record", path), *FAULT
    )
    assert answer.returncode == 0, answer.stderr
    return answer, path


@pytest.fixture(scope="module")
def recording(failuretwin, tmp_path_factory):
    """An emulated robot of which motor 3 sticks from 12 to 22 s, as a file."""
    path = tmp_path_factory.mktemp("live") / "robot.mcap"
    answer = failuretwin("emulate", "--to", path, "--seconds", 38, *FAULT)
    assert answer.returncode == 0, answer.stderr
    states = [text for _, text in told(answer)]
    assert states == ["healthy", "motor_3:stuck", "healthy"]
    return path


def check_found(changes):
    """Check that motor 3 is found stuck after it began, and healthy after it was repaired."""
    stuck = [at for at, text in changes if text.startswith("ALARM: motor 3 stuck")]
    assert stuck
    assert 12.0 < stuck[0] < 22.0
    assert [text.startswith("CLEARED:") for at, text in changes if at > 22.0][-1]


def test_an_emulated_robot_is_watched(watched):
    check_found(told(watched[0]))


def test_an_alarm_that_is_raised_early_is_told_as_an_alarm_and_again_when_it_is_sure(failuretwin):
    fault = ("--fault", "motor_3:stuck@12", "--seed", 6)
    answer = failuretwin("watch", "emulated", "--speed", 0, "--seconds", 25, *fault)
    assert answer.returncode == 0, answer.stderr
    early, sure = [text for _, text in told(answer) if text.startswith("ALARM: ")]
    assert "61 % (or healthy 39 %)" in early
    assert early.endswith("alarm threshold 57 %, by --false-alarms-per-100h")
    assert sure.startswith("ALARM: motor 3 stuck at -20 deg")


def test_a_recorded_fault_and_its_repair_are_found(failuretwin, watched):
    live, path = watched
    answer = failuretwin("watch", path, "--speed", 0)
    assert answer.returncode == 0, answer.stderr
    check_found(told(answer))
    assert "last answer: OK: healthy" in answer.stdout
    assert [text for _, text in told(answer)][-1:] == [text for _, text in told(live)][-1:]


def test_a_written_life_goes_on_after_its_last_fault(failuretwin, tmp_path):
    path = tmp_path / "robot.mcap"
    answer = failuretwin("emulate", "--to", path, "--fault", "motor_3:stuck@40-65")
    assert [text for _, text in told(answer)] == ["healthy", "motor_3:stuck", "healthy"]
    assert f"85 s written to {path}" in answer.stdout


def test_an_emulated_robot_has_a_fault_of_a_size_that_begins_at_a_time(failuretwin):
    fault = ("--fault", "motor_2:steady_state_error=0.1@20", "--seed", 1)
    answer = failuretwin("watch", "emulated", "--speed", 0, "--seconds", 40, *fault)
    assert answer.returncode == 0, answer.stderr
    found = re.search(r"ALARM: motor 2 misses its targets by about ([\d.]+) deg", answer.stdout)
    assert found and float(found[1]) == pytest.approx(np.degrees(0.1), abs=0.4)


def test_a_robot_on_a_ros_network_is_watched(roscore, begin):
    """Three programs on a real roscore: a robot, its shadow, and one that reads /diagnostics."""
    environment = {
        **os.environ,
        **{k: v for k, v in roscore.environment.items() if k.startswith("ROS_")},
    }
    peer = RosPeer(roscore.environment)
    topic = {"topic": "/diagnostics"}
    peer.ask(op="listen", type="diagnostic_msgs/DiagnosticArray", **topic)
    words = ("emulate", "--speed", 5, "--fault", "motor_3:stuck@20")
    robot = begin(*words, environment=environment)
    try:
        with begin("watch", "ros1", "--seconds", 14, environment=environment) as answer:
            stdout, stderr = answer.communicate()
    finally:
        robot.terminate()
        said, wrong = robot.communicate(timeout=WAIT_S)
        messages = peer.ask(op="heard", **topic)
        peer.close()
    assert answer.returncode == 0, stderr
    assert "motor_3:stuck" in said, wrong
    assert any(text.startswith("ALARM: motor 3 stuck") for _, text in TOLD.findall(stdout))
    assert len(messages) > 1
    levels = [{s["name"]: s["level"] for s in message["statuses"]} for message in messages]
    assert any(at["failuretwin: motor_3"] == at["failuretwin: arm"] == 2 for at in levels)
    assert not any(at["failuretwin: motor_1"] == 2 for at in levels), levels


def test_without_a_master_the_user_is_told_to_start_one(failuretwin, monkeypatch):
    pytest.importorskip("roslibpy")
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{free_port()}")
    for verb in (("watch", "ros1"), ("emulate",)):
        answer = failuretwin(*verb)
        assert answer.returncode == 2
        assert re.search("Start `roscore`|needs rospy", answer.stderr)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("watch", "nowhere"), "source 'nowhere' does not exist. Expected emulated, ros1,"),
        (("watch", "rosbridge://"), "is no address. Expected rosbridge://HOST[:PORT]"),
        (("watch", "rosbridge://host:port"), "is no address"),
        (("watch", "emulated", "--fault", "motor_9:stuck@5"), "unknown motor 'motor_9'"),
        (("watch", "emulated", "--speed", "nan"), "expected a factor above 0"),
        (("watch", "emulated", "--topics", "missing.toml"), "missing.toml: cannot be read"),
        (("emulate", "--robot", "ur5e"), "cm/msg_cm holds servo counts"),
        (("watch", "ros1", "--robot", "ur5e"), "file for --topics"),
        (("emulate", "--to", "robot.bag"), "rosbridge://HOST[:PORT] or a file that ends in .mcap"),
        (("emulate", "--to", "a.mcap", "--fault", "motor_3:stuck@soon"), "is not of the form"),
        (("emulate", "--obey", "--to", "a.mcap"), "--obey needs a network"),
        (("emulate", "--obey", "--speed", "2"), "stamped by clocks of speed 1, but --speed is 2"),
        (("emulate", "--to", "no/such/folder.mcap"), "cannot be written"),
        (("watch", "emulated", "--record", "live.bag"), "Give a name that ends in .mcap"),
        (("watch", ".", "--fault", "motor_3:stuck@5"), "--fault is of an"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(failuretwin, tmp_path, arguments, said):
    answer = failuretwin(*arguments, folder=tmp_path)
    assert answer.returncode == 2
    assert said in answer.stderr
    assert answer.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_not_overwritten(failuretwin, tmp_path):
    path = tmp_path / "live.mcap"
    path.write_text("precious")
    for verb in (("emulate", "--to"), ("watch", "emulated", "--record")):
        answer = failuretwin(*verb, path)
        assert answer.returncode == 2
        assert "exists already" in answer.stderr
    assert path.read_text() == "precious"


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_watch_and_the_recording(begin, recording, tmp_path, how):
    path = tmp_path / "live.mcap"
    shadow = begin("watch", recording, "--record", path, "--speed", 4)
    assert "healthy behaviour: armpi_fpv" in shadow.stdout.readline()
    assert "healthy" in shadow.stdout.readline()  # the first answer
    shadow.send_signal(how)
    said, _ = shadow.communicate(timeout=WAIT_S)
    assert shadow.returncode == 0
    assert "stopped" in said
    from mcap.reader import make_reader

    with path.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count > 5
