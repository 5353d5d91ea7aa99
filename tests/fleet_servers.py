"""A real nats-server and a real mosquitto for tests, on free ports of 127.0.0.1."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time

import pytest

from failuretwin.connection.fleet.broker import server_config

REQUIRE = "FAILURETWIN_REQUIRE_NATS"
"""Variable that makes tests fail where a server is not installed."""


def need_program(name):
    """Return the path of a server, or skip the test."""
    found = shutil.which(name) or shutil.which(name, path="/usr/sbin:/usr/local/sbin")
    if found is None:
        reason = f"no {name} here; install the package `{name}`"
        if os.environ.get(REQUIRE):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def listens(port):
    """Return whether a server listens at a port of this computer.

    A connection to a port that nobody has may come from that port: then it is one with itself.
    """
    with socket.socket() as one:
        reached = one.connect_ex(("127.0.0.1", port)) == 0
        return reached and one.getsockname() != one.getpeername()


def wait_for(port, process):
    for _ in range(200):
        assert process.poll() is None, "the server ended"
        if listens(port):
            return
        time.sleep(0.05)
    raise AssertionError(f"nothing listens on port {port}")


class NatsServer:
    """A server with JetStream and MQTT; `extra` is added to the configuration of `config`."""

    def __init__(self, folder, extra="", partitions=2, config=server_config):
        self._program = need_program("nats-server")
        pytest.importorskip(
            "nats", reason="nats-py is not installed: pip install 'failuretwin[fleet]'"
        )
        self.folder, self.port, self.mqtt_port = folder, free_port(), free_port()
        folder.mkdir(parents=True, exist_ok=True)
        text = config(self.port, self.mqtt_port, folder / "data", partitions)
        (folder / "nats.conf").write_text(text + extra)
        self.process = None
        self.start()

    @property
    def url(self):
        return f"nats://127.0.0.1:{self.port}"

    def start(self):
        with (self.folder / "nats.log").open("ab") as log:
            self.process = subprocess.Popen(
                [self._program, "-c", str(self.folder / "nats.conf")], stdout=log, stderr=log
            )
        wait_for(self.port, self.process)

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def close(self):
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait()


class Mosquitto:
    """A broker of a gateway; lines of `config` follow its port."""

    def __init__(self, folder, config):
        program = need_program("mosquitto")
        folder.mkdir(parents=True, exist_ok=True)
        self.port = free_port()
        path = folder / "mosquitto.conf"
        path.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n{config}\n")
        with (folder / "mosquitto.log").open("ab") as log:
            self.process = subprocess.Popen([program, "-c", str(path)], stdout=log, stderr=log)
        wait_for(self.port, self.process)

    def close(self):
        self.process.terminate()
        self.process.wait()
