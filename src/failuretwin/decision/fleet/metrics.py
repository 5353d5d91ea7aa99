"""Figures of a worker for Prometheus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from failuretwin.core.errors import InputError, needs_extra


class Metrics:
    """Figures of one worker, in a registry of its own."""

    def __init__(self) -> None:
        with needs_extra("metrics need prometheus-client", "fleet"):
            from prometheus_client import CollectorRegistry, Gauge, Summary
            from prometheus_client import Counter as Total
        self.registry = CollectorRegistry()
        to = {"registry": self.registry}
        self.workers = Gauge("failuretwin_workers", "Workers alive", **to)
        self.partitions = Gauge("failuretwin_partitions", "Partitions held", **to)
        self.taken_over = Total("failuretwin_takeovers", "Partitions taken", **to)
        self.messages = Total("failuretwin_messages", "Messages filtered", **to)
        self.alarms = Total("failuretwin_alarms", "Changes of alarms", ["state"], **to)
        self.left_out = Gauge(
            "failuretwin_left_out", "Messages and events left out", ["partition", "reason"], **to
        )
        self.robots = Gauge("failuretwin_robots", "Robots", ["partition", "state"], **to)
        self.pending = Gauge("failuretwin_pending", "Messages that wait", ["partition"], **to)
        self.lag = Gauge("failuretwin_lag_seconds", "Delay of the filter", ["partition"], **to)
        self.snapshot_bytes = Gauge(
            "failuretwin_snapshot_bytes", "Size of a snapshot", ["partition"], **to
        )
        self.snapshot_seconds = Summary(
            "failuretwin_snapshot_seconds", "Time to write a snapshot", **to
        )

        self._states: set[str] = set()

    def forget(self, partition: str) -> None:
        """Drop the figures of a partition that is held no longer."""
        for figure in (self.left_out, self.robots, self.pending, self.lag, self.snapshot_bytes):
            figure.remove_by_labels({"partition": partition})

    def serve(self, host: str, port: int) -> None:
        """Serve the figures at an address.

        Raises:
            InputError: If the address is taken.
        """
        from prometheus_client import start_http_server

        try:
            start_http_server(port, host, registry=self.registry)
        except OSError as error:
            raise InputError(f"metrics on {host}:{port}: {error.strerror}.") from error

    def report(self, partition: str, report: Mapping[str, Any]) -> None:
        """Take the health of a partition."""
        self.pending.labels(partition).set(report["pending"])
        self.lag.labels(partition).set(report["lag_s"])
        states = Counter(one["state"] for one in report["robots"].values())
        self._states |= set(states)
        for state in self._states:
            self.robots.labels(partition, state).set(states[state])
        for reason, count in left_out(report).items():
            self.left_out.labels(partition, reason).set(count)


def left_out(report: Mapping[str, Any]) -> Counter[str]:
    """Return what was left out in a partition, by reason."""
    found = Counter(report["counts"])
    for one in report["robots"].values():
        found.update(one["counts"])
    return found
