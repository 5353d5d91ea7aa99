"""What every link must do, whatever lies behind it."""

from __future__ import annotations

import csv
import json
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bag_writers import MONITORING, MONITORING_TEXT, entry, write_bag
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links import replay as pace
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.connection.links.replay import Pace, replay
from failuretwin.connection.links.ros1 import Ros1Transport, message_class
from failuretwin.connection.links.ros2 import Ros2Transport
from failuretwin.connection.links.ros_link import RosSource
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.connection.links.ros_transport import Outgoing, RosCodec
from failuretwin.connection.links.rosbridge import RosbridgeTransport
from failuretwin.core.errors import InputError
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from fake_rosbridge import FakeRosbridge
from little_logs import LOG_COLUMNS
from ros_peer import RosPeer
from roscores import free_port
from waiting import WAIT_S, wait_for
from zenoh_router import client_of, zenoh_router

pytest.importorskip("rosbags")
pytestmark = [
    # rospy of Debian 12 leaves sockets to the collector and calls what Python 3.11 deprecates.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

HEADER_TEXT = "uint32 seq\ntime stamp\nstring frame_id\n"
AUTHORS_TEXT = f"{MONITORING_TEXT.strip()}\n{'=' * 80}\nMSG: std_msgs/Header\n{HEADER_TEXT}"


def messages_of(log):
    """Return (topic, seconds, fields) of the authors' messages, in the order of their stamps."""
    names = list(LOG_COLUMNS)
    commands = [
        ("position_monitoring", t, {"position": p.tolist(), "temperature": d.tolist()})
        for t, p, d in zip(log.command_time, log.target, log.duration_ms, strict=True)
    ]
    readings = [
        ("condition_monitoring", t, {"position": p.tolist(), "temperature": []})
        for t, p in zip(log.reading_time, log.counts, strict=True)
    ]
    found = sorted([*commands, *readings], key=lambda row: row[1])
    return [(topic, t, {"name": names, "voltage": [], **fields}) for topic, t, fields in found]


def bag(log, folder, form):
    entries = [
        entry(topic, MONITORING, round(t * 1e6) * 1000, **fields)
        for topic, t, fields in messages_of(log)
    ]
    return write_bag(folder, form, entries)


def session(log, folder):
    tables = {
        "trajectory_monitoring_cmd.csv": (log.command_time, log.target),
        "trajectory_monitoring_cmd_duration.csv": (log.command_time, log.duration_ms),
        "trajectory_monitoring_position.csv": (log.reading_time, log.counts),
    }
    for name, (stamps, values) in tables.items():
        with (folder / name).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["timestamp", *LOG_COLUMNS])
            writer.writerows([repr(float(t)), *v] for t, v in zip(stamps, values, strict=True))
    return folder


def stamp(t):
    micro = round(t * 1e6)
    return {"secs": micro // 10**6, "nsecs": micro % 10**6 * 1000}


@contextmanager
def ros1_link(robot, log, core):
    peer = RosPeer(core.environment)
    try:
        with Ros1Transport() as transport:
            source = RosSource(robot, RosTopics(), transport)
            for topic in ("position_monitoring", "condition_monitoring"):
                # The definition is the authors'; the package name is one we have never heard of.
                told = peer.ask(
                    op="advertise",
                    topic=topic,
                    type="some_package/Monitoring",
                    definition=AUTHORS_TEXT,
                    wait_s=10.0,
                )
                assert told["heard"] == 1
            for topic, t, fields in messages_of(log):
                header = {"seq": 0, "stamp": stamp(t), "frame_id": ""}
                peer.ask(op="publish", topic=topic, content={"header": header, **fields})
            yield source
    finally:
        peer.close()


@contextmanager
def rosbridge_link(robot, log):
    server = FakeRosbridge(free_port())
    try:
        with RosbridgeTransport("127.0.0.1", server.port) as transport:
            source = RosSource(robot, RosTopics(), transport)
            wait_for(lambda: server.has_subscriber("condition_monitoring"))
            for topic, t, fields in messages_of(log):
                header = {"seq": 0, "stamp": stamp(t), "frame_id": ""}
                server.publish(topic, {"header": header, **fields})
            yield source
    finally:
        server.stop()


@contextmanager
def ros2_link(robot, log):
    zenoh = pytest.importorskip("zenoh")
    port = free_port()
    with (
        zenoh_router(port),
        zenoh.open(client_of(port)) as theirs,
        Ros2Transport("127.0.0.1", port) as transport,
    ):
        source = RosSource(robot, RosTopics(), transport)
        codec, publishers = RosCodec(2), {}
        for topic in ("position_monitoring", "condition_monitoring"):
            # As rmw_zenoh of ROS 2 Humble names it, under a package we have never heard of.
            key = f"0/{topic}/some_package::msg::dds_::Monitoring_/TypeHashNotSupported"
            publishers[topic] = publisher = theirs.declare_publisher(key)
            wait_for(lambda publisher=publisher: publisher.matching_status.matching)
        for topic, t, fields in messages_of(log):
            content = {"header": {"stamp": stamp(t), "frame_id": ""}, **fields}
            message = Outgoing(topic, "some_package/Monitoring", content)
            publishers[topic].put(codec.encode(message))
        yield source


LINKS = ["session", "ros1 bag", "ros2 bag", "mcap", "ros1", "ros2", "rosbridge"]


@pytest.fixture(params=LINKS)
def link(request, armpi, little_log, tmp_path):
    """A source that carries the little log."""
    if request.param == "session":
        yield replay(session(little_log, tmp_path), armpi, Pace(0.0))
    elif request.param == "ros1":
        with ros1_link(armpi, little_log, request.getfixturevalue("roscore")) as source:
            yield source
    elif request.param == "ros2":
        with ros2_link(armpi, little_log) as source:
            yield source
    elif request.param == "rosbridge":
        with rosbridge_link(armpi, little_log) as source:
            yield source
    else:
        form = request.param.replace(" bag", "")
        yield replay(bag(little_log, tmp_path, form), armpi, Pace(0.0))


def test_a_run_set_is_refused_with_what_a_user_can_do(armpi, tmp_path):
    path = tmp_path / "runs.nc"
    path.touch()
    with pytest.raises(InputError, match=r"for `diagnose`.* write an ft\.Source .*live\.md"):
        replay(path, armpi, Pace(0.0))


def test_a_csv_file_of_one_run_is_replayed(armpi, tmp_path):
    path, names = tmp_path / "log.csv", [f"command_{name}" for name in armpi.motor_names]
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (30, len(names) + 3))
    rows[10:20, : len(names)] = rows[9, : len(names)]  # told nothing new
    lines = [",".join(["time", *names, "x", "y", "z"])]
    lines += [",".join(map(repr, (0.05 * k, *row.tolist()))) for k, row in enumerate(rows)]
    path.write_text("\n".join(lines))
    source = replay(path, armpi, Pace(0.0))
    events = []
    while not source.ended:
        events.append(source.poll(WAIT_S))
    read = [e for e in events if isinstance(e, Reading)]
    assert [e.time for e in read] == pytest.approx(0.05 * np.arange(30))
    assert np.stack([e.tool for e in read]) == pytest.approx(rows[:, -3:])
    sent = [e for e in events if isinstance(e, CommandSent)]
    assert sent[-1].target == pytest.approx(rows[-1, : len(names)])
    assert not [e for e in sent if 0.55 < e.time < 0.95]

    of_two = [f"run,{lines[0]}", *(f"{k // 15},{line}" for k, line in enumerate(lines[1:]))]
    path.write_text("\n".join(of_two))
    with pytest.raises(InputError, match="holds 2 runs, expected one"):
        replay(path, armpi, Pace(0.0))


def fetch(source, count):
    events = []
    while len(events) < count:
        event = source.poll(WAIT_S)
        assert event is not None, f"only {len(events)} of {count} events came"
        events.append(event)
    return events


def radians(counts):
    return np.deg2rad(120.0 - 0.24 * counts)


def test_a_link_brings_what_the_robot_said(link, little_log, twin):
    events = fetch(link, 63)
    commands = [e for e in events if isinstance(e, CommandSent)]
    readings = [e for e in events if isinstance(e, Reading)]
    assert (len(commands), len(readings)) == (3, 60)
    zero = min(commands[0].time, readings[0].time) - little_log.zero
    stamps = np.array([r.time for r in readings]) - zero
    assert_allclose(stamps, little_log.reading_time, rtol=0, atol=2e-6)
    stamps = np.array([c.time for c in commands]) - zero
    assert_allclose(stamps, little_log.command_time, rtol=0, atol=2e-6)
    assert_allclose([c.target for c in commands], radians(little_log.target), atol=1e-12)
    assert_allclose([c.duration for c in commands], little_log.duration_ms / 1000, atol=1e-12)
    angles = radians(little_log.counts)
    assert_allclose([r.position for r in readings], angles, atol=1e-12)
    assert_allclose([r.tool for r in readings], twin.path(angles), atol=1e-12)


def test_a_link_counts_what_it_brings_and_says_when_nothing_comes(link):
    fetch(link, 63)
    assert link.poll(0.2) is None
    assert (link.counts.received, link.counts.garbage, link.counts.dropped) == (63, 0, 0)
    assert link.name


def test_an_emulated_robot_is_a_link(armpi):
    pytest.importorskip("mujoco")
    work = Shifts(break_s=0.0, duration_s=4.0)
    with EmulatedArm(Emulation(armpi, NO_IMPERFECTIONS), shifts=work) as source:
        events = []
        while not source.ended:
            event = source.poll(1.0)
            events += [] if event is None else [event]
    assert [e.time for e in events if isinstance(e, CommandSent)] == [1.0, 3.0]
    assert sum(isinstance(e, Reading) for e in events) == 400
    assert source.counts.received == 402
    assert source.poll(0.1) is None


def test_logs_end_and_networks_do_not(armpi, little_log, tmp_path):
    source = replay(session(little_log, tmp_path), armpi, Pace(0.0))
    fetch(source, 63)
    assert source.poll(0.1) is None
    assert source.ended
    assert not RosSource.ended


def test_a_replay_keeps_its_pace(monkeypatch, armpi, little_log, tmp_path):
    now = [1000.0]
    clock = SimpleNamespace(
        monotonic=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds)
    )
    monkeypatch.setattr(pace, "time", clock)
    source = replay(session(little_log, tmp_path), armpi, Pace(10.0))
    fetch(source, 63)
    assert now[0] == pytest.approx(1000.59)  # 5.9 s of log


def test_an_event_that_is_not_due_is_waited_for_no_longer_than_asked(monkeypatch):
    now, slept = [1000.0], []
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=slept.append)
    monkeypatch.setattr(pace, "time", clock)
    kept = Pace(2.0)
    assert kept.due(50.0, 0.2)
    assert not kept.due(51.0, 0.2)
    assert slept == [0.2]
    now[0] = 1000.4
    assert kept.due(51.0, 0.2)
    assert slept == [0.2, pytest.approx(0.1)]


def test_the_ros_message_of_the_authors_has_the_right_md5(roscore):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(MONITORING_TEXT, MONITORING))
    _, md5 = store.generate_msgdef(MONITORING)
    ours = message_class(RosCodec(1), "cm/msg_cm")
    assert ours._type == "cm/msg_cm"
    assert ours._md5sum == md5
    peer = RosPeer(roscore.environment)
    told = peer.ask(
        op="advertise", topic="md5", type="cm/msg_cm", definition=AUTHORS_TEXT, wait_s=0.0
    )
    peer.close()
    assert told["md5"] == md5


def test_what_a_rosbridge_link_asks_for(armpi):
    server = FakeRosbridge(free_port())
    topics = RosTopics(
        command="/arm/command",
        command_type="trajectory_msgs/JointTrajectory",
        tool="/tool",
        tool_type="geometry_msgs/PoseStamped",
    )
    with RosbridgeTransport("127.0.0.1", server.port) as transport:
        source = RosSource(armpi, topics, transport)
        wait_for(lambda: server.has_subscriber("/tool"))
        pose = {"position": {"x": 0.1, "y": 0.2, "z": 0.3}, "orientation": {}}
        header = {"stamp": {"sec": 7, "nanosec": 500_000_000}, "frame_id": ""}
        server.publish("/tool", {"header": header, "pose": pose})
        server.send_raw("/tool", json.dumps({"op": "publish", "topic": "/tool", "msg": {}}))
        event = source.poll(WAIT_S)
        wait_for(lambda: source.counts.garbage == 1)
    assert event.time == 7.5
    assert_allclose(event.tool, [0.1, 0.2, 0.3])
    assert server.types["/arm/command"] == "trajectory_msgs/JointTrajectory"
    assert server.types["/tool"] == "geometry_msgs/PoseStamped"
    server.stop()
