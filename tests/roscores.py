"""A real roscore from Debian's packages, on a port of its own."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest

from waiting import WAIT_S, wait_for

REQUIRE = "FAILURETWIN_REQUIRE_ROS"
"""Environment variable under which a missing ROS is a failure, as in the full test run."""


def need_ros():
    """Skip a test where ROS 1 is missing, and say why."""
    if shutil.which("roscore") is not None:
        return
    reason = "no roscore; apt install python3-roslaunch python3-rosmaster rosout (docs/live.md)"
    if os.environ.get(REQUIRE):
        pytest.fail(reason)
    pytest.skip(reason)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Roscore:
    """A roscore that can be killed and started again at the same address."""

    def __init__(self, home: Path) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            **{k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
            "ROS_HOME": str(home),
            "ROS_IP": "127.0.0.1",
            "ROS_MASTER_URI": self.uri,
        }
        self._process = None

    def start(self):
        self._process = subprocess.Popen(
            ["roscore", "-p", str(self.port)],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        wait_for(self._answers)

    def kill(self):
        """Kill it with all that it has started, without a goodbye."""
        for pid in (self._process.pid, *self._children()):
            os.kill(pid, signal.SIGKILL)
        self._process.wait()

    def stop(self):
        """Stop it as a user does."""
        self._process.terminate()
        self._process.wait(WAIT_S)

    def _children(self):
        """Return the processes of the master and of the logger, each in a group of its own."""
        with ServerProxy(self.uri) as master:
            pids = [master.getPid("/test")[2]]
            _, _, address = master.lookupNode("/test", "/rosout")
        if address:
            with ServerProxy(address) as rosout:
                pids.append(rosout.getPid("/test")[2])
        return pids

    def topic_types(self):
        with ServerProxy(self.uri) as master:
            return dict(master.getTopicTypes("/test")[2])

    def _answers(self):
        try:
            with ServerProxy(self.uri) as master:
                return master.getPid("/test")[0] == 1
        except OSError:
            return False
