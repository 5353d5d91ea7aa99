"""ROS 2 over Zenoh: what rmw_zenoh expects of a publisher, and routers that come and go."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest

from failuretwin.connection.links.base import OK, Answer, CommandSent, Reading
from failuretwin.connection.links.ros2 import Ros2Transport, domain_id
from failuretwin.connection.links.ros_link import RosSink, RosSource
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics, RosWriter
from failuretwin.connection.links.ros_transport import RosCodec
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from roscores import free_port
from waiting import WAIT_S, wait_for
from zenoh_router import client_of, zenoh_router

zenoh = pytest.importorskip("zenoh")
pytest.importorskip("rosbags")

STANDARD = RosTopics(
    command="/arm/command",
    command_type="trajectory_msgs/JointTrajectory",
    position="joint_states",
    position_type="sensor_msgs/JointState",
    tool="/tool_point",
)
HEALTHY = Diagnosis("live", {"healthy": 0.9, "motor_3:stuck": 0.1}, verdict="healthy, 90 % sure")


@pytest.fixture
def port():
    found = free_port()
    with zenoh_router(found):
        yield found


@pytest.fixture
def transport(port):
    with Ros2Transport("127.0.0.1", port) as opened:
        yield opened


def test_what_a_robot_says_is_heard(armpi, port, transport):
    with Ros2Transport("127.0.0.1", port) as other:
        source = RosSource(armpi, STANDARD, transport)
        robot = RosSink(RosWriter(armpi, STANDARD), other)
        target = np.array([0.1, -0.2, 0.3, 0.4])
        for _, topic, _ in STANDARD.subscribed:
            other.check_listener(topic)
        robot.put(CommandSent(1000.5, target, np.full(4, 0.8)))
        robot.put(Reading(1000.25, np.array([0.1, 0.2, 0.3]), target))
        heard = [source.poll(WAIT_S) for _ in range(3)]
        (command,) = [event for event in heard if isinstance(event, CommandSent)]
        (tool,) = [e.tool for e in heard if isinstance(e, Reading) and e.position is None]
        (angle,) = [e.position for e in heard if isinstance(e, Reading) and e.position is not None]
        assert sorted(event.time for event in heard) == [1000.25, 1000.25, 1000.5]
        np.testing.assert_allclose(command.target, target)
        np.testing.assert_allclose(command.duration, 0.8)
        np.testing.assert_allclose(tool, [0.1, 0.2, 0.3])
        np.testing.assert_allclose(angle, target)
        assert (source.counts.garbage, robot.trouble) == (0, "")


def test_the_diagnosis_has_all_that_ros_2_asks_of_a_message(armpi, port, transport):
    """The key, the hash (REP 2011: that of Jazzy), the attachment and the tokens of its node."""
    heard = []
    hash_ = "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
    with zenoh.open(client_of(port)) as other:
        other.declare_subscriber("0/diagnostics/**", heard.append)
        sink = RosSink(DiagnosticsWriter(armpi, STANDARD), transport)
        transport.check_listener("/diagnostics")

        def alive():
            return sorted(str(r.ok.key_expr) for r in other.liveliness().get("@ros2_lv/0/**"))

        wait_for(lambda: len(alive()) == 2)
        tokens = alive()
        sink.put(Answer(1000.5, OK, HEALTHY))
        wait_for(lambda: bool(heard))
    key = f"diagnostic_msgs::msg::dds_::DiagnosticArray_/{hash_}"
    assert str(heard[0].key_expr) == f"0/diagnostics/{key}"
    number, sent_ns, size = struct.unpack("<qqB", bytes(heard[0].attachment)[:17])
    assert (number, size, len(bytes(heard[0].attachment))) == (1, 16, 33)
    assert abs(sent_ns / 1e9 - time.time()) < 60.0
    (session,) = {token.split("/")[2] for token in tokens}
    own = f"@ros2_lv/0/{session}/0"
    assert tokens == [
        f"{own}/0/NN/%/%/failuretwin",
        f"{own}/1/MP/%/%/failuretwin/%diagnostics/{key}/::,10:,:,:,,",
    ]
    from rosbags.typesys import Stores, get_typestore

    data, store = bytes(heard[0].payload), get_typestore(Stores.ROS2_JAZZY)
    told = store.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray")
    assert (told.header.stamp.sec, told.header.stamp.nanosec) == (1000, 500_000_000)
    assert told.status[0].name == "failuretwin: arm"


def test_the_hash_of_a_type_is_that_of_ros_2():
    """As `ros2 topic info -v` of Jazzy prints it for std_msgs/msg/String."""
    known = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert RosCodec(2).hash_of("std_msgs/String") == known


def test_a_router_that_comes_back_is_no_trouble(armpi):
    port = free_port()
    with zenoh_router(port):
        transport = Ros2Transport("127.0.0.1", port)
        source = RosSource(armpi, STANDARD, transport)
        sink = RosSink(DiagnosticsWriter(armpi, STANDARD), transport)
        assert (source.counts.reconnects, sink.trouble) == (0, "")
    wait_for(lambda: bool(sink.trouble))
    assert source.counts.reconnects == 0
    with zenoh_router(port):
        wait_for(lambda: source.counts.reconnects == 1)
        assert sink.trouble == ""
        with Ros2Transport("127.0.0.1", port) as other:
            robot = RosSink(RosWriter(armpi, STANDARD), other)
            other.check_listener("/tool_point")
            robot.put(Reading(7.0, np.array([0.1, 0.2, 0.3])))
            assert source.poll(WAIT_S).time == 7.0
        transport.close()


def test_nonsense_is_counted(armpi, port, transport):
    with zenoh.open(client_of(port)) as other:
        source = RosSource(armpi, STANDARD, transport)
        key = "0/tool_point/geometry_msgs::msg::dds_::PointStamped_/RIHS01_any"
        publisher = other.declare_publisher(key)
        wait_for(lambda: publisher.matching_status.matching)
        publisher.put(b"\x00\x01\x00\x00nonsense")
        wait_for(lambda: source.counts.garbage == 1)


def test_without_a_router_the_user_is_told_to_start_one():
    with pytest.raises(InputError, match="rmw_zenohd"):
        Ros2Transport("127.0.0.1", free_port())


@pytest.mark.parametrize("text", ["233", "-1", "home"])
def test_a_domain_that_is_none_is_refused(monkeypatch, text):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(InputError, match="0 to 232"):
        domain_id()
