"""Orders as messages: on a transport that only keeps them, and on every network."""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np
import pytest

from failuretwin.connection.links import ros_transport
from failuretwin.connection.links.base import CommandSent, Order, Reading
from failuretwin.connection.links.ros_link import RosCommander, is_network, open_transport
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.connection.links.ros_transport import Transport
from failuretwin.core.errors import InputError
from fake_rosbridge import FakeRosbridge
from ros_peer import RosPeer
from roscores import free_port
from waiting import WAIT_S, wait_for
from zenoh_router import zenoh_router

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


class Kept(Transport):
    """A transport that keeps what is published."""

    name = far_side = "kept"

    def __init__(self):
        self.sent = []

    def publish(self, message):
        self.sent.append(message)

    def subscribe(self, topic, type_, take):
        pass

    def advertise(self, topic, type_):
        pass

    def is_gone(self):
        return False

    def is_heard(self, topic):
        return True

    def close(self):
        pass


@pytest.fixture
def kept():
    return Kept()


@pytest.fixture
def arm(armpi, kept):
    return RosCommander(armpi, STANDARD, kept)


def hear(arm, event):
    arm.put(event)
    assert arm.poll(0.0) is event


def test_an_order_is_a_trajectory_by_the_robots_clock(armpi, arm, kept):
    arm.send(order())  # nothing heard yet: by our own clock
    stamp = kept.sent.pop().content["header"]["stamp"]
    assert stamp["secs"] == pytest.approx(time.time(), abs=2.0)
    hear(arm, Reading(1000.0, np.zeros(3), np.zeros(4)))
    arm.send(order())
    message = kept.sent[0]
    assert (message.topic, message.type) == ("/arm/command", "trajectory_msgs/JointTrajectory")
    assert message.content["joint_names"] == [motor.joint for motor in armpi.motors]
    assert len(message.content["points"]) == 1
    np.testing.assert_allclose(message.content["points"][0]["positions"], TARGET)
    stamp = message.content["header"]["stamp"]
    assert stamp["secs"] + 1e-9 * stamp["nsecs"] == pytest.approx(1000.0, abs=1.0)
    np.testing.assert_array_equal(arm.standing, TARGET)


def test_a_slower_motor_arrives_later_from_where_it_was_told_to_be(arm, kept):
    hear(arm, CommandSent(5.0, np.full(4, 0.2), np.ones(4)))
    arm.send(Order(TARGET, np.array([0.5, 1.0, 1.0, 1.0])))
    points = kept.sent[0].content["points"]
    np.testing.assert_allclose(
        points[0]["positions"], 0.2 + np.array([1, 0.5, 0.5, 0.5]) * (TARGET - 0.2)
    )
    np.testing.assert_allclose(points[-1]["positions"], TARGET)


def test_where_the_arm_stands_is_what_was_heard_last(arm):
    assert arm.standing is None
    hear(arm, CommandSent(5.0, TARGET, np.ones(4)))
    np.testing.assert_array_equal(arm.standing, TARGET)
    assert arm.poll(0.0) is None
    hear(arm, CommandSent(6.0, -TARGET, np.ones(4)))
    np.testing.assert_array_equal(arm.standing, -TARGET)


def test_a_stream_of_set_points_is_refused(armpi, kept):
    streamed = RosTopics(
        command="/set_points", command_type="sensor_msgs/JointState", position="/joint_states",
        position_type="sensor_msgs/JointState",
    )  # fmt: skip
    with pytest.raises(InputError, match="stream of samples"):
        RosCommander(armpi, streamed, kept)


def test_orders_over_rosbridge(armpi):
    pytest.importorskip("roslibpy")
    server = FakeRosbridge(free_port())
    try:
        with open_transport(f"rosbridge://127.0.0.1:{server.port}") as transport:
            arm = RosCommander(armpi, STANDARD, transport)
            wait_for(lambda: "/arm/command" in server.types)
            assert server.types["/arm/command"] == "trajectory_msgs/JointTrajectory"
            arm.send(order())
            wait_for(lambda: len(server.published) == 1)
            points = server.published[0]["msg"]["points"]
            np.testing.assert_allclose(points[0]["positions"], TARGET)
            np.testing.assert_array_equal(arm.standing, TARGET)
            server.stop()
            wait_for(lambda: transport.trouble)
            with pytest.raises(InputError, match="nothing was sent"):
                arm.send(order())
    finally:
        server.stop()


@pytest.fixture(params=["ros1", "ros2"])
def network(request):
    """The name of a network on which nobody listens, and a function that starts a listener."""
    with ExitStack() as stack:
        if request.param == "ros1":
            peer = RosPeer(request.getfixturevalue("roscore").environment)
            stack.callback(peer.close)
            topic, type_ = STANDARD.command, STANDARD.command_type
            yield "ros1", lambda: peer.ask(op="listen", topic=topic, type=type_)
        else:
            pytest.importorskip("zenoh")
            port = free_port()
            stack.enter_context(zenoh_router(port))
            address = f"ros2://127.0.0.1:{port}"
            other = stack.enter_context(open_transport(address))
            topic, type_ = STANDARD.command, STANDARD.command_type
            yield address, lambda: other.subscribe(topic, type_, lambda decode: None)


def test_an_order_that_nobody_would_hear_is_not_sent(monkeypatch, armpi, network):
    monkeypatch.setattr(ros_transport, "LISTENER_S", 0.3)
    with open_transport(network[0]) as transport:
        arm = RosCommander(armpi, STANDARD, transport)
        with pytest.raises(InputError, match="nobody listens"):
            arm.send(order())
        assert arm.standing is None


def test_an_order_reaches_the_robot_and_comes_back(armpi, network):
    address, listen = network
    listen()
    with open_transport(address) as transport:
        arm = RosCommander(armpi, STANDARD, transport)
        arm.send(order())
        np.testing.assert_array_equal(arm.standing, TARGET)
        until, heard = time.monotonic() + WAIT_S, None
        while heard is None and time.monotonic() < until:
            heard = arm.poll(1.0)
            if heard is None:  # the listener was connected before we were to ourselves
                arm.send(order())
    assert isinstance(heard, CommandSent)
    np.testing.assert_allclose(heard.target, TARGET, atol=1e-12)


@pytest.mark.parametrize("text", ["rosbridge://", "ros2://", "ros2://host:x"])
def test_an_address_without_a_host_is_refused(text):
    assert is_network(text)
    with pytest.raises(InputError, match="is no address"):
        open_transport(text)
