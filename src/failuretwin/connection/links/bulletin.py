"""Answers as diagnostics messages, when it is time for one."""

from __future__ import annotations

import time

from failuretwin.connection.links.diagnostic_status import Beat, statuses
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.ros_writer import Outgoing, diagnostics_message
from failuretwin.connection.links.values import Answer
from failuretwin.digital_model.robot import Robot


class Bulletin:
    """Writes a message every second, and at once when a status gets worse.

    Args:
        robot: The robot.
        topics: Names the topic.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._robot = robot
        self._topics = topics
        self._beat = Beat()

    def message(self, answer: Answer) -> Outgoing | None:
        """Return the message for an answer, None if it is not time for one."""
        found = statuses(answer, self._robot.motor_names)
        if not self._beat.due(found, time.monotonic()):
            return None
        return diagnostics_message(found, answer.time, self._topics, self._robot)
