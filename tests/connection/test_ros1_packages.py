from __future__ import annotations

import subprocess
import sys

import pytest

from roscores import need_ros


def run(code):
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout.split()


def test_of_debians_modules_only_those_of_ros_are_seen():
    need_ros()
    if sys.prefix == "/usr":
        pytest.skip("this is Debian's own interpreter, which sees them all")
    code = """
import importlib.util
from failuretwin.connection.links.ros1 import load_rospy
rospy = load_rospy()
import numpy
print(rospy.__file__)
print(numpy.__file__)
print(*(importlib.util.find_spec(name) is None for name in ("apt", "gi", "catkin_pkg")))
"""
    rospy, numpy, *hidden = run(code)
    assert rospy.startswith("/usr/lib/python3/dist-packages/")
    assert not numpy.startswith("/usr/lib/python3/")
    assert hidden == ["True", "True", "False"]


def test_without_ros_the_user_is_told_what_to_install():
    code = """
import sys
from failuretwin.connection.links import ros1 as packages
sys.modules["rospy"] = None
packages.DEBIAN_FOLDER = "/nowhere"
try:
    packages.load_rospy()
except ValueError as error:
    print(error)
"""
    told = " ".join(run(code))
    assert "apt install python3-rospy" in told
