"""A Zenoh router in this process."""

from __future__ import annotations

import json
from contextlib import contextmanager


@contextmanager
def zenoh_router(port):
    """Run a router, which knows nothing of ROS; such as `rmw_zenohd` is one."""
    import zenoh

    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    router = zenoh.open(config)
    try:
        yield
    finally:
        router.close()
