"""A robot on ROS 1, listened to."""

from __future__ import annotations

import time
from threading import Lock
from typing import Any, Self

from failuretwin.connection.links.event_queue import EventQueue
from failuretwin.connection.links.ros_reader import RosReader
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
        InputError: If rospy is missing or no master answers.
    """

    name = "ROS 1"
    ended = False

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None = None) -> None:
        topics.check_fits(robot)
        self._rospy = join()
        self._topics = topics
        self._queue = EventQueue() if queue is None else queue
        self._decoder = Decoder()
        self._readers = {role: RosReader(robot, role, topics) for role, _, _ in topics.subscribed}
        self._lock = Lock()
        self._garbage, self._last_garbage = 0, ""
        self._subscribers: list[Any] = []
        self._subscribe()
        names = [name for _, name, _ in topics.subscribed]
        self._registration = Registration("subscriber", names, self._subscribe)

    @property
    def counts(self) -> LinkCounts:
        """What it has seen so far."""
        return LinkCounts(
            self._queue.received,
            self._garbage,
            self._queue.dropped,
            self._registration.renewals,
            self._last_garbage,
        )

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none came within `timeout_s` [s]."""
        return self._queue.get(timeout_s)

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
        received_ns = time.time_ns()
        with self._lock:  # each publisher has a thread
            try:
                content, kind = self._decoder.decode(message)
                events = self._readers[role].events(content, kind, received_ns)
            # Anyone may publish anything here, and a message of wrong bytes fails in struct, numpy
            # or rosbags. It is counted; the next one may be sound.
            except Exception as error:
                self._garbage += 1
                self._last_garbage = f"{type(error).__name__}: {error}"
                return
            for event in events:
                self._queue.put(event)
