"""The page of `fleet status`, from what workers have reported."""

from __future__ import annotations

import io

from rich.console import Console

from failuretwin.app.fleet import status_page


def shown(status, now):
    """Return the lines of the page."""
    out = io.StringIO()
    Console(file=out, width=120).print(status_page(status, now))
    return out.getvalue().splitlines()


def test_a_worker_that_says_nothing_and_robots_that_are_left_out_are_seen():
    part = {
        "at": 96.0,
        "robots": {"arm_1": {"state": "clear", "cause": "", "counts": {"late": 2}}},
        "counts": {"malformed": 1},
        "remarks": {"arm_2": "kind 'x', expected profile or events."},
        "pending": 0,
        "lag_s": 0.1,
        "messages_per_s": 1.0,
    }
    status = {
        "workers": {"one": {"at": 99.0}, "dead": {"at": 70.0}},
        "partitions": {"p0": part},
        "leases": {"p0": "one"},
        "waiting": 3,
        "alarms": 0,
    }
    lines = shown(status, 100.0)
    (dead,) = [line for line in lines if line.startswith("dead")]
    assert dead.rstrip().endswith("30 s ago")
    assert "left out so far: 2 late, 1 malformed" in lines
    assert any("arm_2" in line and "expected profile or events" in line for line in lines)
