from __future__ import annotations

import pytest

from failuretwin.decision.fleet.partition import Partition
from fleet_messages import envelopes, played, resolve


@pytest.fixture(scope="session")
def alone():
    """What one process without a broker decides, and its partition at the end."""
    partition = Partition(resolve)
    return played(partition, envelopes()), partition
