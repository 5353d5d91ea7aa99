"""Where messages of a network become events that wait to be fetched."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock
from typing import Any

from failuretwin.connection.links.event_queue import EventQueue
from failuretwin.connection.links.ros_reader import RosReader
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.values import Event, LinkCounts
from failuretwin.data_knowledge.bags.messages import Kind
from failuretwin.data_knowledge.bags.topics import Role
from failuretwin.digital_model.robot import Robot

Decode = Callable[[], tuple[Any, Kind]]
"""Returns a message as an object with the fields of its kind, and its kind."""


class Inbox:
    """Takes messages from any thread; what makes no sense is counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        queue: Where events wait.

    Raises:
        InputError: If messages hold servo counts and the robot has none.
    """

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None) -> None:
        topics.check_fits(robot)
        self._queue = EventQueue() if queue is None else queue
        self._readers = {role: RosReader(robot, role, topics) for role, _, _ in topics.subscribed}
        self._lock = Lock()
        self._garbage, self._last_garbage = 0, ""

    def take(self, role: Role, decode: Decode) -> None:
        """Take a message of the topic that has a role."""
        received_ns = time.time_ns()
        with self._lock:  # each publisher may have a thread
            try:
                content, kind = decode()
                events = self._readers[role].events(content, kind, received_ns)
            # Anyone may publish anything here, and a message of wrong bytes fails in struct, numpy
            # or rosbags. It is counted; the next one may be sound.
            except Exception as error:
                self._garbage += 1
                self._last_garbage = f"{type(error).__name__}: {error}"
                return
            for event in events:
                self._queue.put(event)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none came within `timeout_s` [s]."""
        return self._queue.get(timeout_s)

    def counts(self, reconnects: int) -> LinkCounts:
        """Return what has come so far over a link that was renewed so many times."""
        return LinkCounts(
            self._queue.received,
            self._garbage,
            self._queue.dropped,
            reconnects,
            self._last_garbage,
        )
