"""Orders as messages on a network: a fake rosbridge server, a real roscore where there is one."""

from __future__ import annotations

import time

import numpy as np
import pytest

from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.connection.links.commander import Order
from failuretwin.connection.links.network_commander import Orders
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.core.errors import InputError
from fake_rosbridge import FakeRosbridge
from ros_peer import RosPeer
from roscores import free_port
from waiting import WAIT_S, wait_for

pytestmark = [
    # rospy of Debian 12 leaves sockets to the collector and calls what Python 3.11 deprecates.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
STANDARD = RosTopics(
    command="/arm/command", command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states", position_type="sensor_msgs/JointState",
)  # fmt: skip
TARGET = np.array([0.4, -0.2, 0.3, 0.1])


def order(target=TARGET, duration=0.8):
    return Order(target, np.full(4, duration))


def test_an_order_is_a_trajectory_by_the_robots_clock(armpi):
    sent = []
    orders = Orders(armpi, STANDARD, sent.append)
    orders.send(order())  # nothing heard yet: by our own clock
    assert sent.pop().content["header"]["stamp"]["secs"] == pytest.approx(time.time(), abs=2.0)
    orders.hear(Reading(1000.0, np.zeros(3), np.zeros(4)))
    orders.send(order())
    message = sent[0]
    assert (message.topic, message.type) == ("/arm/command", "trajectory_msgs/JointTrajectory")
    assert message.content["joint_names"] == [motor.joint for motor in armpi.motors]
    assert len(message.content["points"]) == 1
    np.testing.assert_allclose(message.content["points"][0]["positions"], TARGET)
    stamp = message.content["header"]["stamp"]
    assert stamp["secs"] + 1e-9 * stamp["nsecs"] == pytest.approx(1000.0, abs=1.0)
    np.testing.assert_array_equal(orders.standing, TARGET)


def test_a_slower_motor_arrives_later_from_where_it_was_told_to_be(armpi):
    sent = []
    orders = Orders(armpi, STANDARD, sent.append)
    orders.hear(CommandSent(5.0, np.full(4, 0.2), np.ones(4)))
    orders.send(Order(TARGET, np.array([0.5, 1.0, 1.0, 1.0])))
    points = sent[0].content["points"]
    np.testing.assert_allclose(
        points[0]["positions"], 0.2 + np.array([1, 0.5, 0.5, 0.5]) * (TARGET - 0.2)
    )
    np.testing.assert_allclose(points[-1]["positions"], TARGET)


def test_where_the_arm_stands_is_what_was_heard_last(armpi):
    orders = Orders(armpi, STANDARD, lambda _: None)
    assert orders.standing is None
    orders.hear(CommandSent(5.0, TARGET, np.ones(4)))
    np.testing.assert_array_equal(orders.standing, TARGET)
    orders.hear(None)
    orders.hear(CommandSent(6.0, -TARGET, np.ones(4)))
    np.testing.assert_array_equal(orders.standing, -TARGET)


def test_a_stream_of_set_points_is_refused(armpi):
    streamed = RosTopics(
        command="/set_points", command_type="sensor_msgs/JointState", position="/joint_states",
        position_type="sensor_msgs/JointState",
    )  # fmt: skip
    with pytest.raises(InputError, match="stream of samples"):
        Orders(armpi, streamed, lambda _: None)


def test_orders_over_rosbridge(armpi):
    pytest.importorskip("roslibpy")
    from failuretwin.connection.links import rosbridge

    server = FakeRosbridge(free_port())
    ros = rosbridge.connect("127.0.0.1", server.port)
    try:
        with rosbridge.RosbridgeCommander(armpi, STANDARD, ros) as arm:
            wait_for(lambda: "/arm/command" in server.types)
            assert server.types["/arm/command"] == "trajectory_msgs/JointTrajectory"
            arm.send(order())
            wait_for(lambda: len(server.published) == 1)
            points = server.published[0]["msg"]["points"]
            np.testing.assert_allclose(points[0]["positions"], TARGET)
            np.testing.assert_array_equal(arm.standing, TARGET)
        server.stop()
        wait_for(lambda: not ros.is_connected)
        with pytest.raises(InputError, match="nothing was sent"):
            arm.send(order())
    finally:
        rosbridge.disconnect(ros)
        server.stop()


def test_an_order_that_nobody_would_hear_is_not_sent(monkeypatch, armpi, roscore):
    from failuretwin.connection.links import ros1

    monkeypatch.setattr(ros1, "LISTENER_S", 0.3)
    with ros1.Ros1Commander(armpi, STANDARD) as arm:
        with pytest.raises(InputError, match="nobody listens"):
            arm.send(order())
        assert arm.standing is None


def test_orders_over_ros1(armpi, roscore):
    from failuretwin.connection.links.ros1 import Ros1Commander

    peer = RosPeer(roscore.environment)
    try:
        peer.ask(op="listen", topic="/arm/command", type="trajectory_msgs/JointTrajectory")
        with Ros1Commander(armpi, STANDARD) as arm:
            arm.send(order())
            np.testing.assert_array_equal(arm.standing, TARGET)
            until, heard = time.monotonic() + WAIT_S, None
            while heard is None and time.monotonic() < until:
                heard = arm.poll(1.0)
                if heard is None:  # the peer was connected before we were to ourselves
                    arm.send(order())
        assert isinstance(heard, CommandSent)
        np.testing.assert_allclose(heard.target, TARGET, atol=1e-12)
    finally:
        peer.close()
