from __future__ import annotations

import pytest

from failuretwin.decision.fleet.partition import Partition
from fleet_messages import envelopes, played, resolve
from fleet_servers import NatsServer


@pytest.fixture(scope="session")
def alone():
    """What one process without a broker decides."""
    return played(Partition(resolve), envelopes())


@pytest.fixture
def server(tmp_path):
    made = NatsServer(tmp_path / "nats")
    yield made
    made.close()
