"""Transport to ROS 2 over Zenoh, by the conventions of rmw_zenoh, without a ROS installation.

    topic       <domain>/<topic>/<type, mangled as DDS does>/<hash of the type>
    payload     the message as CDR
    attachment  sequence number, time of sending [ns] (8 bytes each), 16, and 16 bytes of a gid
    liveliness  @ros2_lv/<domain>/<session>/<node>/<entity>/NN or MP/%/%/<name of the node>/...

Discovery and messages pass through the router, `rmw_zenohd`, to which sessions connect as clients.

Section: docs/live.md#ros-2
"""

from __future__ import annotations

import json
import os
import struct
import time
import uuid
from typing import Any

from failuretwin.connection.links.ros_transport import Outgoing, RosCodec, Take, Transport
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.readers.bag_messages import NS_PER_S

ROUTER_PORT = 7447
"""Default port of the router of rmw_zenoh."""
LARGEST_DOMAIN = 232
"""Largest domain number of ROS 2."""
NODE = "failuretwin"
QOS = "::,10:,:,:,,"
"""Quality of service as rmw_zenoh writes it: reliable, volatile, the last ten messages."""


def domain_id() -> int:
    """Return the domain in ``ROS_DOMAIN_ID``; default 0.

    Raises:
        InputError: If it is not a domain number.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "0") or "0"
    if not (text.isdecimal() and int(text) <= LARGEST_DOMAIN):
        raise InputError(
            f"ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to {LARGEST_DOMAIN}."
        )
    return int(text)


def _open_session(host: str, port: int) -> Any:
    """Return a `zenoh.Session` with a router.

    Raises:
        InputError: If zenoh is missing or no router answers.
    """
    with needs_extra("ROS 2 needs eclipse-zenoh", "ros2"):
        import zenoh
    endpoint, alone = f"tcp/{host}:{port}", {"multicast": {"enabled": False}}
    settings = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": alone}
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise InputError(
            f"no Zenoh router answers at {endpoint}. Start one there: `ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`, and the robot's nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp."
        ) from error


class Ros2Transport(Transport):
    """Session with a Zenoh router; a node of ROS 2 once it publishes.

    Types are known by the key of a message. Those of ROS have their own fields, all others the
    fields of the authors' message, because Zenoh sends no definitions along.

    Raises:
        InputError: If an extra is missing, ``ROS_DOMAIN_ID`` is invalid, or no router answers.
    """

    far_side = "Zenoh router"

    def __init__(self, host: str = "localhost", port: int = ROUTER_PORT) -> None:
        self._domain = domain_id()
        self.name = f"ROS 2, domain {self._domain}"
        self._session = _open_session(host, port)
        self._codec = RosCodec(2)
        self._gid, self._sent = uuid.uuid4().bytes, 0
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []

    def is_gone(self) -> bool:
        """Return whether the router is gone."""
        return self._session.is_closed() or not self._session.info.routers_zid()

    def is_heard(self, topic: str) -> bool:
        """Return whether another session listens to an advertised topic."""
        return bool(self._publishers[topic].matching_status.matching)

    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic, whatever its type and hash."""

        def receive(sample: Any) -> None:
            name = _unmangled(str(sample.key_expr).split("/")[-2])
            take(lambda: self._codec.decode(bytes(sample.payload), name))

        key = f"{self._domain}/{topic.lstrip('~/')}/*/*"
        self._declared.append(self._session.declare_subscriber(key, receive))

    def advertise(self, topic: str, type_: str) -> None:
        """Declare a publisher, and the liveliness tokens by which ROS 2 knows it."""
        import zenoh

        name, hash_ = topic.lstrip("~/"), self._codec.hash_of(type_)
        key = f"{self._domain}/{name}/{_mangled(type_)}/{hash_}"
        # This publisher tells whether others listen. What it sends would not come back to us.
        others = zenoh.Locality.REMOTE
        self._publishers[topic] = self._session.declare_publisher(key, allowed_destination=others)
        alive = f"@ros2_lv/{self._domain}/{self._session.zid()}/0"
        number = len(self._publishers)
        known = f"%{name.replace('/', '%')}/{_mangled(type_)}/{hash_}/{QOS}"
        tokens = [f"{alive}/{number}/MP/%/%/{NODE}/{known}"]
        if number == 1:
            tokens.append(f"{alive}/0/NN/%/%/{NODE}")
        self._declared += map(self._session.liveliness().declare_token, tokens)

    def publish(self, message: Outgoing) -> None:
        """Publish a message with the attachment that rmw_zenoh expects."""
        self._sent += 1
        now_ns = round(time.time() * NS_PER_S)
        attached = struct.pack("<qqB", self._sent, now_ns, len(self._gid)) + self._gid
        key = self._publishers[message.topic].key_expr
        self._session.put(key, self._codec.encode(message), attachment=attached)

    def close(self) -> None:
        """Close the session, and with it all subscriptions and publishers."""
        self._session.close()


def _mangled(type_: str) -> str:
    """Return the name of a type in a key, such as ``std_msgs::msg::dds_::String_``."""
    package, _, name = type_.replace("/msg/", "/").partition("/")
    return f"{package}::msg::dds_::{name}_"


def _unmangled(mangled: str) -> str:
    """Return the ROS 2 name of a type in a key, such as ``std_msgs/msg/String``."""
    package, _, name = mangled.partition("::msg::dds_::")
    return f"{package}/msg/{name.removesuffix('_')}"
