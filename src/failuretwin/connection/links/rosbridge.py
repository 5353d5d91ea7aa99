"""Transport to a rosbridge server of ROS 1 or ROS 2, over a web socket."""

from __future__ import annotations

import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

from failuretwin.connection.links.ros_transport import Outgoing, Take, Transport
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.readers.bag_messages import kind_of_type

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
GONE = "the rosbridge server is gone"
_ROS1_TIME = {"secs": "sec", "nsecs": "nanosec"}
"""Fields of a time in ROS 1, and in ROS 2."""


class RosbridgeTransport(Transport):
    """Client of a rosbridge server, by roslibpy, which reconnects and subscribes again by itself.

    Args:
        host: Host of the server.
        port: Its port.

    Raises:
        InputError: If roslibpy is missing or no server answers.
    """

    def __init__(self, host: str, port: int = BRIDGE_PORT) -> None:
        with needs_extra("rosbridge needs roslibpy", "live"):
            import roslibpy
        self._connections = 0
        self.refusals: list[str] = []
        self._topics: dict[str, Any] = {}
        self._subscribed: list[Any] = []
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

    @property
    def trouble(self) -> str:
        """Whether the server is gone."""
        return "" if self._ros.is_connected else GONE

    @property
    def reconnects(self) -> int:
        """Number of times that the server went away and came back."""
        return max(0, self._connections - 1)

    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic, which must be of the type."""
        kind, subscribed = kind_of_type(type_), self._topic(topic, type_)
        subscribed.subscribe(lambda message: take(lambda: (_as_object(message), kind)))
        self._subscribed.append(subscribed)

    def advertise(self, topic: str, type_: str) -> None:
        """Prepare a topic for publishing."""
        self._topics[topic] = self._topic(topic, type_)
        self._topics[topic].advertise()

    def publish(self, message: Outgoing) -> None:
        """Publish a message."""
        if self._ros.is_connected:
            self._topics[message.topic].publish(message.content)

    def check_listener(self, topic: str) -> None:
        """Raise InputError if the server is gone; it does not tell who listens."""
        if self.trouble:
            raise InputError(f"{GONE}; nothing was sent.")

    def close(self) -> None:
        """Close the connection, and wait for the server to confirm."""
        if self._ros.is_connected:
            for subscribed in self._subscribed:
                subscribed.unsubscribe()
            for topic in self._topics.values():
                topic.unadvertise()
            closed = threading.Event()
            self._ros.factory.once("close", lambda _: closed.set())
            self._ros.close()
            closed.wait(GOODBYE_S)
        self._ros.terminate()

    def _connected(self, protocol: Any) -> None:
        """Count a connection, and listen to the server's status messages.

        roslibpy registers no handler for them and has no interface to add one.
        """
        self._connections += 1
        protocol._message_handlers["status"] = self._take_status

    def _take_status(self, status: Any) -> None:
        """Keep a complaint, such as a refused topic, which stays silent from then on."""
        if status.get("level") in COMPLAINTS:
            self.refusals.append(f"rosbridge says: {status.get('msg', '')}")


def _as_object(value: Any) -> Any:
    """Return JSON as objects with fields, times under their ROS 2 names."""
    if isinstance(value, dict):
        fields = {_ROS1_TIME.get(name, str(name)): _as_object(part) for name, part in value.items()}
        return SimpleNamespace(**fields)
    if isinstance(value, list):
        return [_as_object(part) for part in value]
    return value
