"""This process as a ROS 1 node that outlives the master.

rospy tells the master of its topics once. A master that is restarted knows nothing of them, so the
node asks it every second whether it is still known, and tells it all again if not.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from threading import Event, Thread
from typing import Any

from failuretwin.connection.ros1.master import ask_master
from failuretwin.connection.ros1.packages import load_rospy
from failuretwin.core.errors import InputError

NAME = "failuretwin"
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
    """Keeps something registered with the master.

    Args:
        register: Registers it; called from a thread of its own whenever the master has forgotten
            the node.
    """

    def __init__(self, register: Callable[[], None]) -> None:
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
                if not _is_known():
                    self._register()
                    self.renewals += 1
                self.master_gone = False
            # While a master comes up, rospy raises anything from socket errors to faults; whatever
            # it is, the next question comes in a second.
            except Exception:
                self.master_gone = True


def _is_known() -> bool:
    """Return whether the master knows this node; raises OSError if none answers."""
    import rospy

    uri = ask_master("lookupNode", rospy.get_name())
    return bool(uri == rospy.get_node_uri())
