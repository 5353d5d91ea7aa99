from __future__ import annotations

import os

import pytest

from little_logs import make_log
from roscores import Roscore, need_ros


@pytest.fixture(scope="session")
def little_log():
    return make_log()


@pytest.fixture(scope="session")
def roscore(tmp_path_factory):
    """A real roscore; this process finds it by its environment."""
    need_ros()
    core = Roscore(tmp_path_factory.mktemp("ros"))
    core.start()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROS_HOME", "ROS_IP", "ROS_MASTER_URI"):
            patch.setitem(os.environ, name, core.environment[name])
        yield core
    core.stop()
