"""Finds rospy: in the environment, or where Debian's packages put it.

Debian installs its Python modules for its own interpreter, numpy and all. A virtual environment
must not see the whole folder, so only the modules that belong to ROS are let in, and only once
they are asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from failuretwin.core.errors import InputError

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
