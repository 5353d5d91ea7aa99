"""A worker that is paused until its robots are another's, on a real server."""

from __future__ import annotations

import asyncio
import json
import signal
import time

import pytest

from failuretwin.connection.fleet.broker import HEALTH
from running_fleet import ask, health, start, start_worker, until, worker_thread

PAUSE_S = 12.0
"""Longer than a robot may be silent [s]."""


def heard_after(url, process):
    """Let a process go on, and return the states that are said of robots then."""

    async def listen(broker):
        found = []

        async def note(message):
            found.append(json.loads(message.data)["state"])

        await broker.client.subscribe(f"{HEALTH}.>", cb=note)
        await broker.client.flush()
        process.send_signal(signal.SIGCONT)
        await asyncio.sleep(5.0)
        return found

    return ask(url, listen)


@pytest.mark.slow
def test_a_worker_that_was_paused_calls_no_robot_stale(server, tmp_path):
    bridge = start(tmp_path / "bridge.log", "bridge", "emulated", "--fleet", server.url)
    paused = start_worker(server, "paused")
    try:
        until(server.url, health, lambda parts: any(one["robots"] for one in parts.values()))
        paused.send_signal(signal.SIGSTOP)
        with worker_thread(server.url):
            time.sleep(PAUSE_S)
            assert "stale" not in heard_after(server.url, paused)
            parts = ask(server.url, health)
            states = [one["state"] for part in parts.values() for one in part["robots"].values()]
            assert states and "stale" not in states
    finally:
        for process in (bridge, paused):
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait()
