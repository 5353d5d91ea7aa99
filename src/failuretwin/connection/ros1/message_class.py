"""Message classes: those of ROS's packages, and the authors' message, made here."""

from __future__ import annotations

from functools import cache
from typing import Any

from failuretwin.connection.links.ros_topics import STANDARD_TYPES
from failuretwin.connection.ros1.packages import INSTALL, load_rospy
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bags.file import MONITORING_DEFINITION

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
