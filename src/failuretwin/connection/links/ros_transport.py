"""Connections to ROS networks: what every transport offers, and messages as bytes.

Messages are encoded by the definitions in rosbags; no ROS installation is needed.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.readers.bag_file import MONITORING_DEFINITION, message_fields
from failuretwin.data_knowledge.readers.bag_messages import Kind, kind_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_TIME_PARTS = {"sec": "secs", "nanosec": "nsecs"}
"""Fields of a time in rosbags (and ROS 2), and in `Outgoing` (and ROS 1)."""


@dataclass(frozen=True)
class Outgoing:
    """A message to be sent.

    Attributes:
        topic: Its topic.
        type: Its type, by its ROS 1 name.
        content: Its fields; stamps and durations are tables of `secs` and `nsecs`.
    """

    topic: str
    type: str
    content: dict[str, Any]


class RosCodec:
    """Encodes and decodes messages of ROS 1 (Noetic) or of ROS 2 (Jazzy, as CDR).

    A type that is not part of ROS gets the fields of the authors' message.

    Args:
        ros: Version of ROS.

    Raises:
        InputError: If rosbags is not installed.
    """

    def __init__(self, ros: Literal[1, 2]) -> None:
        with needs_extra("ROS messages need rosbags", "live"):
            from rosbags.typesys import Stores, get_typestore
        self._ros = ros
        self._store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)

    def full_name(self, type_: str) -> str:
        """Return the ROS 2 name of a type, such as ``sensor_msgs/msg/JointState``."""
        name = type_ if "/msg/" in type_ else type_.replace("/", "/msg/")
        if name not in self._store.fielddefs:
            from rosbags.typesys import get_types_from_msg

            self._store.register(get_types_from_msg(MONITORING_DEFINITION, name))
        return name

    def definition(self, type_: str) -> tuple[str, str]:
        """Return the definition of a type with all types in it, and its MD5 sum."""
        return self._store.generate_msgdef(self.full_name(type_), ros_version=self._ros)

    def hash_of(self, type_: str) -> str:
        """Return the hash of a type by REP 2011, such as ``RIHS01_...``."""
        return str(self._store.hash_rihs01(self.full_name(type_)))

    def encode(self, message: Outgoing) -> bytes:
        """Return a message as bytes."""
        name = self.full_name(message.type)
        serialize = self._store.serialize_ros1 if self._ros == 1 else self._store.serialize_cdr
        return bytes(serialize(_message(self._store, name, message.content), name))

    def decode(self, type_: str, data: bytes) -> tuple[Any, Kind]:
        """Return a message of ROS 2 as an object with the fields of its kind, and its kind.

        Raises:
            InputError: If the type is of no known kind.
            Exception: Any error of rosbags if the bytes do not fit the type.
        """
        name = self.full_name(type_)
        return self._store.deserialize_cdr(data, name), kind_in(self._store, name)


def kind_in(store: Typestore, type_: str) -> Kind:
    """Return the kind of a message type.

    Raises:
        InputError: If it is of no known kind.
    """
    kind = kind_of(message_fields(store, type_))
    if kind is None:
        raise InputError(f"a message of type {type_} is of no kind that is understood.")
    return kind


def _message(store: Typestore, type_: str, content: dict[str, Any]) -> Any:
    """Return a message object of rosbags from plain values."""
    _, fields = store.fielddefs[type_]
    values = {
        name: _value(store, kind, content[_TIME_PARTS.get(name, name)]) for name, kind in fields
    }
    return store.types[type_](**values)


def _value(store: Typestore, description: Any, value: Any) -> Any:
    kind, detail = description
    if kind.name == "NAME":
        return _message(store, detail, value)
    if kind.name == "BASE":
        return value
    (item_kind, item), _ = detail
    if item_kind.name == "NAME":
        return [_message(store, item, part) for part in value]
    return list(value) if item[0] == "string" else np.array(value, dtype=item[0])


# Transports.

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
