"""ROS 1: its import, and links whose master dies or that get invalid or too many messages."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from failuretwin.connection.links import ros_messages
from failuretwin.connection.links.base import OK, STALE, Answer, CommandSent, Reading
from failuretwin.connection.links.ros1 import Ros1Transport
from failuretwin.connection.links.ros_link import RosSink, RosSource
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics, RosWriter
from failuretwin.core.hypothesis import ALL_CLEAR, RAISED, Alarm, Diagnosis, Episode
from little_logs import LOG_COLUMNS
from ros_peer import RosPeer
from roscores import need_ros
from waiting import WAIT_S, wait_for

pytest.importorskip("rosbags")
pytestmark = [
    # rospy of Debian 12 leaves sockets to the collector and calls what Python 3.11 deprecates.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
STANDARD = RosTopics(
    command="/arm/command",
    command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states",
    position_type="sensor_msgs/JointState",
    tool="/tool_point",
)


@pytest.fixture
def peer(roscore):
    other = RosPeer(roscore.environment)
    yield other
    other.close()


def reading(t):
    return Reading(t, np.array([0.1, 0.0, 0.2]), np.zeros(4))


def point(topic="/tool_point", x=0.1, t=100):
    header = {"seq": 0, "stamp": {"secs": t, "nsecs": 0}, "frame_id": ""}
    return {"topic": topic, "content": {"header": header, "point": {"x": x, "y": 0.0, "z": 0.2}}}


def test_a_master_that_is_killed_and_restarted_is_no_trouble(armpi, roscore):
    posterior = {"healthy": 1.0}
    with Ros1Transport() as transport:
        source = RosSource(armpi, STANDARD, transport)
        sink = RosSink(DiagnosticsWriter(armpi, STANDARD), transport)
        roscore.kill()
        wait_for(lambda: sink.trouble != "")
        roscore.start()
        robot, listener = RosPeer(roscore.environment), RosPeer(roscore.environment)
        told = robot.ask(
            op="advertise", topic="/tool_point", type="geometry_msgs/PointStamped", wait_s=WAIT_S
        )
        assert told["heard"] == 1
        robot.ask(op="publish", **point())
        assert source.poll(WAIT_S).time == 100.0
        topic = {"topic": "/diagnostics"}
        listener.ask(op="listen", type="diagnostic_msgs/DiagnosticArray", **topic)

        def heard():
            sink.put(Answer(time.time(), OK, Diagnosis("live", posterior, verdict="healthy")))
            return listener.ask(op="heard", **topic)

        wait_for(heard)
        assert sink.trouble == ""
        assert source.counts.reconnects == 1
        robot.close()
        listener.close()


def test_what_was_published_before_the_end_arrives(monkeypatch, armpi, peer):
    """The last order of a check is to stand still; the transport is closed right after it."""
    topic, times = "/diagnostics", np.arange(1000.0, 1020.0).tolist()
    peer.ask(op="listen", type="diagnostic_msgs/DiagnosticArray", topic=topic)
    with Ros1Transport() as transport:
        RosSink(DiagnosticsWriter(armpi, STANDARD), transport)
        wait_for(lambda: transport.is_heard(topic))
        let_the_network_be_slow(monkeypatch, transport, topic)
        for t in times:
            # A writer of its own: nothing is left out for coming too soon.
            writer = DiagnosticsWriter(armpi, STANDARD)
            diagnosis = Diagnosis("live", {"healthy": 1.0}, verdict="healthy")
            for message in writer.messages(Answer(t, OK, diagnosis)):
                transport.publish(message)
    wait_for(lambda: [status["stamp"] for status in peer.ask(op="heard", topic=topic)] == times)


def let_the_network_be_slow(monkeypatch, transport, topic):
    """Let each message of a topic need 20 ms on its way to its listener."""
    (link,) = transport._publishers[topic].impl.connections
    write = link._connection.write_data

    def slowly(data):
        time.sleep(0.02)
        return write(data)

    monkeypatch.setattr(link._connection, "write_data", slowly)


def test_a_robot_comes_back_with_its_topics(armpi, roscore):
    with Ros1Transport() as transport:
        sink = RosSink(RosWriter(armpi, STANDARD), transport)
        roscore.kill()
        wait_for(lambda: sink.trouble != "")
        roscore.start()
        wait_for(lambda: "/joint_states" in roscore.topic_types())
        assert roscore.topic_types()["/arm/command"] == "trajectory_msgs/JointTrajectory"


def test_messages_that_make_no_sense_are_counted_and_left_out(armpi, peer):
    stamp = {"secs": 5, "nsecs": 0}
    header = {"seq": 0, "stamp": stamp, "frame_id": ""}
    names = list(LOG_COLUMNS)
    good = {"name": ["joint1", "joint2", "joint3", "joint4"], "velocity": [], "effort": []}
    with Ros1Transport() as transport:
        source = RosSource(armpi, STANDARD, transport)
        for topic, type_ in (
            ("/tool_point", "std_msgs/Header"),
            ("/joint_states", "sensor_msgs/JointState"),
            ("/arm/command", "trajectory_msgs/JointTrajectory"),
        ):
            # rospy itself checks no types where the listener takes any message.
            assert peer.ask(op="advertise", topic=topic, type=type_, wait_s=WAIT_S)["heard"] == 1
        peer.ask(op="publish", topic="/tool_point", content=header)
        wait_for(lambda: source.counts.garbage == 1)
        for position in ([1.0], [1e300] * 4, []):
            content = {"header": header, **good, "position": position}
            peer.ask(op="publish", topic="/joint_states", content=content)
        strangers = {**good, "name": names[:2], "position": [0.0, 0.0]}
        peer.ask(op="publish", topic="/joint_states", content={"header": header, **strangers})
        backwards = [
            {"positions": [0.0] * 4, "time_from_start": {"secs": due, "nsecs": 0}} | NO_SPEEDS
            for due in (2, 1)
        ]
        plan = {"header": header, "joint_names": good["name"], "points": backwards}
        peer.ask(op="publish", topic="/arm/command", content=plan)
        peer.ask(
            op="publish",
            topic="/joint_states",
            content={"header": header, **good, "position": [0.1, 0.2, 0.3, 0.4]},
        )
        event = source.poll(WAIT_S)
        wait_for(lambda: source.counts.garbage >= 5)
    assert event.position.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert np.isnan(event.tool).all()  # another topic tells it
    assert source.poll(0.2) is None
    assert source.counts.last_garbage


NO_SPEEDS = {"velocities": [], "accelerations": [], "effort": []}


def test_a_node_that_may_talk_to_this_computer_alone_is_heard(armpi, roscore):
    """rospy looks for the addresses of this computer when it connects; Debian has what it needs."""
    code = """
import sys
from failuretwin.connection.links.ros1 import Ros1Transport
with Ros1Transport() as transport:
    import rosgraph.network
    print(rosgraph.network.is_local_address("127.0.0.1"), "netifaces" in sys.modules)
"""
    environment = {**os.environ, "ROS_HOSTNAME": "localhost", "ROS_MASTER_URI": roscore.uri}
    assert run(code, environment) == ["True", "True"]


def test_ten_times_the_rate_is_taken(armpi, roscore):
    with Ros1Transport() as transport:
        source = RosSource(armpi, STANDARD, transport)
        sink = RosSink(RosWriter(armpi, STANDARD), transport)
        wait_until_connected(source, sink)
        begin = time.monotonic()
        for k in range(300):
            sink.put(reading(1000.0 + 0.01 * k))
            time.sleep(max(0.0, begin + 0.01 * k - time.monotonic()))
        stamps = []
        while len(stamps) < 600:
            event = source.poll(WAIT_S)
            assert event is not None, f"only {len(stamps)} came"
            stamps.append(event.time)
        assert source.counts.dropped == 0


def test_a_consumer_that_sleeps_loses_readings_but_no_command(monkeypatch, armpi, roscore):
    topics = RosTopics()
    with Ros1Transport() as transport:
        source = RosSource(armpi, topics, transport)
        monkeypatch.setattr(source, "_capacity", 50)
        sink = RosSink(RosWriter(armpi, topics), transport)
        wait_until_connected(source, sink)
        sink.put(CommandSent(1.0, np.full(4, 0.1), np.ones(4)))
        for k in range(300):
            sink.put(reading(1000.0 + k))
            time.sleep(0.002)
        wait_for(lambda: source.counts.dropped > 200)
        kept = [source.poll(0.1) for _ in range(50)]
    assert sum(isinstance(event, CommandSent) for event in kept) == 1
    assert sum(isinstance(event, Reading) for event in kept) == 49


def wait_until_connected(source, sink):
    kinds = set()

    def came():
        sink.put(CommandSent(time.time(), np.zeros(4), np.ones(4)))
        sink.put(reading(time.time()))
        kinds.add(type(source.poll(0.1)))
        return {CommandSent, Reading} <= kinds

    wait_for(came)
    while source.poll(0.5) is not None:
        pass


def test_commands_as_trajectories_keep_each_motors_own_duration(armpi, roscore):
    with Ros1Transport() as transport:
        source = RosSource(armpi, STANDARD, transport)
        sink = RosSink(RosWriter(armpi, STANDARD), transport)
        wait_until_connected(source, sink)
        target = np.array([0.4, -0.2, 0.3, 0.1])
        sink.put(CommandSent(50.0, target, np.array([0.6, 0.8, 1.0, 0.6])))
        parts = [source.poll(WAIT_S) for _ in range(3)]
    assert [part.time for part in parts] == pytest.approx([50.0, 50.6, 50.8])
    np.testing.assert_allclose(parts[0].target, [0.4, -0.15, 0.18, 0.1], atol=1e-12)
    np.testing.assert_allclose(parts[2].target, target, atol=1e-12)


def test_diagnostics_come_every_second_and_at_once_when_it_gets_worse(monkeypatch, armpi, peer):
    topic = {"topic": "/diagnostics"}
    healthy = Diagnosis("live", {"healthy": 0.99, "motor_2:stuck": 0.01}, verdict="healthy")
    stuck = Diagnosis(
        "live",
        {"healthy": 0.01, "motor_2:stuck": 0.99},
        verdict="motor 2 stuck",
        onset_s=3.0,
        magnitude=0.5,
        magnitude_unit="rad",
    )
    raised = Alarm(RAISED, "motor_2:stuck", Episode(1, "motor_2:stuck", 1002.5))
    now = [1000.0]
    monkeypatch.setattr(ros_messages, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def levels():
        return [[s["level"] for s in m["statuses"]] for m in peer.ask(op="heard", **topic)]

    with Ros1Transport() as transport:
        sink = RosSink(DiagnosticsWriter(armpi, STANDARD), transport)
        peer.ask(op="listen", type="diagnostic_msgs/DiagnosticArray", **topic)

        def put(state, diagnosis):
            now[0] += 0.25
            alarm = raised if diagnosis is stuck else ALL_CLEAR
            sink.put(Answer(now[0], state, diagnosis, alarm))

        def heard():
            put(OK, healthy)
            return levels()

        wait_for(heard)
        for state, diagnosis in 9 * [(OK, healthy)] + 3 * [(OK, stuck)] + [(STALE, stuck)]:
            put(state, diagnosis)
        wait_for(lambda: levels()[-1] == [3] * 5)
        messages = peer.ask(op="heard", **topic)
    *before, last, _ = levels()
    assert last == [2, 0, 2, 0, 0]
    assert before == [[0] * 5] * len(before)
    assert len(before) >= 3
    stamps = [message["stamp"] for message in messages]
    assert np.diff(stamps[: len(before)]).tolist() == [1.0] * (len(before) - 1)
    assert (stamps[-2], stamps[-1]) == (now[0] - 0.75, now[0])
    message = messages[-2]
    names = [s["name"] for s in message["statuses"]]
    assert names == [f"failuretwin: {n}" for n in ("arm", *armpi.motor_names)]
    motor = message["statuses"][2]
    assert motor["hardware"] == "armpi_fpv"
    assert motor["values"]["mode"] == "stuck"
    assert motor["values"]["magnitude"] == "0.5"
    assert motor["values"]["onset_s"] == "3.00"


# The import of rospy.


def run(code, environment=None):
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env=environment,
    )
    return done.stdout.split()


def test_of_debians_modules_only_those_of_ros_are_seen():
    need_ros()
    if sys.prefix == "/usr":
        pytest.skip("this is Debian's own interpreter, which sees them all")
    code = """
import importlib.util
from failuretwin.connection.links.ros1 import load_rospy
rospy = load_rospy()
import numpy
print(rospy.__file__)
print(numpy.__file__)
print(*(importlib.util.find_spec(name) is None for name in ("apt", "gi", "catkin_pkg")))
"""
    rospy, numpy, *hidden = run(code)
    assert rospy.startswith("/usr/lib/python3/dist-packages/")
    assert not numpy.startswith("/usr/lib/python3/")
    assert hidden == ["True", "True", "False"]


def test_without_ros_the_user_is_told_what_to_install():
    code = """
import sys
from failuretwin.connection.links import ros1 as packages
sys.modules["rospy"] = None
packages.DEBIAN_FOLDER = "/nowhere"
try:
    packages.load_rospy()
except ValueError as error:
    print(error)
"""
    told = " ".join(run(code))
    assert "apt install python3-rospy" in told
