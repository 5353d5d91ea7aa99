"""A robot on ROS 2 without a ROS installation: Zenoh, by the conventions of rmw_zenoh.

    topic     <domain>/<topic>/<type, mangled as DDS does>/<hash of the type>
    payload   the message as CDR
    attached  sequence number and time of sending [ns], 8 bytes each, then 16 and 16 bytes of a gid
    alive     @ros2_lv/<domain>/<session>/<node>/<entity>/NN or MP/%/%/<name of the node>/...

Discovery and messages pass through the router, `rmw_zenohd`, to which sessions connect as clients.

Section: docs/live.md#ros-2
"""

from __future__ import annotations

import json
import os
import struct
import time
import uuid
from functools import partial
from typing import Any

from failuretwin.connection.links.base import EventQueue
from failuretwin.connection.links.live_events import NetworkSource
from failuretwin.connection.links.network_sinks import DiagnosticsSink, RobotSink
from failuretwin.connection.links.ros2_messages import Ros2Types
from failuretwin.connection.links.ros_messages import (
    DIAGNOSTICS_TYPE,
    DiagnosticsPublisher,
    Outgoing,
    RosTopics,
    RosWriter,
)
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.bag_messages import NS_PER_S, Role
from failuretwin.digital_model.robot import Robot

ROUTER_PORT = 7447
"""Where the router of rmw_zenoh listens unless told otherwise."""
LARGEST_DOMAIN = 232
"""Domains of ROS 2 count from 0 to this."""
NODE = "failuretwin"
QOS = "::,10:,:,:,,"
"""Quality of service as rmw_zenoh writes it: reliable, volatile, the last ten messages."""


def domain_id() -> int:
    """Return the domain that ``ROS_DOMAIN_ID`` names; 0 unless it does.

    Raises:
        InputError: If it names none.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "0") or "0"
    if not (text.isdecimal() and int(text) <= LARGEST_DOMAIN):
        raise InputError(
            f"ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to {LARGEST_DOMAIN}."
        )
    return int(text)


def connect(host: str = "localhost", port: int = ROUTER_PORT) -> Any:
    """Return a session with a router, a `zenoh.Session`.

    Raises:
        InputError: If zenoh is missing or no router answers.
    """
    with needs_extra("ROS 2 needs eclipse-zenoh", "ros2"):
        import zenoh
    config, endpoint = zenoh.Config(), f"tcp/{host}:{port}"
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise InputError(
            f"no Zenoh router answers at {endpoint}. Start one there: `ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`, and the robot's nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp."
        ) from error


def _mangled(type_: str) -> str:
    """Return the name of a type in a key, such as ``std_msgs::msg::dds_::String_``."""
    package, _, name = type_.replace("/msg/", "/").partition("/")
    return f"{package}::msg::dds_::{name}_"


def _plain(mangled: str) -> str:
    """Return what `_mangled` was given, by its ROS 2 name."""
    package, _, name = mangled.partition("::msg::dds_::")
    return f"{package}/msg/{name.removesuffix('_')}"


def _topic_key(topic: str, type_: str, hash_: str) -> str:
    """Return the key of a topic; a name without a slash in front is taken as one with it."""
    return f"{domain_id()}/{topic.lstrip('~/')}/{type_}/{hash_}"


class Ros2Source(NetworkSource):
    """Listens to the topics of a robot; a router that goes away and comes back is no trouble.

    Types are known by the key that a message comes under, and those of ROS by their name.

    Args:
        robot: The robot.
        topics: Its topics.
        session: The session, see `connect`.
        queue: Where events wait to be fetched; None: a queue of its own.

    Raises:
        InputError: If rosbags is missing, or the robot does not fit the topics.
    """

    def __init__(
        self, robot: Robot, topics: RosTopics, session: Any, queue: EventQueue | None = None
    ) -> None:
        super().__init__(robot, topics, queue)
        self._types, self._session = Ros2Types(), session
        names = [name for _, name, _ in topics.subscribed]
        self.name = f"ROS 2, domain {domain_id()}: {', '.join(names)}"
        self._gone, self._reconnects = False, 0
        self._subscribers = [
            session.declare_subscriber(_topic_key(name, "*", "*"), partial(self._take, role))
            for role, name, _ in topics.subscribed
        ]

    @property
    def reconnects(self) -> int:
        """How often the router was seen to go away and come back."""
        gone = _router_gone(self._session)
        self._reconnects += self._gone and not gone
        self._gone = gone
        return self._reconnects

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def _take(self, role: Role, sample: Any) -> None:
        type_ = _plain(str(sample.key_expr).split("/")[-2])
        self.take(role, lambda: self._types.from_bytes(type_, bytes(sample.payload)))


def _router_gone(session: Any) -> bool:
    return session.is_closed() or not session.info.routers_zid()


class _Publishers:
    """Publishers that ROS 2 sees as those of a node.

    Args:
        session: The session.
        topics: Name and type of each topic.
    """

    def __init__(self, session: Any, topics: list[tuple[str, str]]) -> None:
        self._session, self._types = session, Ros2Types()
        self._gid, self._sent = uuid.uuid4().bytes, 0
        alive = f"@ros2_lv/{domain_id()}/{session.zid()}/0"
        declare = session.liveliness().declare_token
        self._tokens = [declare(f"{alive}/0/NN/%/%/{NODE}")]
        self._publishers = {}
        for number, (name, type_) in enumerate(topics, start=1):
            known = _mangled(type_), self._types.hash_of(type_)
            self._publishers[name] = session.declare_publisher(_topic_key(name, *known))
            topic = f"/{name.lstrip('~/')}".replace("/", "%")
            said = "/".join((topic, *known, QOS))
            self._tokens.append(declare(f"{alive}/{number}/MP/%/%/{NODE}/{said}"))

    @property
    def trouble(self) -> str:
        """What keeps messages from arriving."""
        return "the Zenoh router is gone" if _router_gone(self._session) else ""

    def send(self, message: Outgoing) -> None:
        """Publish a message on its topic."""
        self._sent += 1
        now_ns = round(time.time() * NS_PER_S)
        attached = struct.pack("<qqB", self._sent, now_ns, len(self._gid)) + self._gid
        data = self._types.to_bytes(message.type, message.content)
        self._publishers[message.topic].put(data, attachment=attached)

    def close(self) -> None:
        """Stop publishing."""
        for declared in (*self._publishers.values(), *self._tokens):
            declared.undeclare()


class Ros2Robot(RobotSink):
    """Plays a robot on ROS 2; see `RobotSink`.

    Args:
        robot: The robot.
        topics: Its topics.
        session: The session, see `connect`.

    Raises:
        InputError: If rosbags is missing, or a type cannot be published.
    """

    def __init__(self, robot: Robot, topics: RosTopics, session: Any) -> None:
        writer = RosWriter(robot, topics)
        super().__init__("ROS 2", writer, _Publishers(session, writer.topics))


class Ros2Diagnostics(DiagnosticsSink):
    """Publishes answers as diagnostics on ROS 2.

    Args:
        robot: The robot.
        topics: Names the topic.
        session: The session, see `connect`.

    Raises:
        InputError: If rosbags is missing.
    """

    def __init__(self, robot: Robot, topics: RosTopics, session: Any) -> None:
        bulletin = DiagnosticsPublisher(robot, topics)
        publishers = _Publishers(session, [(topics.diagnostics, DIAGNOSTICS_TYPE)])
        super().__init__("ROS 2 diagnostics", bulletin, publishers)
