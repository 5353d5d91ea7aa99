from __future__ import annotations

import pytest

from little_logs import make_log


@pytest.fixture(scope="session")
def little_log():
    return make_log()
