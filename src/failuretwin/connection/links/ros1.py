"""This process as a ROS 1 node that outlives the master.

rospy tells the master of its topics once. A master that is restarted knows nothing of them, so we
ask it every second whether it still knows each of them, and tell it again if not.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from http.client import HTTPConnection, HTTPException
from threading import Thread
from typing import Any, Literal, get_args
from xmlrpc.client import Error, ServerProxy, Transport

from failuretwin.connection.links.base import (
    EventQueue,
)
from failuretwin.connection.links.commander import Order
from failuretwin.connection.links.live_events import NetworkSource
from failuretwin.connection.links.network_commander import Commanding, Orders
from failuretwin.connection.links.network_sinks import DiagnosticsSink, RobotSink
from failuretwin.connection.links.ros1_import import Decoder, load_rospy, message_class
from failuretwin.connection.links.ros_messages import (
    DIAGNOSTICS_TYPE,
    DiagnosticsPublisher,
    Outgoing,
    RosTopics,
    RosWriter,
)
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bag_messages import Role
from failuretwin.digital_model.robot import Robot

# Questions to the ROS master that end in time, whatever state it is in.

ASKED_BY = "/failuretwin"
DEFAULT_URI = "http://localhost:11311"
TIMEOUT_S = 2.0
"""Longest wait for an answer [s]."""


class _TimedTransport(Transport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def ask_master(question: str, *arguments: str) -> Any:
    """Return the answer of the master's XML-RPC interface; None if it says it does not know.

    Args:
        question: Name of the call, such as ``lookupNode``.
        arguments: What it takes besides the name of who asks.

    Raises:
        OSError: If no master answers.
    """
    uri = os.environ.get("ROS_MASTER_URI", DEFAULT_URI)
    try:
        with ServerProxy(uri, transport=_TimedTransport()) as master:
            code, _, value = getattr(master, question)(ASKED_BY, *arguments)
    except (Error, HTTPException, ValueError, TypeError) as error:
        raise OSError(f"no sensible answer from {uri}: {error}") from error
    return value if code == 1 else None


NAME = "failuretwin"
NodeRole = Literal["publisher", "subscriber"]
ROLES: tuple[NodeRole, ...] = get_args(NodeRole)
"""What a node may do with a topic, in the order in which the master lists them."""
CHECK_S = 1.0
"""Time between two questions to the master [s]."""
QUIET_LOGS = ("rospy", "rosout", "rosgraph", "rospy.internal", "rospy.topics", "rospy.registration")


def join() -> Any:
    """Make this process a node, if it is none yet, and return rospy.

    Raises:
        InputError: If rospy is missing or no master answers.
    """
    rospy = load_rospy()
    if not rospy.core.is_initialized():
        _check_master()
        rospy.init_node(
            NAME,
            argv=[],
            anonymous=True,
            disable_signals=True,
            disable_rosout=True,
            disable_rostime=True,
        )
        for name in QUIET_LOGS:  # a master that is gone is told once, by us
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return rospy


def _check_master() -> None:
    try:
        ask_master("getPid")
    except OSError as error:
        address = os.environ.get("ROS_MASTER_URI", "not set")
        raise InputError(
            f"no ROS master answers ({error}; ROS_MASTER_URI is {address}). Start `roscore`, or "
            "set ROS_MASTER_URI to where it runs."
        ) from error


class Registration:
    """Keeps topics registered with the master.

    Args:
        role: What the node does with them.
        topics: Their names.
        register: Registers them; called from a thread of its own whenever the master has forgotten
            one.
    """

    def __init__(self, role: NodeRole, topics: Sequence[str], register: Callable[[], None]) -> None:
        self._role = role
        self._topics = topics
        self._register = register
        self._stop = threading.Event()
        self._thread = Thread(target=self._watch, name="ROS registration", daemon=True)
        self.master_gone = False
        self.renewals = 0
        self._thread.start()

    def stop(self) -> None:
        """Stop looking after it."""
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stop.wait(CHECK_S):
            try:
                if not _are_known(self._role, self._topics):
                    self._register()
                    self.renewals += 1
                self.master_gone = False
            # While a master comes up, rospy raises anything from socket errors to faults; whatever
            # it is, the next question comes in a second.
            except Exception:
                self.master_gone = True


def _are_known(role: NodeRole, topics: Sequence[str]) -> bool:
    """Return whether the master knows this node by all topics; raises OSError if none answers."""
    import rospy

    state = ask_master("getSystemState")[ROLES.index(role)]
    known = {topic for topic, nodes in state if rospy.get_name() in nodes}
    return known >= {rospy.resolve_name(topic) for topic in topics}


# A robot on ROS 1, listened to.


class Ros1Source(NetworkSource):
    """Listens to the topics of a robot; a master that goes away and comes back is no trouble.

    Messages are known by their fields, whatever package they come from. What makes no sense is
    counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        queue: Where events wait to be fetched; None: a queue of its own.

    Raises:
        InputError: If rospy is missing, no master answers, or the robot does not fit the topics.
    """

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None = None) -> None:
        super().__init__(robot, topics, queue)
        self._rospy = join()
        self._topics = topics
        self._decoder = Decoder()
        self._subscribers: list[Any] = []
        self._subscribe()
        names = [name for _, name, _ in topics.subscribed]
        self.name = f"ROS 1: {', '.join(names)}"
        self._registration = Registration("subscriber", names, self._subscribe)

    @property
    def reconnects(self) -> int:
        """How often the master went away and came back."""
        return self._registration.renewals

    def close(self) -> None:
        """Stop listening."""
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
        self.take(role, partial(self._decoder.decode, message))


# What is said on ROS 1: an emulated robot's readings and commands, and the diagnosis.

QUEUE = 100
"""Messages that wait for a slow listener at most; rospy drops the oldest."""


LISTENER_S = 5.0
"""Longest wait for somebody who listens to the topic of commands [s]."""


def _listeners(publisher: Any) -> int:
    """Return how many nodes besides this one take what is published."""
    import rospy

    others = [link for link in publisher.impl.connections if link.endpoint_id != rospy.get_name()]
    return len(others)


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

    def await_listener(self, topic: str) -> None:
        """Wait until somebody else than this process listens to a topic.

        Raises:
            InputError: If nobody does within `LISTENER_S`.
        """
        until = time.monotonic() + LISTENER_S
        while time.monotonic() < until:
            if _listeners(self._publishers[topic]) > 0:
                return
            time.sleep(0.05)
        raise InputError(
            f"nobody listens to topic {topic}: the order would reach no robot. Start its driver, "
            "or name the topic of commands in a file for --topics."
        )

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


class Ros1Robot(RobotSink):
    """Plays a robot on ROS 1; see `RobotSink`.

    Args:
        robot: The robot.
        topics: Its topics.

    Raises:
        InputError: If rospy is missing, no master answers, or a type cannot be published.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        writer = RosWriter(robot, topics)
        super().__init__("ROS 1", writer, _Publishers(writer.topics))


class Ros1Diagnostics(DiagnosticsSink):
    """Publishes answers as diagnostics on ROS 1.

    Args:
        robot: The robot.
        topics: Names the topic.

    Raises:
        InputError: If rospy is missing or no master answers.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        publishers = _Publishers([(topics.diagnostics, DIAGNOSTICS_TYPE)])
        super().__init__("ROS 1 diagnostics", DiagnosticsPublisher(robot, topics), publishers)


class Ros1Commander(Commanding, Ros1Source):
    """Listens to a robot and tells it to move: a trajectory or command out for each order.

    Args:
        robot: The robot.
        topics: Its topics.

    Raises:
        InputError: If rospy is missing, no master answers, or the robot does not fit the topics.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._orders = Orders(robot, topics, lambda message: self._publishers.send(message))
        super().__init__(robot, topics)
        self._publishers = _Publishers([self._orders.topic])

    def send(self, order: Order) -> None:
        """Tell the motors to move.

        Raises:
            InputError: If nobody listens to the topic of commands.
        """
        self._publishers.await_listener(self._orders.topic[0])
        self._orders.send(order)

    def close(self) -> None:
        """Stop listening and sending."""
        super().close()
        self._publishers.close()
