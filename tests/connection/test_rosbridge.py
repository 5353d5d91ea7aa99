"""rosbridge with trouble. The server is a fake, see fake_rosbridge.py."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from failuretwin.connection.links import ros_messages, rosbridge
from failuretwin.connection.links.base import OK, Answer
from failuretwin.connection.links.ros_link import RosSink, RosSource
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from roscores import free_port
from waiting import WAIT_S, wait_for

pytest.importorskip("roslibpy")
TOPICS = RosTopics(position="", tool="/tool", commands_late_s=1.0)


def point(t):
    header = {"stamp": {"sec": t, "nanosec": 0}, "frame_id": "base_link"}
    return {"header": header, "point": {"x": 0.1, "y": 0.2, "z": 0.3}}


def answer():
    return Answer(9.5, OK, Diagnosis("live", {"healthy": 1.0}, verdict="healthy"))


def test_a_server_that_goes_and_comes_back_is_no_trouble(armpi, server, transport):
    sink = RosSink(DiagnosticsWriter(armpi, TOPICS), transport)
    with RosSource(armpi, TOPICS, transport) as source:
        wait_for(lambda: server.has_subscriber("/tool"))
        server.publish("/tool", point(1))
        assert source.poll(WAIT_S).time == 1.0
        server.stop()
        wait_for(lambda: sink.trouble == "the rosbridge server is gone")
        sink.put(answer())
        assert source.poll(0.2) is None
        server.start()
        wait_for(lambda: server.has_subscriber("/tool"))
        server.publish("/tool", point(2))
        assert source.poll(WAIT_S).time == 2.0
        assert source.counts.reconnects == 1
        server.published.clear()
        wait_for(lambda: sink.put(answer()) or server.published)


def test_diagnostics_by_rosbridge(monkeypatch, armpi, server, transport):
    now = [0.0]
    monkeypatch.setattr(ros_messages, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with RosSink(DiagnosticsWriter(armpi, TOPICS), transport) as sink:
        sink.put(answer())
        sink.put(answer())  # within the same second
        now[0] = 1.5
        sink.put(answer())
        wait_for(lambda: len(server.published) == 2)
    call, again = server.published
    assert again["msg"] == call["msg"]
    assert server.types["/diagnostics"] == "diagnostic_msgs/DiagnosticArray"
    assert call["msg"]["header"]["stamp"] == {"secs": 9, "nsecs": 500_000_000}
    assert [s["name"] for s in call["msg"]["status"]][:2] == [
        "failuretwin: arm",
        "failuretwin: motor_1",
    ]


def test_bytes_that_are_no_protocol_do_no_harm(armpi, server, transport):
    with RosSource(armpi, TOPICS, transport) as source:
        wait_for(lambda: server.has_subscriber("/tool"))
        server.send_raw("/tool", "{not json")
        server.publish("/tool", {"header": 5, "point": None})
        server.publish("/tool", {**point(1), "point": {"x": 1e9, "y": 0.0, "z": 0.0}})
        server.publish("/tool", point(3))
        event = source.poll(WAIT_S)
        assert event.time == 3.0
        np.testing.assert_allclose(event.tool, [0.1, 0.2, 0.3])
        assert source.counts.garbage == 2


def test_without_a_server_the_user_is_told(monkeypatch):
    monkeypatch.setattr(rosbridge, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match="no rosbridge server answers"):
        rosbridge.RosbridgeTransport("127.0.0.1", free_port())


def test_what_a_server_refuses_is_told(armpi, server, transport):
    """A topic that it refuses stays silent; without its own words nobody would know why."""
    with RosSource(armpi, TOPICS, transport) as source:
        wait_for(lambda: server.has_subscriber("/tool"))
        said = {"op": "status", "level": "error", "msg": "subscribe: no permission for /tool"}
        server.send_raw("/tool", json.dumps(said))
        server.send_raw("/tool", json.dumps({**said, "level": "info", "msg": "welcome"}))
        server.publish("/tool", point(1))
        assert source.poll(WAIT_S).time == 1.0
        assert source.counts.garbage == 1
        assert source.counts.last_garbage == "rosbridge says: subscribe: no permission for /tool"
