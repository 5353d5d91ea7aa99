"""A Zenoh router in this process."""

from __future__ import annotations

import json
from contextlib import contextmanager


def client_of(port):
    """Return the configuration of a client of a router."""
    return _config("client", "connect/endpoints", port)


def _config(mode, role, port):
    import zenoh

    config = zenoh.Config()
    settings = {"mode": mode, role: [f"tcp/127.0.0.1:{port}"], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def zenoh_router(port):
    """Run a router, which knows nothing of ROS, as `rmw_zenohd` does."""
    import zenoh

    router = zenoh.open(_config("router", "listen/endpoints", port))
    try:
        yield
    finally:
        router.close()
