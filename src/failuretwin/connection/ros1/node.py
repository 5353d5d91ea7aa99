"""This process as a ROS 1 node that outlives the master.

rospy tells the master of its topics once. A master that is restarted knows nothing of them, so we
ask it every second whether it still knows each of them, and tell it again if not.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from threading import Event, Thread
from typing import Any, Literal, get_args

from failuretwin.connection.ros1.master import ask_master
from failuretwin.connection.ros1.packages import load_rospy
from failuretwin.core.errors import InputError

NAME = "failuretwin"
Role = Literal["publisher", "subscriber"]
ROLES: tuple[Role, ...] = get_args(Role)
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

    def __init__(self, role: Role, topics: Sequence[str], register: Callable[[], None]) -> None:
        self._role = role
        self._topics = topics
        self._register = register
        self._stop = Event()
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


def _are_known(role: Role, topics: Sequence[str]) -> bool:
    """Return whether the master knows this node by all topics; raises OSError if none answers."""
    import rospy

    state = ask_master("getSystemState")[ROLES.index(role)]
    known = {topic for topic, nodes in state if rospy.get_name() in nodes}
    return known >= {rospy.resolve_name(topic) for topic in topics}
