"""What is said on ROS 1: an emulated robot's readings and commands, and the diagnosis."""

from __future__ import annotations

from typing import Any, Self

from failuretwin.connection.links.bulletin import Bulletin
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.ros_writer import (
    DIAGNOSTICS_TYPE,
    Outgoing,
    RosWriter,
)
from failuretwin.connection.links.values import Answer, CommandSent, Item, Reading
from failuretwin.connection.ros1.message_class import message_class
from failuretwin.connection.ros1.node import Registration, join
from failuretwin.digital_model.robot import Robot

QUEUE = 100
"""Messages that wait for a slow listener at most; rospy drops the oldest."""


class _Publishers:
    """Publishers that are registered again when the master comes back.

    Args:
        topics: Name and type of each topic.
    """

    def __init__(self, topics: list[tuple[str, str]]) -> None:
        self._rospy = join()
        self._classes = {name: message_class(type_) for name, type_ in topics}
        self._publishers: dict[str, Any] = {}
        self._advertise()
        self._registration = Registration("publisher", list(self._classes), self._advertise)

    @property
    def trouble(self) -> str:
        """What keeps messages from new listeners."""
        return "the ROS master is gone" if self._registration.master_gone else ""

    def send(self, message: Outgoing) -> None:
        from genpy.message import fill_message_args

        content = self._classes[message.topic]()
        fill_message_args(content, [message.content])
        try:
            self._publishers[message.topic].publish(content)
        except self._rospy.ROSException:  # it is just being registered again
            return

    def close(self) -> None:
        self._registration.stop()
        for publisher in self._publishers.values():
            publisher.unregister()

    def _advertise(self) -> None:
        for publisher in self._publishers.values():
            publisher.unregister()
        for name, class_ in self._classes.items():
            self._publishers[name] = self._rospy.Publisher(
                name, class_, queue_size=QUEUE, tcp_nodelay=True
            )


class Ros1Robot:
    """Plays a robot: publishes readings and commands as the robot itself would.

    Whoever listens to the commands will move. Nothing but `emulate` makes use of it.

    Args:
        robot: The robot.
        topics: Its topics.

    Raises:
        InputError: If rospy is missing, no master answers, or a type cannot be published.
    """

    name = "ROS 1"

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._writer = RosWriter(robot, topics)
        self._publishers = _Publishers(self._writer.topics)

    @property
    def trouble(self) -> str:
        """What keeps items from arriving just now."""
        return self._publishers.trouble

    def put(self, item: Item) -> None:
        """Publish a reading or a command."""
        if isinstance(item, Reading):
            messages = self._writer.reading(item)
        elif isinstance(item, CommandSent):
            messages = self._writer.command(item)
        else:
            return
        for message in messages:
            self._publishers.send(message)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.close()


class Ros1Diagnostics:
    """Publishes answers as diagnostics: every second, and at once when a status gets worse.

    Args:
        robot: The robot.
        topics: Names the topic.

    Raises:
        InputError: If rospy is missing or no master answers.
    """

    name = "ROS 1 diagnostics"

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._bulletin = Bulletin(robot, topics)
        self._publishers = _Publishers([(topics.diagnostics, DIAGNOSTICS_TYPE)])

    @property
    def trouble(self) -> str:
        """What keeps items from arriving just now."""
        return self._publishers.trouble

    def put(self, item: Item) -> None:
        """Publish an answer if it is time to."""
        message = self._bulletin.message(item) if isinstance(item, Answer) else None
        if message is not None:
            self._publishers.send(message)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.close()
