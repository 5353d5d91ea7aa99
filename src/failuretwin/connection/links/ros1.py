"""Transport over ROS 1 by rospy, which survives a restart of the ROS master.

rospy registers its topics with the master once, and a restarted master knows none of them. This
transport asks the master every second and registers them again if it has forgotten one.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from itertools import chain
from typing import Any
from xmlrpc.client import ServerProxy
from xmlrpc.client import Transport as HttpTransport

from failuretwin.connection.links.ros_transport import Outgoing, RosCodec, Take, Transport
from failuretwin.core.errors import InputError

DEBIAN_FOLDER = "/usr/lib/python3/dist-packages"
"""Where Debian installs rospy, next to its own numpy and all else that it has of Python."""
NODE = "failuretwin"
DEFAULT_URI = "http://localhost:11311"
TIMEOUT_S = 2.0
"""Longest wait for an answer of the master, and for listeners at the end [s]."""
FLUSH_S = 0.01
"""Time between two looks at whether all is written [s]."""
CHECK_S = 1.0
"""Time between two questions to the master [s]."""
QUEUE = 100
"""Maximum number of messages that wait for a slow listener; rospy drops the oldest."""
QUIET_LOGS = ("rospy", "rosout", "rosgraph", "rospy.internal", "rospy.topics", "rospy.registration")


@contextmanager
def _debian_folder() -> Iterator[None]:
    """Let Python find Debian's modules, after all others, for as long as rospy is imported."""
    before = [*sys.path]
    sys.path.append(DEBIAN_FOLDER)
    try:
        yield
    finally:
        sys.path[:] = before


def load_rospy() -> Any:
    """Return the module rospy.

    Raises:
        InputError: If it is not installed or cannot be imported.
    """
    try:
        with _debian_folder():
            import rospy
    except ImportError as error:
        raise InputError(
            f"ROS 1 needs rospy, which cannot be imported ({error}). With Debian's packages: `apt "
            "install python3-rospy`; with others, source their setup file first (docs/live.md)."
        ) from error
    return rospy


class _TimedHttp(HttpTransport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def _call(uri: str, method: str, *args: object) -> Any:
    """Return the answer to an XML-RPC call of the master or a node.

    Raises:
        Exception: Anything from socket errors to XML-RPC faults if there is no sound answer.
    """
    with ServerProxy(uri, transport=_TimedHttp()) as server:
        _, _, value = getattr(server, method)(*args)
    return value


def _master_uri() -> str:
    return os.environ.get("ROS_MASTER_URI", DEFAULT_URI)


def _join() -> Any:
    """Make this process a node, unless it is one, and return rospy.

    Raises:
        InputError: If rospy is missing or no master answers.
    """
    rospy = load_rospy()
    if rospy.core.is_initialized():
        return rospy
    try:
        _call(_master_uri(), "getPid", f"/{NODE}")
    except Exception as error:
        address = os.environ.get("ROS_MASTER_URI", "not set")
        raise InputError(
            f"no ROS master answers ({error}; ROS_MASTER_URI is {address}). Start `roscore`, or "
            "set ROS_MASTER_URI to where it runs."
        ) from error
    quiet = {"disable_signals": True, "disable_rosout": True, "disable_rostime": True}
    with _debian_folder():
        rospy.init_node(NODE, argv=[], anonymous=True, **quiet)
        # rospy would import netifaces for this only later; it keeps the answer.
        rospy.core.rosgraph.network.get_local_addresses()
    for name in QUIET_LOGS:  # the transport itself reports a master that is gone
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return rospy


def _is_written(link: Any) -> bool:
    """Return whether a link has written all that was published, or is gone.

    A thread of rospy writes what waits, and unregistering its topic would end it. It has written
    all when it waits for more.
    """
    with link._lock:
        idle = not link._queue and bool(link._cond_data_available._waiters)
    return idle or link.done


def message_class(codec: RosCodec, type_: str) -> Any:
    """Return a class of messages that rospy publishes as the bytes in `_buff`."""
    definition, md5 = codec.definition(type_)
    described = {"_type": type_, "_md5sum": md5, "_full_text": definition, "__slots__": []}
    return type("Message", (load_rospy().AnyMsg,), described)


class Ros1Transport(Transport):
    """Node of ROS 1, at the master in ``ROS_MASTER_URI``.

    Messages are known by their fields, whatever package they come from. While the master is gone,
    no new listeners come.

    Raises:
        InputError: If rospy or rosbags is missing, or no master answers.
    """

    name, far_side = "ROS 1", "ROS master"

    def __init__(self) -> None:
        self._codec = RosCodec(1)
        self._rospy = _join()
        self._subscribers: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._gone = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="ROS registration", daemon=True)
        self._thread.start()

    def is_gone(self) -> bool:
        """Return whether the master did not answer when it was last asked."""
        return self._gone

    def is_heard(self, topic: str) -> bool:
        """Return whether another process listens to an advertised topic."""
        node, links = self._rospy.get_name(), self._publishers[topic].impl.connections
        return any(link.endpoint_id != node for link in links)

    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic, of any type."""

        def receive(message: Any) -> None:
            header = message._connection_header
            described = header["type"], header["message_definition"]
            take(lambda: self._codec.decode(message._buff, *described))

        subscriber, any_type = self._rospy.Subscriber, self._rospy.AnyMsg
        self._subscribers.append(subscriber(topic, any_type, receive, tcp_nodelay=True))

    def advertise(self, topic: str, type_: str) -> None:
        """Prepare a topic for publishing."""
        publisher, class_ = self._rospy.Publisher, message_class(self._codec, type_)
        self._publishers[topic] = publisher(topic, class_, queue_size=QUEUE, tcp_nodelay=True)

    def publish(self, message: Outgoing) -> None:
        """Publish a message."""
        publisher = self._publishers[message.topic]
        content = publisher.data_class()
        content._buff = self._codec.encode(message)
        publisher.publish(content)

    def close(self) -> None:
        """End all subscriptions and publishers; the process stays a node.

        What was published is written first, such as the order to stand still.
        """
        self._stop.set()
        self._thread.join()
        deadline = time.monotonic() + TIMEOUT_S
        links = chain.from_iterable(item.impl.connections for item in self._publishers.values())
        for link in list(links):
            while not _is_written(link) and time.monotonic() < deadline:
                time.sleep(FLUSH_S)
        for handle in (*self._subscribers, *self._publishers.values()):
            handle.unregister()

    def _watch(self) -> None:
        while not self._stop.wait(CHECK_S):
            try:
                self._register_if_forgotten()
                self._gone = False
            # While a master starts, it answers with anything from socket errors to XML-RPC faults.
            # The next question comes in a second.
            except Exception:
                self._gone = True

    def _register_if_forgotten(self) -> None:
        """Tell the master of all topics if it lacks one, and hear from it who publishes them."""
        node, uri, master = self._rospy.get_name(), self._rospy.get_node_uri(), _master_uri()
        topics = self._rospy.impl.registration.get_topic_manager()
        with topics.lock:
            published, subscribed = topics.get_publications(), topics.get_subscriptions()
        state = chain.from_iterable(_call(master, "getSystemState", node))
        known = {topic for topic, nodes in state if node in nodes}
        if known >= {topic for topic, _ in (*published, *subscribed)}:
            return
        for topic, type_ in published:
            _call(master, "registerPublisher", node, topic, type_, uri)
        for topic, type_ in subscribed:
            publishers = _call(master, "registerSubscriber", node, topic, type_, uri)
            _call(uri, "publisherUpdate", "/master", topic, publishers)
