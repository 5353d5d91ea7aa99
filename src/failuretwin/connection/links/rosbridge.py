"""A robot behind a rosbridge server, ROS 1 or ROS 2, over a web socket."""

from __future__ import annotations

import threading
from functools import partial
from types import SimpleNamespace
from typing import Any, Self

from failuretwin.connection.links.base import Answer, EventQueue, Item
from failuretwin.connection.links.commander import Order
from failuretwin.connection.links.live_events import NetworkSource
from failuretwin.connection.links.network_commander import Commanding, Orders
from failuretwin.connection.links.ros_messages import (
    DIAGNOSTICS_TYPE,
    DiagnosticsPublisher,
    Outgoing,
    RosTopics,
)
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.bag_messages import Kind, Role, kind_of_type
from failuretwin.digital_model.robot import Robot

CONNECT_S = 5.0
"""Longest wait for the server at the start [s]."""
RECONNECT_S = 2.0
"""Longest pause between two attempts to reach a server that has gone [s]."""
GOODBYE_S = 2.0
"""Longest wait for the server in the end [s]."""
STATUS = "status of the server"
"""The event under which a server's own words are passed on."""
COMPLAINTS = ("error", "warning")
"""Levels of them that are told."""
_ROS1_TIME = {"secs": "sec", "nsecs": "nanosec"}
"""What ROS 1 calls the parts of a time, and what ROS 2 does."""


def connect(host: str, port: int) -> Any:
    """Return a connection to a rosbridge server, a `roslibpy.Ros`.

    Raises:
        InputError: If roslibpy is missing or no server answers.
    """
    with needs_extra("rosbridge needs roslibpy", "live"):
        import roslibpy
    ros = roslibpy.Ros(host, port, transport="asyncio")
    ros.factory.set_max_delay(RECONNECT_S)
    ros.factory.on("ready", partial(_hear_status, ros.factory))
    try:
        ros.run(CONNECT_S)
    except roslibpy.core.RosTimeoutError as error:
        ros.terminate()
        raise InputError(
            f"no rosbridge server answers at {host}:{port}. Start one there, such as "
            "`roslaunch rosbridge_server rosbridge_websocket.launch`."
        ) from error
    return ros


def _hear_status(factory: Any, protocol: Any) -> None:
    """Pass on what a server says of our calls, such as that it refuses one.

    roslibpy has a place for that, which stays empty, and takes no handler of ours for it.
    """
    protocol._message_handlers["status"] = partial(factory.emit, STATUS)


def disconnect(ros: Any) -> None:
    """Close a connection, and wait for a server that is there to agree."""
    if ros.is_connected:
        closed = threading.Event()
        ros.factory.once("close", lambda _: closed.set())
        ros.close()
        closed.wait(GOODBYE_S)
    ros.terminate()


class RosbridgeSource(NetworkSource):
    """Listens to the topics of a robot; a server that goes away and comes back is no trouble.

    Args:
        robot: The robot.
        topics: Its topics, with their types.
        ros: The connection, see `connect`.
        queue: Where events wait to be fetched.
    """

    def __init__(
        self, robot: Robot, topics: RosTopics, ros: Any, queue: EventQueue | None = None
    ) -> None:
        import roslibpy

        names = [name for _, name, _ in topics.subscribed]
        self.name = f"rosbridge {ros.factory.url}: {', '.join(names)}"
        self._ros = ros
        super().__init__(robot, topics, queue)
        self._reconnects = -1
        self._topics = []
        self._count_connections(None)
        ros.factory.on(STATUS, self._complain)
        for role, name, type_ in topics.subscribed:
            topic = roslibpy.Topic(ros, name, type_)
            topic.subscribe(partial(self._take, role, kind_of_type(type_)))
            self._topics.append(topic)

    @property
    def reconnects(self) -> int:
        """How often the server went away and came back."""
        return self._reconnects

    def close(self) -> None:
        """Stop listening."""
        if self._ros.is_connected:
            for topic in self._topics:
                topic.unsubscribe()

    def _count_connections(self, _: Any) -> None:
        self._reconnects += 1
        self._ros.factory.once("close", self._await_next)

    def _await_next(self, _: Any) -> None:
        self._ros.factory.once("ready", self._count_connections)

    def _complain(self, status: Any) -> None:
        """Take what the server says of our calls: a topic that it refuses will stay silent."""
        if status.get("level") in COMPLAINTS:
            self.note(f"rosbridge says: {status.get('msg', '')}")

    def _take(self, role: Role, kind: Kind, message: Any) -> None:
        self.take(role, lambda: (_as_object(message), kind))


class RosbridgeCommander(Commanding, RosbridgeSource):
    """Listens to a robot and tells it to move, by a message for each order.

    Args:
        robot: The robot.
        topics: Its topics, with their types.
        ros: The connection, see `connect`.
    """

    def __init__(self, robot: Robot, topics: RosTopics, ros: Any) -> None:
        import roslibpy

        self._orders = Orders(robot, topics, self._publish)
        super().__init__(robot, topics, ros)
        self._command = roslibpy.Topic(ros, *self._orders.topic)
        self._command.advertise()

    def send(self, order: Order) -> None:
        """Tell the motors to move.

        Raises:
            InputError: If the server has gone.
        """
        if not self._ros.is_connected:
            raise InputError("the rosbridge server is gone; nothing was sent.")
        self._orders.send(order)

    def close(self) -> None:
        """Stop listening and sending."""
        super().close()
        if self._ros.is_connected:
            self._command.unadvertise()

    def _publish(self, message: Outgoing) -> None:
        import roslibpy

        self._command.publish(roslibpy.Message(message.content))


class RosbridgeDiagnostics:
    """Publishes answers as diagnostics: every second, and at once when a status gets worse.

    Args:
        robot: The robot.
        topics: Names the topic.
        ros: The connection, see `connect`.
    """

    def __init__(self, robot: Robot, topics: RosTopics, ros: Any) -> None:
        import roslibpy

        self.name = f"rosbridge {ros.factory.url} diagnostics"
        self._ros = ros
        self._bulletin = DiagnosticsPublisher(robot, topics)
        self._topic = roslibpy.Topic(ros, topics.diagnostics, DIAGNOSTICS_TYPE)
        self._topic.advertise()

    @property
    def trouble(self) -> str:
        """What keeps items from arriving just now."""
        return "" if self._ros.is_connected else "the rosbridge server is gone"

    def put(self, item: Item) -> None:
        """Publish an answer if it is time to and the server is there."""
        if not isinstance(item, Answer) or self.trouble:
            return
        message = self._bulletin.message(item)
        if message is not None:
            import roslibpy

            self._topic.publish(roslibpy.Message(message.content))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._ros.is_connected:
            self._topic.unadvertise()


def _as_object(value: Any) -> Any:
    """Return JSON as objects with fields, times under their ROS 2 names."""
    if isinstance(value, dict):
        found = SimpleNamespace()
        for name, part in value.items():
            setattr(found, _ROS1_TIME.get(name, str(name)), _as_object(part))
        return found
    if isinstance(value, list):
        return [_as_object(part) for part in value]
    return value
