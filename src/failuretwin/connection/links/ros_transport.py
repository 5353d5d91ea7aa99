"""Connections to ROS networks: what every transport offers, and messages as bytes.

Messages are encoded by the definitions in rosbags; no ROS installation is needed.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
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
        content: Its fields, without those that are empty or zero; stamps and durations are tables
            of `secs` and `nsecs`.
    """

    topic: str
    type: str
    content: dict[str, Any]


class RosCodec:
    """Encodes and decodes messages of ROS 1 (Noetic) or of ROS 2 (Jazzy, as CDR).

    A type that is not part of ROS gets the fields of the authors' message.

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

    def decode(self, data: bytes, type_: str, definition: str = "") -> tuple[Any, Kind]:
        """Return a message as an object with the fields of its kind, and its kind.

        `definition` is that of the type by its publisher, with all types in it; empty: as known.

        Raises:
            InputError: If the type is of no known kind.
            Exception: Any error of rosbags if the bytes do not fit the type.
        """
        name = self.full_name(type_)
        store = _defined(name, definition) if definition else self._store
        kind = kind_of(message_fields(store, name))
        if kind is None:
            raise InputError(f"a message of type {name} is of no kind that is understood.")
        decode = store.deserialize_ros1 if self._ros == 1 else store.deserialize_cdr
        return decode(data, name), kind


@cache
def _defined(type_: str, definition: str) -> Typestore:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, type_))
    return store


def _message(store: Typestore, type_: str, content: dict[str, Any]) -> Any:
    """Return a message object of rosbags from plain values."""
    _, fields = store.fielddefs[type_]
    given = {name: content.get(_TIME_PARTS.get(name, name)) for name, _ in fields}
    return store.types[type_](**{name: _value(store, kind, given[name]) for name, kind in fields})


def _value(store: Typestore, description: Any, value: Any) -> Any:
    """Return a field's value; a value of None is empty or zero."""
    kind, detail = description
    if kind.name == "NAME":
        return _message(store, detail, value or {})
    if kind.name == "BASE":
        return ("" if detail[0] == "string" else 0) if value is None else value
    (item_kind, item), _ = detail
    if item_kind.name == "NAME":
        return [_message(store, item, part) for part in value or ()]
    return list(value or ()) if item[0] == "string" else np.array(value or (), dtype=item[0])


# Transports.

Decode = Callable[[], tuple[Any, Kind]]
"""Returns a message as an object with the fields of its kind, and its kind."""
Take = Callable[[Decode], None]
"""Handles a message; may be called from any thread."""
LISTENER_S = 5.0
"""Longest wait for a listener to commands [s]."""


class Transport(ABC):
    """Connection to a ROS network, which it reopens if the far side goes away and comes back.

    Attributes:
        name: Name for messages to the user.
        far_side: What it is connected to, for messages to the user.
    """

    name: str
    far_side: str
    _reconnects, _was_gone = 0, False

    @property
    def trouble(self) -> str:
        """Reason why messages do not arrive at present; empty if they do."""
        return f"the {self.far_side} is gone" if self._look() else ""

    @property
    def reconnects(self) -> int:
        """Number of times that the far side was seen to go away and come back."""
        self._look()
        return self._reconnects

    def _look(self) -> bool:
        gone = self.is_gone()
        self._reconnects += self._was_gone and not gone
        self._was_gone = gone
        return gone

    def check_listener(self, topic: str) -> None:
        """Wait until somebody listens to an advertised topic.

        Raises:
            InputError: If the far side is gone, or nobody listens within `LISTENER_S`.
        """
        until = time.monotonic() + LISTENER_S
        while not self.is_heard(topic):
            if self.trouble:
                raise InputError(f"{self.trouble}; nothing was sent.")
            if time.monotonic() > until:
                raise InputError(
                    f"nobody listens to topic {topic}: the order would reach no robot. Start its "
                    "driver, or name the topic of commands in a file for --topics."
                )
            time.sleep(0.05)

    @abstractmethod
    def is_gone(self) -> bool:
        """Return whether the far side is gone."""

    @abstractmethod
    def is_heard(self, topic: str) -> bool:
        """Return whether another program listens to an advertised topic, as far as is known."""

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
    def close(self) -> None:
        """End all subscriptions and publishers, and the connection."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
