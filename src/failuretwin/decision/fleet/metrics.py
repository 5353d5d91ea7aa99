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

        def gauge(name: str, text: str, *labels: str) -> Gauge:
            return Gauge(f"failuretwin_{name}", text, labels, registry=self.registry)

        def total(name: str, text: str, *labels: str) -> Total:
            return Total(f"failuretwin_{name}", text, labels, registry=self.registry)

        self.workers = gauge("workers", "Workers alive")
        self.partitions = gauge("partitions", "Partitions held")
        self.taken_over = total("takeovers", "Partitions taken")
        self.messages = total("messages", "Messages filtered")
        self.alarms = total("alarms", "Changes of alarms", "state")
        self.left_out = gauge("left_out", "Messages and events left out", "partition", "reason")
        self.robots = gauge("robots", "Robots", "partition", "state")
        self.pending = gauge("pending", "Messages that wait", "partition")
        self.lag = gauge("lag_seconds", "Delay of the filter", "partition")
        self.snapshot_bytes = gauge("snapshot_bytes", "Size of a snapshot", "partition")
        self.snapshot_seconds = Summary(
            "failuretwin_snapshot_seconds", "Time to write a snapshot", registry=self.registry
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
