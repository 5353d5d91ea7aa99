from __future__ import annotations

import pytest

from console_server import ConsoleServer, open_browser


@pytest.fixture(scope="module")
def browser():
    made = open_browser()
    yield made
    made.quit()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A console with a robot at work, which would keep a core busy while other files are tested."""
    made = ConsoleServer(tmp_path_factory.mktemp("console"))
    yield made
    made.stop()
