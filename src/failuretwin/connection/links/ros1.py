"""Transport over ROS 1 by rospy, which survives a restart of the ROS master.

rospy registers its topics with the master once, and a restarted master knows none of them. This
transport asks the master every second and registers them again if it has forgotten one.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Sequence
from functools import cache, partial
from http.client import HTTPConnection, HTTPException
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any
from xmlrpc.client import Error, ServerProxy
from xmlrpc.client import Transport as HttpTransport

from failuretwin.connection.links.ros_transport import (
    Outgoing,
    RosCodec,
    Take,
    Transport,
    kind_in,
    wait_for_listener,
)
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.bag_messages import Kind

# Import of rospy. Debian installs it for its own interpreter, next to its own numpy. A virtual
# environment must not see that whole folder, so an import hook admits the modules of ROS alone.

DEBIAN_FOLDER = "/usr/lib/python3/dist-packages"
ROS_MODULES = (
    *("catkin", "catkin_pkg", "defusedxml", "distro", "netifaces", "rospkg", "six", "yaml"),
    *("genmsg", "genpy", "roscpp", "rosgraph", "rosgraph_msgs", "roslib", "rospy", "std_msgs"),
)
"""Modules of rospy and those that it needs; taken from Debian if found nowhere else."""


class _DebianRos:
    """Import hook that finds the modules of ROS in Debian's folder."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or name not in ROS_MODULES:
            return None
        return PathFinder.find_spec(name, [DEBIAN_FOLDER], target)


def load_rospy() -> Any:
    """Return the module rospy.

    Raises:
        InputError: If it is not installed or cannot be imported.
    """
    hooked = any(isinstance(finder, _DebianRos) for finder in sys.meta_path)
    if not hooked and Path(DEBIAN_FOLDER, "rospy").is_dir():
        sys.meta_path.append(_DebianRos())
    try:
        import rospy
    except ImportError as error:
        raise InputError(
            f"ROS 1 needs rospy, which cannot be imported ({error}). With Debian's packages: `apt "
            "install python3-rospy`; with others, source their setup file first (docs/live.md)."
        ) from error
    return rospy


# The ROS master.

NODE = "failuretwin"
DEFAULT_URI = "http://localhost:11311"
TIMEOUT_S = 2.0
"""Longest wait for an answer of the master [s]."""
QUIET_LOGS = ("rospy", "rosout", "rosgraph", "rospy.internal", "rospy.topics", "rospy.registration")


class _TimedHttp(HttpTransport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def _ask_master(question: str) -> Any:
    """Return the answer to a call of the master's XML-RPC interface.

    Raises:
        OSError: If no master answers.
    """
    uri = os.environ.get("ROS_MASTER_URI", DEFAULT_URI)
    try:
        with ServerProxy(uri, transport=_TimedHttp()) as master:
            _, _, value = getattr(master, question)(f"/{NODE}")
    except (Error, HTTPException, ValueError, TypeError) as error:
        raise OSError(f"no valid answer from {uri}: {error}") from error
    return value


def _join() -> Any:
    """Make this process a node, unless it is one, and return rospy.

    Raises:
        InputError: If rospy is missing or no master answers.
    """
    rospy = load_rospy()
    if rospy.core.is_initialized():
        return rospy
    try:
        _ask_master("getPid")
    except OSError as error:
        address = os.environ.get("ROS_MASTER_URI", "not set")
        raise InputError(
            f"no ROS master answers ({error}; ROS_MASTER_URI is {address}). Start `roscore`, or "
            "set ROS_MASTER_URI to where it runs."
        ) from error
    quiet = {"disable_signals": True, "disable_rosout": True, "disable_rostime": True}
    rospy.init_node(NODE, argv=[], anonymous=True, **quiet)
    for name in QUIET_LOGS:  # the transport itself reports a master that is gone
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return rospy


# Messages: received with the definition that their publisher sends along, sent as bytes.


def _decoded(message: Any) -> tuple[Any, Kind]:
    """Return a `rospy.AnyMsg` as an object with the fields of its kind, and its kind.

    Raises:
        InputError: If it is of no known kind.
        Exception: Any error of rosbags if the bytes do not fit the definition.
    """
    header = message._connection_header
    store, type_, kind = _defined_type(header["type"], header["message_definition"])
    return store.deserialize_ros1(message._buff, type_), kind


@cache
def _defined_type(name: str, definition: str) -> tuple[Any, str, Kind]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, type_ = get_typestore(Stores.EMPTY), name.replace("/", "/msg/")
    store.register(get_types_from_msg(definition, type_))
    return store, type_, kind_in(store, type_)


def message_class(codec: RosCodec, type_: str) -> Any:
    """Return a class of messages that rospy publishes as the bytes in `_buff`."""
    definition, md5 = codec.definition(type_)
    described = {"_type": type_, "_md5sum": md5, "_full_text": definition, "__slots__": []}
    return type("Message", (load_rospy().AnyMsg,), described)


# The transport.

CHECK_S = 1.0
"""Time between two questions to the master [s]."""
QUEUE = 100
"""Maximum number of messages that wait for a slow listener; rospy drops the oldest."""


class Ros1Transport(Transport):
    """Node of ROS 1, at the master in ``ROS_MASTER_URI``.

    Messages are known by their fields, whatever package they come from.

    Raises:
        InputError: If rospy or rosbags is missing, or no master answers.
    """

    name = "ROS 1"

    def __init__(self) -> None:
        self._codec = RosCodec(1)
        self._rospy = _join()
        self._takes: list[tuple[str, Take]] = []
        self._classes: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._master_gone, self._renewals = False, 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="ROS registration", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Whether the master is gone, so that no new listeners come."""
        return "the ROS master is gone" if self._master_gone else ""

    @property
    def reconnects(self) -> int:
        """Number of times that the master went away and came back."""
        return self._renewals

    def subscribe(self, topic: str, type_: str, take: Take) -> None:
        """Call `take` with every message of a topic, of any type."""
        self._subscribers.append(self._subscriber(topic, take))
        self._takes.append((topic, take))

    def advertise(self, topic: str, type_: str) -> None:
        """Prepare a topic for publishing."""
        class_ = message_class(self._codec, type_)
        self._publishers[topic] = self._publisher(topic, class_)
        self._classes[topic] = class_

    def publish(self, message: Outgoing) -> None:
        """Publish a message."""
        content = self._classes[message.topic]()
        content._buff = self._codec.encode(message)
        try:
            self._publishers[message.topic].publish(content)
        except self._rospy.ROSException:  # it is being registered again
            return

    def check_listener(self, topic: str) -> None:
        """Wait for a listener in another process; raises InputError if there is none in time."""
        node = self._rospy.get_name()

        def listening() -> bool:
            links = self._publishers[topic].impl.connections
            return any(link.endpoint_id != node for link in links)

        wait_for_listener(topic, listening)

    def close(self) -> None:
        """End all subscriptions and publishers; the process stays a node."""
        self._stop.set()
        self._thread.join()
        for handle in (*self._subscribers, *self._publishers.values()):
            handle.unregister()

    def _subscriber(self, topic: str, take: Take) -> Any:
        def receive(message: Any) -> None:
            take(partial(_decoded, message))

        return self._rospy.Subscriber(topic, self._rospy.AnyMsg, receive, tcp_nodelay=True)

    def _publisher(self, topic: str, class_: Any) -> Any:
        return self._rospy.Publisher(topic, class_, queue_size=QUEUE, tcp_nodelay=True)

    def _watch(self) -> None:
        while not self._stop.wait(CHECK_S):
            try:
                if self._is_forgotten():
                    self._register_again()
                self._master_gone = False
            # While a master starts, rospy raises anything from socket errors to XML-RPC faults. The
            # next question comes in a second.
            except Exception:
                self._master_gone = True

    def _is_forgotten(self) -> bool:
        """Return whether the master has forgotten a topic; raises OSError if none answers."""
        published, subscribed, _ = _ask_master("getSystemState")
        own, name = self._rospy.get_name(), self._rospy.resolve_name
        for registered, topics in (
            (published, list(self._classes)),
            (subscribed, [topic for topic, _ in self._takes]),
        ):
            known = {topic for topic, nodes in registered if own in nodes}
            if not known >= set(map(name, topics)):
                return True
        return False

    def _register_again(self) -> None:
        for handle in self._subscribers:
            handle.unregister()
        self._subscribers = [self._subscriber(topic, take) for topic, take in self._takes]
        for topic, class_ in list(self._classes.items()):
            self._publishers[topic].unregister()
            self._publishers[topic] = self._publisher(topic, class_)
        self._renewals += 1
