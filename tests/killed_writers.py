"""Writers that are killed: what they were told is stored must be there, and no half of a call."""

from __future__ import annotations

import os
import signal
import time


def in_a_child(work):
    """Run something in a process of its own and return the process id."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return child


def calls_before_kill(call, delay):
    """Kill a process that makes calls, numbered from 0, some time after the first has returned.

    Args:
        call: Makes a call.
        delay: The time, in times that the first call took.

    Returns:
        Number of calls that have returned.
    """
    heard, told = os.pipe()

    def work():
        for number in range(1000):
            call(number)
            os.write(told, b".")

    begun = time.monotonic()
    child = in_a_child(work)
    os.close(told)
    first = os.read(heard, 1)
    time.sleep(delay * (time.monotonic() - begun))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with os.fdopen(heard, "rb") as pipe:
        rest = pipe.read()
    assert first, "the first call failed"
    return 1 + len(rest)
