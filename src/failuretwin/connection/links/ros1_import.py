"""Finds rospy: in the environment, or where Debian's packages put it.

Debian installs its Python modules for its own interpreter, numpy and all. A virtual environment
must not see the whole folder, so only the modules that belong to ROS are let in, and only once
they are asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.bag_file import MONITORING_DEFINITION, message_fields
from failuretwin.data_knowledge.bag_messages import STANDARD_TYPES, Kind, kind_of

DEBIAN_FOLDER = "/usr/lib/python3/dist-packages"
ROS_MODULES = (
    *("catkin", "catkin_pkg", "defusedxml", "distro", "netifaces", "rospkg", "six", "yaml"),
    *("genmsg", "genpy", "roscpp", "rosgraph", "rosgraph_msgs", "roslib", "rospy"),
    *("diagnostic_msgs", "geometry_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs"),
)
"""Modules that ROS 1 consists of or needs, and that are taken from Debian if nowhere else found."""
INSTALL = (
    "apt install python3-rospy python3-std-msgs python3-sensor-msgs python3-geometry-msgs "
    "python3-trajectory-msgs python3-diagnostic-msgs"
)
"""What installs them on Debian 12 and Ubuntu 22.04 or newer."""


class _DebianRos:
    """Import hook that finds ROS in Debian's folder; asked last, after the environment itself."""

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
    try:
        return _import_rospy()
    except ImportError as error:
        raise InputError(
            f"ROS 1 needs rospy, which cannot be imported ({error}). With Debian's packages: "
            f"`{INSTALL}`; with others, source their setup file first (docs/live.md)."
        ) from error


def _import_rospy() -> Any:
    installed = any(isinstance(finder, _DebianRos) for finder in sys.meta_path)
    if not installed and Path(DEBIAN_FOLDER, "rospy").is_dir():
        sys.meta_path.append(_DebianRos())
    import rospy

    return rospy


# Message classes: those of ROS's packages, and the authors' message, made here.

HEADER_DEFINITION = """\
uint32 seq
time stamp
string frame_id
"""
"""``std_msgs/Header`` of ROS 1."""
DIAGNOSTIC_ARRAY = "diagnostic_msgs/DiagnosticArray"


@cache
def message_class(type_: str) -> Any:
    """Return the class of a message type.

    A type that is not standard gets the authors' fields, so that no package of theirs is needed.

    Raises:
        InputError: If rospy or the package of a standard type is not installed.
    """
    load_rospy()
    if type_ not in STANDARD_TYPES and type_ != DIAGNOSTIC_ARRAY:
        return _monitoring_class(type_)
    import roslib.message

    found = roslib.message.get_message_class(type_)
    if found is None:
        raise InputError(f"the message type {type_} is not installed. `{INSTALL}` does it.")
    return found


def _monitoring_class(type_: str) -> Any:
    from genpy.dynamic import generate_dynamic

    header = f"{'=' * 80}\nMSG: std_msgs/Header\n{HEADER_DEFINITION}"
    return generate_dynamic(type_, f"{MONITORING_DEFINITION}{header}")[type_]


# Messages as they come from the wire, decoded by the definition that their publisher sends along.

Decoded = tuple[Any, Kind]


class Decoder:
    """Decodes messages of `rospy.AnyMsg`, and remembers the types that it has met.

    Raises:
        InputError: If rosbags is not installed.
    """

    def __init__(self) -> None:
        with needs_extra("messages are decoded by rosbags", "live"):
            import rosbags.typesys  # noqa: F401
        self._types: dict[str, tuple[Any, str, Kind]] = {}

    def decode(self, message: Any) -> Decoded:
        """Return a message as an object with the fields of its kind, and its kind.

        Args:
            message: A `rospy.AnyMsg` as a subscriber gets it.

        Raises:
            InputError: If it is of no kind that is understood.
            Exception: Whatever rosbags raises where bytes do not fit the definition.
        """
        header = message._connection_header
        store, type_, kind = self._type(header["type"], header["message_definition"])
        return store.deserialize_ros1(message._buff, type_), kind

    def _type(self, name: str, definition: str) -> tuple[Any, str, Kind]:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if definition not in self._types:
            store = get_typestore(Stores.EMPTY)
            package, _, base = name.rpartition("/")
            type_ = f"{package}/msg/{base}"
            store.register(get_types_from_msg(definition, type_))
            kind = kind_of(message_fields(store, type_))
            if kind is None:
                raise InputError(f"a message of type {name} is of no kind that is understood.")
            self._types[definition] = store, type_, kind
        return self._types[definition]
