"""What commanders of a network share: who was told what last, and orders as messages."""

from __future__ import annotations

import time
from collections.abc import Callable

from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.connection.links.commander import Order
from failuretwin.connection.links.ros_messages import Outgoing, RosTopics, RosWriter
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot


class Orders:
    """Turns orders into messages, and remembers what the motors were told last.

    Args:
        robot: The robot.
        topics: Its topics.
        publish: Sends a message.

    Raises:
        InputError: If commands are a stream of samples, which single orders cannot be.
    """

    def __init__(
        self, robot: Robot, topics: RosTopics, publish: Callable[[Outgoing], None]
    ) -> None:
        self._writer = RosWriter(robot, topics)
        self._publish = publish
        self._ahead_s = time.time() - time.monotonic()  # until the robot's clock has been heard
        self.topic = topics.command, topics.command_type
        self.standing: FloatArray | None = None

    def hear(self, event: Event | None) -> None:
        """Take what the network says: clock and commands of the robot, ours and others'."""
        if event is not None:
            self._ahead_s = event.time - time.monotonic()
        if isinstance(event, CommandSent):
            self._stand(event.target)
        elif self.standing is None and isinstance(event, Reading) and event.position is not None:
            self._writer.start_at(event.position)

    def _stand(self, target: FloatArray) -> None:
        self.standing = target
        self._writer.start_at(target)

    def send(self, order: Order) -> None:
        """Publish an order, stamped by the robot's clock."""
        command = CommandSent(time.monotonic() + self._ahead_s, order.target, order.duration)
        for message in self._writer.command(command):
            self._publish(message)
        self.standing = order.target


class Commanding:
    """What a source that also sends orders adds to it: it hears what the motors were told.

    Stands before the source among the bases of a commander.
    """

    _orders: Orders

    @property
    def standing(self) -> FloatArray | None:
        """What the motors were told last, (motor,) [rad]; None: not known."""
        return self._orders.standing

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next reading or command; None if none came within `timeout_s` [s]."""
        event: Event | None = super().poll(timeout_s)  # type: ignore[misc]
        self._orders.hear(event)
        return event
