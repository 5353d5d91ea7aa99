"""Messages of ROS 2 as bytes, without ROS: CDR by the definitions that rosbags knows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.bag_file import MONITORING_DEFINITION, message_fields
from failuretwin.data_knowledge.bag_messages import Kind, kind_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_OWN_NAMES = {"sec": "secs", "nanosec": "nsecs"}
"""What ROS 2 calls the parts of a time, and what `Outgoing` does."""


def ros2_object(store: Typestore, type_: str, content: dict[str, Any]) -> Any:
    """Return a message object from plain values."""
    _, fields = store.fielddefs[type_]
    values = {
        name: _value(store, kind, content[_OWN_NAMES.get(name, name)]) for name, kind in fields
    }
    return store.types[type_](**values)


def _value(store: Typestore, description: Any, value: Any) -> Any:
    kind, detail = description
    if kind.name == "NAME":
        return ros2_object(store, detail, value)
    if kind.name == "BASE":
        return value
    (item_kind, item), _ = detail
    if item_kind.name == "NAME":
        return [ros2_object(store, item, part) for part in value]
    return list(value) if item[0] == "string" else np.array(value, dtype=item[0])


class Ros2Types:
    """The types of ROS 2 (Jazzy); one that is not among them has the authors' fields.

    Raises:
        InputError: If rosbags is not installed.
    """

    def __init__(self) -> None:
        with needs_extra("messages of ROS 2 need rosbags", "ros2"):
            from rosbags.typesys import Stores, get_typestore
        self._store = get_typestore(Stores.ROS2_JAZZY)

    def known(self, type_: str) -> str:
        """Return the ROS 2 name of a type, such as ``sensor_msgs/msg/JointState``."""
        name = type_ if "/msg/" in type_ else type_.replace("/", "/msg/")
        if name not in self._store.fielddefs:
            from rosbags.typesys import get_types_from_msg

            self._store.register(get_types_from_msg(MONITORING_DEFINITION, name))
        return name

    def hash_of(self, type_: str) -> str:
        """Return the hash of a type by REP 2011, such as ``RIHS01_...``."""
        return str(self._store.hash_rihs01(self.known(type_)))

    def to_bytes(self, type_: str, content: dict[str, Any]) -> bytes:
        """Return a message as CDR with its header.

        Args:
            type_: Its type.
            content: Its fields; stamps and durations are tables of `secs` and `nsecs`.
        """
        name = self.known(type_)
        return bytes(self._store.serialize_cdr(ros2_object(self._store, name, content), name))

    def from_bytes(self, type_: str, data: bytes) -> tuple[Any, Kind]:
        """Return a message as an object with the fields of its kind, and its kind.

        Raises:
            InputError: If it is of no kind that is understood.
            Exception: Whatever rosbags raises where bytes do not fit the type.
        """
        name = self.known(type_)
        kind = kind_of(message_fields(self._store, name))
        if kind is None:
            raise InputError(f"a message of type {name} is of no kind that is understood.")
        return self._store.deserialize_cdr(data, name), kind
