"""Transport to a rosbridge server of ROS 1 or ROS 2, over a web socket."""

from __future__ import annotations

import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

from failuretwin.connection.links.ros_transport import Outgoing, Take, Transport
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.readers.bag_messages import Kind, kind_of_type

BRIDGE_PORT = 9090
"""Default port of rosbridge servers."""
CONNECT_S = 5.0
"""Longest wait for the server at the start [s]."""
RECONNECT_S = 2.0
"""Longest pause between two attempts to reach a server that is gone [s]."""
GOODBYE_S = 2.0
"""Longest wait for the server at the end [s]."""
COMPLAINTS = ("error", "warning")
"""Levels of the server's status messages that count as refusals."""
_ROS1_TIME = {"secs": "sec", "nsecs": "nanosec"}
"""Fields of a time in ROS 1, and in ROS 2."""


class RosbridgeTransport(Transport):
    """Client of a rosbridge server, by roslibpy, which reconnects and subscribes again by itself.

    Raises:
        InputError: If roslibpy is missing or no server answers.
    """

    far_side = "rosbridge server"

    def __init__(self, host: str, port: int = BRIDGE_PORT) -> None:
        with needs_extra("rosbridge needs roslibpy", "live"):
            import roslibpy
        self._topics: dict[str, Any] = {}
        self._takes: list[Take] = []
        self._ros = ros = roslibpy.Ros(host, port, transport="asyncio")
        self._topic = partial(roslibpy.Topic, ros)
        ros.factory.set_max_delay(RECONNECT_S)
        ros.factory.on("ready", self._connected)
        try:
            ros.run(CONNECT_S)
        except roslibpy.core.RosTimeoutError as error:
            ros.terminate()
            raise InputError(
                f"no rosbridge server answers at {host}:{port}. Start one there, such as "
                "`roslaunch rosbridge_server rosbridge_websocket.launch`."
            ) from error
        self.name = f"rosbridge {ros.factory.url}"

    def is_gone(self) -> bool:
        """Return whether the server is gone."""
        return not self._ros.is_connected

    def is_heard(self, topic: str) -> bool:
        """Return whether the server is there; it does not tell who listens."""
        return not self.is_gone()

    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic, which must be of the type."""
        kind = kind_of_type(type_)
        heard = self._topic(topic, type_)
        heard.subscribe(lambda message: take(lambda: (_as_object(message), kind)))
        self._takes.append(take)

    def advertise(self, topic: str, type_: str) -> None:
        """Prepare a topic for publishing."""
        self._topics[topic] = self._topic(topic, type_)
        self._topics[topic].advertise()

    def publish(self, message: Outgoing) -> None:
        """Publish a message."""
        if self._ros.is_connected:
            self._topics[message.topic].publish(message.content)

    def close(self) -> None:
        """Close the connection, and with it all topics; wait for the server to confirm."""
        if self._ros.is_connected:
            closed = threading.Event()
            self._ros.factory.once("close", lambda _: closed.set())
            self._ros.close()
            closed.wait(GOODBYE_S)
        self._ros.terminate()

    def _connected(self, protocol: Any) -> None:
        """Listen to the server's status messages; roslibpy has no interface for that."""
        protocol._message_handlers["status"] = self._take_status

    def _take_status(self, status: Any) -> None:
        """Hand on a complaint, such as a refused topic, which stays silent from then on."""
        if status.get("level") not in COMPLAINTS:
            return

        def refuse() -> tuple[Any, Kind]:
            raise InputError(f"rosbridge says: {status.get('msg', '')}")

        for take in self._takes[:1]:
            take(refuse)


def _as_object(value: Any) -> Any:
    """Return JSON as objects with fields, times under their ROS 2 names."""
    if isinstance(value, dict):
        fields = {_ROS1_TIME.get(name, str(name)): _as_object(part) for name, part in value.items()}
        return SimpleNamespace(**fields)
    if isinstance(value, list):
        return [_as_object(part) for part in value]
    return value
