"""A robot on ROS 1, listened to."""

from __future__ import annotations

from functools import partial
from typing import Any, Self

from failuretwin.connection.links.event_queue import EventQueue
from failuretwin.connection.links.inbox import Inbox
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.values import Event, LinkCounts
from failuretwin.connection.ros1.node import Registration, join
from failuretwin.connection.ros1.raw_messages import Decoder
from failuretwin.data_knowledge.bags.topics import Role
from failuretwin.digital_model.robot import Robot


class Ros1Source:
    """Listens to the topics of a robot; a master that goes away and comes back is no trouble.

    Messages are known by their fields, whatever package they come from. What makes no sense is
    counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        queue: Where events wait to be fetched.

    Raises:
        InputError: If rospy is missing, no master answers, or the robot does not fit the topics.
    """

    ended = False

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None = None) -> None:
        self._inbox = Inbox(robot, topics, queue)
        self._rospy = join()
        self._topics = topics
        self._decoder = Decoder()
        self._subscribers: list[Any] = []
        self._subscribe()
        names = [name for _, name, _ in topics.subscribed]
        self.name = f"ROS 1: {', '.join(names)}"
        self._registration = Registration("subscriber", names, self._subscribe)

    @property
    def counts(self) -> LinkCounts:
        """What it has seen so far."""
        return self._inbox.counts(self._registration.renewals)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none came within `timeout_s` [s]."""
        return self._inbox.poll(timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._registration.stop()
        self._unsubscribe()

    def _subscribe(self) -> None:
        self._unsubscribe()
        for role, name, _ in self._topics.subscribed:
            self._subscribers.append(
                self._rospy.Subscriber(name, self._rospy.AnyMsg, self._take, role, tcp_nodelay=True)
            )

    def _unsubscribe(self) -> None:
        for subscriber in self._subscribers:
            subscriber.unregister()
        self._subscribers = []

    def _take(self, message: Any, role: Role) -> None:
        self._inbox.take(role, partial(self._decoder.decode, message))
