"""Links to a robot on a ROS network, over any transport: source, commander and sinks."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from urllib.parse import urlsplit

from failuretwin.connection.links import ROS1, ROS2, ROSBRIDGE
from failuretwin.connection.links.base import (
    CommandSent,
    Event,
    Item,
    Link,
    LinkCounts,
    Order,
    Reading,
    Sink,
)
from failuretwin.connection.links.ros1 import Ros1Transport
from failuretwin.connection.links.ros2 import ROUTER_PORT, Ros2Transport
from failuretwin.connection.links.ros_messages import (
    DiagnosticsWriter,
    RosReader,
    RosTopics,
    RosWriter,
)
from failuretwin.connection.links.ros_transport import Decode, Transport
from failuretwin.connection.links.rosbridge import BRIDGE_PORT, RosbridgeTransport
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot


def is_network(text: str) -> bool:
    """Return whether a text names a network, whether or not it can be reached."""
    return text in (ROS1, ROS2) or text.startswith((f"{ROS2}://", f"{ROSBRIDGE}://"))


def open_transport(text: str) -> Transport:
    """Return a connection to a network.

    Raises:
        InputError: If the address is invalid, the network does not answer, or an extra is missing.
    """
    if text == ROS1:
        return Ros1Transport()
    kind = text.partition("://")[0]
    try:
        address = urlsplit(f"{ROS2}://localhost" if text == ROS2 else text)
        host, port = address.hostname, address.port
    except ValueError:
        host, port = None, None
    if not host:
        raise InputError(f"{text!r} is no address. Expected {kind}://HOST[:PORT].")
    if kind == ROS2:
        return Ros2Transport(host, port or ROUTER_PORT)
    return RosbridgeTransport(host, port or BRIDGE_PORT)


class RosSource(Link):
    """Readings and commands of a robot on a ROS network; it does not close the transport.

    Invalid messages are counted and left out.

    Raises:
        InputError: If messages hold servo counts and the robot's profile has none.
    """

    def __init__(self, robot: Robot, topics: RosTopics, transport: Transport) -> None:
        topics.check_fits(robot)
        super().__init__(f"{transport.name}: {', '.join(name for _, name, _ in topics.subscribed)}")
        self._transport = transport
        for role, topic, type_ in topics.subscribed:
            reader = RosReader(robot, role, topics)
            transport.subscribe(topic, type_, partial(self._take, reader))

    @property
    def counts(self) -> LinkCounts:
        """Counters since the source was opened."""
        return replace(self._counts, reconnects=self._transport.reconnects)

    def _take(self, reader: RosReader, decode: Decode) -> None:
        received_ns = time.time_ns()
        with self._changed:  # a transport may have one thread per publisher
            try:
                events = reader.events(*decode(), received_ns)
            # Anyone may publish anything here, and invalid bytes raise errors of struct, numpy or
            # rosbags. The message is counted; the next one may be valid.
            except Exception as error:
                ours = isinstance(error, InputError)
                self.put_garbage(str(error) if ours else f"{type(error).__name__}: {error}")
                return
            for event in events:
                self.put(event)


class RosCommander(RosSource):
    """Source that also publishes orders, one message each.

    Raises:
        InputError: If messages hold servo counts and the robot's profile has none, or commands are
            a stream of set-points, which cannot carry single orders.
    """

    def __init__(self, robot: Robot, topics: RosTopics, transport: Transport) -> None:
        self._writer = RosWriter(robot, topics)
        super().__init__(robot, topics, transport)
        self._topic = topics.command
        self._ahead_s = time.time() - time.monotonic()  # until the robot's clock has been heard
        self.standing: FloatArray | None = None
        transport.advertise(topics.command, topics.command_type)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none comes within `timeout_s` [s]."""
        event = super().poll(timeout_s)
        if event is not None:
            self._ahead_s = event.time - time.monotonic()
        if isinstance(event, CommandSent):
            self.standing = self._writer.origin = event.target
        elif self.standing is None and isinstance(event, Reading) and event.position is not None:
            self._writer.origin = event.position
        return event

    def send(self, order: Order) -> None:
        """Publish an order, stamped by the robot's clock.

        Raises:
            InputError: If it would not reach a robot.
        """
        self._transport.check_listener(self._topic)
        stamp = time.monotonic() + self._ahead_s
        command = CommandSent(stamp, order.target, order.duration)
        self._transport.publish(self._writer.command(command))
        self.standing = order.target


class RosSink(Sink):
    """Sink that publishes items on a ROS network; it does not close the transport.

    With a `RosWriter` it plays a robot: robots that listen to its commands will move.
    """

    def __init__(self, writer: RosWriter | DiagnosticsWriter, transport: Transport) -> None:
        self._writer = writer
        self._transport = transport
        for topic, type_ in dict(writer.topics).items():
            transport.advertise(topic, type_)

    @property
    def trouble(self) -> str:
        """Reason why messages do not arrive at present."""
        return self._transport.trouble

    def put(self, item: Item) -> None:
        """Publish an item."""
        for message in self._writer.messages(item):
            self._transport.publish(message)
