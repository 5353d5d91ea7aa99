"""Questions to the ROS master that end in time, whatever state it is in."""

from __future__ import annotations

import os
from http.client import HTTPConnection, HTTPException
from typing import Any
from xmlrpc.client import Error, ServerProxy, Transport

ASKED_BY = "/failuretwin"
DEFAULT_URI = "http://localhost:11311"
TIMEOUT_S = 2.0
"""Longest wait for an answer [s]."""


class _TimedTransport(Transport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def ask_master(question: str, *arguments: str) -> Any:
    """Return the answer of the master's XML-RPC interface; None if it says it does not know.

    Args:
        question: Name of the call, such as ``lookupNode``.
        arguments: What it takes besides the name of who asks.

    Raises:
        OSError: If no master answers.
    """
    uri = os.environ.get("ROS_MASTER_URI", DEFAULT_URI)
    try:
        with ServerProxy(uri, transport=_TimedTransport()) as master:
            code, _, value = getattr(master, question)(ASKED_BY, *arguments)
    except (Error, HTTPException, ValueError, TypeError) as error:
        raise OSError(f"no sensible answer from {uri}: {error}") from error
    return value if code == 1 else None
