"""The demo as people start it: its past in the browser, and its end however it comes."""

from __future__ import annotations

import socket
import tempfile

import psutil
import pytest

pytest.importorskip("nicegui")
pytest.importorskip("selenium", reason="selenium is not installed")

import failuretwin as ft
from console_server import ConsoleServer
from waiting import wait_for

OPTIONS = ("--demo", "--demo-robots", "1", "--speed", "0.5")


def ended(process):
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_a_demo_that_is_killed_leaves_nothing_behind(tmp_path):
    folders = tmp_path / "tmp"
    folders.mkdir()
    own = {"TMPDIR": str(folders)}
    killed = ConsoleServer(tmp_path, OPTIONS, own)
    parent = psutil.Process(killed.process.pid)
    wait_for(parent.children)
    (child,) = parent.children()
    killed.kill()
    wait_for(lambda: ended(child))
    (left,) = folders.glob("failuretwin-console-*")
    ft.open_store(tmp_path / "robots.db", create=True)
    again = ConsoleServer(tmp_path, ("--store", "robots.db"), own)
    assert not left.exists()
    assert len(list(folders.glob("failuretwin-console-*"))) == 1
    again.stop()
    assert list(folders.glob("failuretwin-console-*")) == []


def test_a_port_that_is_in_use_is_told_instead_of_the_address(failuretwin):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        told = failuretwin("console", "--demo", "--port", port, folder=tempfile.gettempdir())
    assert told.returncode == 2
    assert "http" not in told.stdout
    assert f"port {port} (Address already in use). Choose another --port" in told.stderr
