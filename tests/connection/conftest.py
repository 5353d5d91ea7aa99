from __future__ import annotations

import pytest

from little_logs import make_log
from roscores import free_port


@pytest.fixture(scope="session")
def little_log():
    return make_log()


@pytest.fixture
def server():
    """A rosbridge server that records what it is told."""
    fake = pytest.importorskip("fake_rosbridge").FakeRosbridge(free_port())
    yield fake
    fake.stop()


@pytest.fixture
def transport(server):
    """A connection to that server."""
    from failuretwin.connection.links.rosbridge import RosbridgeTransport

    with RosbridgeTransport("127.0.0.1", server.port) as opened:
        yield opened
