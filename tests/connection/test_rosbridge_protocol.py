"""The rosbridge protocol, as servers of ROS 1 and ROS 2 write and read it.

No package registry offers the released server: `rosbridge_suite` is built with ROS, and the server
on PyPI needs the libraries of ROS 2. So no real server is met here. The judge is a conversation,
`rosbridge_conversation.jsonl`, and a check of what we send. Both follow the protocol document and
`message_conversion.py` of rosbridge_library: stamps are `secs` and `nsecs` in ROS 1, `sec` and
`nanosec` in ROS 2 (which reads both); NaN is null; fields that a type lacks are refused, missing
ones are empty.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from failuretwin.connection.links.base import OK, Answer, CommandSent, Order, Reading
from failuretwin.connection.links.ros_link import RosCommander, RosSink, RosSource
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics, RosWriter
from failuretwin.core.hypothesis import Diagnosis
from waiting import WAIT_S, wait_for

pytest.importorskip("roslibpy")
TOPICS = RosTopics(
    command="/command", command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states", position_type="sensor_msgs/JointState",
    tool="/tool_point", goal="/joint_goals",
)  # fmt: skip
CONVERSATION = Path(__file__).with_name("rosbridge_conversation.jsonl")
CALLS = {
    "subscribe": {"type", "topic", "compression", "throttle_rate", "queue_length"},
    "unsubscribe": {"topic"},
    "advertise": {"type", "topic", "latch", "queue_size"},
    "unadvertise": {"topic"},
    "publish": {"topic", "msg", "latch"},
}
"""Fields of each operation, beside `op` and `id`, that servers read."""
TIMES = {1: [{"secs", "nsecs"}], 2: [{"secs", "nsecs"}, {"sec", "nanosec"}]}
NUMBERS = {"string": str, "bool": bool}


@pytest.fixture(scope="module", params=[1, 2], ids=["ROS 1", "ROS 2"])
def ros(request):
    return request.param


@pytest.fixture(scope="module")
def store(ros):
    typesys = pytest.importorskip("rosbags.typesys")
    stores = typesys.Stores
    return typesys.get_typestore(stores.ROS1_NOETIC if ros == 1 else stores.ROS2_JAZZY)


def refusal(value, type_, store, ros):
    """Return why a server does not take a message of a type, or an empty string."""
    if type_ in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
        return "" if set(value) in TIMES[ros] else f"{value} is no time of ROS {ros}"
    fields = dict(store.fielddefs[type_][1])
    if not isinstance(value, dict) or set(value) - set(fields):
        return f"{value} is no {type_}"
    return "".join(_refused_part(value[name], fields[name], store, ros) for name in value)


def _refused_part(value, kind, store, ros):
    name, detail = kind[0].name, kind[1]
    if name == "NAME":
        return refusal(value, detail, store, ros)
    if name == "BASE":
        known = NUMBERS.get(detail[0], (int, float) if "float" in detail[0] else int)
        return "" if isinstance(value, known) else f"{value!r} is no {detail[0]}"
    if not isinstance(value, list):
        return f"{value!r} is no list"
    return "".join(_refused_part(part, detail[0], store, ros) for part in value)


def test_what_a_server_sends_is_understood(armpi, server, transport, ros):
    lines = [json.loads(line) for line in CONVERSATION.read_text().splitlines()]
    lines = [line for line in lines if line["ros"] == ros]
    with RosSource(armpi, TOPICS, transport) as source:
        for line in lines:
            topic = json.loads(line["frame"])["topic"]
            wait_for(lambda topic=topic: server.has_subscriber(topic))
            server.send_raw(topic, line["frame"])
        for line in (line for line in lines if "time" in line):
            event = source.poll(WAIT_S)
            assert event.time == pytest.approx(line["time"])
            for name in ("position", "tool", "target", "duration"):
                if name in line:
                    expected = np.array(line[name], dtype=float)
                    np.testing.assert_allclose(getattr(event, name), expected)
        assert source.poll(0.2) is None  # a tool position without a value is none
        assert source.counts.garbage == 0


def test_what_we_send_is_taken(armpi, server, transport, store, ros):
    reading = Reading(5.25, np.array([0.1, 0.2, 0.3]), np.full(4, 0.1), np.full(4, 0.2))
    command = CommandSent(6.5, np.full(4, 0.3), np.array([0.5, 1.0, 1.0, 1.0]))
    answer = Answer(9.5, OK, Diagnosis("live", {"healthy": 0.9, "motor_1:stuck": 0.1}))
    with RosSource(armpi, TOPICS, transport):
        for item in (reading, command):
            RosSink(RosWriter(armpi, TOPICS), transport).put(item)
        RosSink(DiagnosticsWriter(armpi, TOPICS), transport).put(answer)
        RosCommander(armpi, TOPICS, transport).send(Order(np.full(4, -0.3), np.ones(4)))
        wait_for(lambda: len(server.published) == 6)
    assert {call["op"] for call in server.calls} >= {"subscribe", "advertise", "publish"}
    for call in server.calls:
        assert set(call) - {"op", "id"} <= CALLS[call["op"]]
    for call in server.published:
        type_ = server.types[call["topic"]].replace("/", "/msg/")
        assert refusal(call["msg"], type_, store, ros) == ""


@pytest.mark.parametrize(
    "message",
    [
        {"header": {"stamp": {"seconds": 1}}},
        {"header": {}, "colour": "red"},
        {"name": "joint1"},
        {"position": ["0.1"]},
    ],
)
def test_the_check_refuses_what_servers_refuse(store, ros, message):
    assert refusal(message, "sensor_msgs/msg/JointState", store, ros)
