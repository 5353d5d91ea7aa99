"""Waiting for what another process or thread does, without saying how fast it must be."""

from __future__ import annotations

import time
from contextlib import suppress

import psutil

WAIT_S = 60.0
"""Longest wait [s]; whoever needs longer hangs."""


def wait_for(truth):
    """Wait until `truth()` holds."""
    deadline = time.monotonic() + WAIT_S
    while not truth():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def workers_of(pid):
    """Return the processes that a process of Python has spawned to work for it."""
    found = []
    for child in psutil.Process(pid).children():
        with suppress(psutil.NoSuchProcess):  # gone meanwhile
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
    return found
