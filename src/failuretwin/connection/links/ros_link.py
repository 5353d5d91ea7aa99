"""Links to a robot on a ROS network, over any transport: source, commander and sinks."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock
from typing import Any, Protocol, Self

from failuretwin.connection.links.base import (
    CommandSent,
    Event,
    EventQueue,
    Item,
    LinkCounts,
    NothingToClose,
    Order,
    Reading,
)
from failuretwin.connection.links.ros_codec import Outgoing
from failuretwin.connection.links.ros_reader import RosReader
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.ros_writer import DiagnosticsWriter, RosWriter
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.bag_messages import Kind
from failuretwin.digital_model.robot import Robot

Decode = Callable[[], tuple[Any, Kind]]
"""Returns a message as an object with the fields of its kind, and its kind."""
Take = Callable[[Decode], None]
"""Handles a message; may be called from any thread."""


class Transport(ABC):
    """Connection to a ROS network, which it reopens if the far side goes away and comes back.

    Attributes:
        name: Name for messages to the user.
        refusals: Complaints of the far side about our calls.
    """

    name: str
    refusals: Sequence[str] = ()

    @property
    @abstractmethod
    def trouble(self) -> str:
        """Reason why messages do not arrive at present; empty if they do."""

    @property
    @abstractmethod
    def reconnects(self) -> int:
        """Number of times that the far side went away and came back."""

    @abstractmethod
    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic."""

    @abstractmethod
    def advertise(self, topic: str, type_: str) -> None:
        """Prepare a topic for publishing."""

    @abstractmethod
    def publish(self, message: Outgoing) -> None:
        """Publish a message on an advertised topic; lost if the far side is gone."""

    @abstractmethod
    def check_listener(self, topic: str) -> None:
        """Raise InputError if nothing that is published on a topic would reach a robot."""

    @abstractmethod
    def close(self) -> None:
        """End all subscriptions and publishers, and the connection."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


LISTENER_S = 5.0
"""Longest wait for a listener to commands [s]."""


def wait_for_listener(topic: str, listening: Callable[[], bool]) -> None:
    """Wait until there is a listener to a topic.

    Raises:
        InputError: If there is none within `LISTENER_S`.
    """
    until = time.monotonic() + LISTENER_S
    while not listening():
        if time.monotonic() > until:
            raise InputError(
                f"nobody listens to topic {topic}: the order would reach no robot. Start its "
                "driver, or name the topic of commands in a file for --topics."
            )
        time.sleep(0.05)


class RosSource(NothingToClose):
    """Source of readings and commands on a ROS network; it does not close the transport.

    Invalid messages are counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        transport: Connection to the network.
        queue: Queue of waiting events; None: a queue of its own.

    Raises:
        InputError: If messages hold servo counts and the robot's profile has none.
    """

    ended = False

    def __init__(
        self,
        robot: Robot,
        topics: RosTopics,
        transport: Transport,
        queue: EventQueue | None = None,
    ) -> None:
        topics.check_fits(robot)
        self.name = f"{transport.name}: {', '.join(name for _, name, _ in topics.subscribed)}"
        self._transport = transport
        self._queue = EventQueue() if queue is None else queue
        self._lock = Lock()
        self._garbage, self._last_garbage = 0, ""
        for role, topic, type_ in topics.subscribed:
            reader = RosReader(robot, role, topics)
            transport.subscribe(topic, type_, partial(self._take, reader))

    @property
    def counts(self) -> LinkCounts:
        """Counters since the source was opened."""
        queue, refusals = self._queue, self._transport.refusals
        return LinkCounts(
            received=queue.received,
            garbage=self._garbage + len(refusals),
            dropped=queue.dropped,
            reconnects=self._transport.reconnects,
            last_garbage=refusals[-1] if refusals else self._last_garbage,
        )

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none comes within `timeout_s` [s]."""
        return self._queue.get(timeout_s)

    def _take(self, reader: RosReader, decode: Decode) -> None:
        received_ns = time.time_ns()
        with self._lock:  # a transport may have one thread per publisher
            try:
                events = reader.events(*decode(), received_ns)
            # Anyone may publish anything here, and invalid bytes raise errors of struct, numpy or
            # rosbags. The message is counted; the next one may be valid.
            except Exception as error:
                self._garbage += 1
                self._last_garbage = f"{type(error).__name__}: {error}"
                return
            for event in events:
                self._queue.put(event)


class RosCommander(RosSource):
    """Source that also publishes orders, one message each.

    Args:
        robot: The robot.
        topics: Its topics.
        transport: Connection to the network.

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
            self._stand_at(event.target)
        elif self.standing is None and isinstance(event, Reading) and event.position is not None:
            self._writer.start_at(event.position)
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
        self._stand_at(order.target)

    def _stand_at(self, target: FloatArray) -> None:
        self.standing = target
        self._writer.start_at(target)


class Writer(Protocol):
    """Converts items into messages."""

    @property
    def topics(self) -> list[tuple[str, str]]:
        """Name and type of every topic that may be written to."""
        ...

    def messages(self, item: Item) -> list[Outgoing]:
        """Return the messages of an item."""
        ...


class RosSink(NothingToClose):
    """Sink that publishes items on a ROS network; it does not close the transport.

    Args:
        writer: Converts items into messages.
        transport: Connection to the network.
    """

    def __init__(self, writer: Writer, transport: Transport) -> None:
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


def robot_sink(robot: Robot, topics: RosTopics, transport: Transport) -> RosSink:
    """Return a sink that plays a robot: robots that listen to its commands will move.

    Raises:
        InputError: As `RosWriter`.
    """
    return RosSink(RosWriter(robot, topics), transport)


def diagnostics_sink(robot: Robot, topics: RosTopics, transport: Transport) -> RosSink:
    """Return a sink that publishes answers as diagnostics."""
    return RosSink(DiagnosticsWriter(robot, topics.diagnostics), transport)
