"""A console in a process of its own, and a browser without a window, for tests."""

from __future__ import annotations

import os
import shutil
import signal

import pytest

from executed import command_line
from failuretwin.app.console.users import add_user
from fleet_servers import free_port, listens
from waiting import wait_for

REQUIRE = "FAILURETWIN_REQUIRE_CHROMIUM"
"""Variable that makes tests fail where the browser is not installed."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1300,1000"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"),
)
PICTURES = os.environ.get("FAILURETWIN_PICTURES")
"""Folder for the pictures of README and docs; empty: none are taken."""
PASSWORD = "correct horse"
USERS = {"ada": "move", "eve": "see"}


DEMO = ("--demo", "--demo-robots", "0", "--speed", "0.4")
"""Arms that move slowly cost little while people look at other pages."""


class ConsoleServer:
    """A console whose users sign in.

    Args:
        folder: Folder for its users.
        options: What it shows.
        environment: Variables it has besides ours.
        guarded: Whether people sign in.
    """

    def __init__(self, folder, options=DEMO, environment=None, guarded=True):
        pytest.importorskip("nicegui", reason="pip install 'failuretwin[console]'")
        self.port, self.process, self._folder = free_port(), None, folder
        self._options, self._environment = list(options), environment or {}
        if guarded:
            self._options += ["--users", "users.toml"]
        self.url = f"http://127.0.0.1:{self.port}"
        for name, role in USERS.items():
            add_user(folder / "users.toml", name, role, PASSWORD)
        self.start()

    def start(self):
        options = [*self._options, "--port", str(self.port)]
        ours = {k: v for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST"}
        self.process = command_line().begin(
            *("console", *options),
            folder=self._folder,
            environment=ours | self._environment,
            out=self._folder / "console.log",
        )
        try:
            wait_for(self._listens)
        except AssertionError:
            self.kill()
            raise

    def _listens(self):
        assert self.process.poll() is None, "the server ended"
        return listens(self.port)

    def kill(self):
        self.process.kill()
        self.process.wait()

    def stop(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait(120)  # loops that are being compiled hold it


def open_browser():
    """Return a browser, or skip the test."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        reason = "no chromium here; install the packages `chromium` and `chromium-driver`"
        if os.environ.get(REQUIRE):
            pytest.fail(reason)
        pytest.skip(reason)
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in FLAGS:
        options.add_argument(flag)
    if not PICTURES:  # a quarter of the pixels, all drawn by the processor
        options.add_argument("--force-device-scale-factor=0.5")
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    return webdriver.Chrome(options, webdriver.ChromeService(driver))
