"""Figures of the console in a headless Chromium: first paint, a wall of 1,000 robots, latency.

    python benchmarks/console.py [--seconds 30]
    python benchmarks/console.py --minutes 20       # memory alone, at ten times the rate

A server in a process of its own shows 1,000 robots whose time changes every second, and the arms of
the demo. Needs Debian's chromium and chromium-driver. First paint is the largest of five loads;
frames are counted by the browser; the processor share is that of the server. Latency is the age of
the reading that the robot page shows, seen from the page 50 times a second. Memory is that of the
server and of all processes of the browser, each minute, with a robot page and the wall open.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROBOTS = 1000
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1300,1000"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
PAINT = """return performance.getEntriesByName('first-contentful-paint')[0]?.startTime"""
FRAMES = """const done = arguments[0], seconds = 5; let frames = 0; const start = performance.now();
const next = () => { frames++; performance.now() - start < 1000 * seconds
  ? requestAnimationFrame(next) : done(frames / seconds); }; next();"""
AGES = """const done = arguments[0], ages = []; const timer = setInterval(() => {
  const read = document.querySelector('[data-read]')?.dataset.read;
  if (read) ages.push(Date.now() / 1000 - Number(read));
  if (ages.length >= 500) { clearInterval(timer); done(ages); } }, 20);"""


def serve(port: int, speed: float) -> None:
    """Show many robots and the demo, whose time passes so fast."""
    from failuretwin.app.console.demo import demo_arms
    from failuretwin.app.console.desk import Desk
    from failuretwin.app.console.server import serve as serve_console
    from failuretwin.app.console.state import WORST_FIRST, Tile
    from failuretwin.app.console.users import Sessions
    from failuretwin.data_knowledge.records.store import open_store
    from failuretwin.digital_model.calibrated_robot import load_calibration

    @dataclass
    class Many(Desk):
        def tiles(self) -> list[Tile]:
            now = datetime.now(UTC)
            many = [
                Tile(
                    f"hall_{k % 9}-arm_{k}",
                    "armpi_fpv",
                    WORST_FIRST[k % len(WORST_FIRST)],
                    "",
                    "said",
                    now,
                )
                for k in range(ROBOTS)
            ]
            return [*super().tiles(), *many]

    known = load_calibration(None, "armpi_fpv")
    folder = Path(tempfile.mkdtemp())
    arms = demo_arms(open_store(folder / "robots.db", create=True), known, speed)
    desk = Many(known, None, None, arms, False, speed, folder)
    serve_console(desk, "127.0.0.1", port, Sessions({}))


def share_of(process: int, seconds: float) -> float:
    """Return the share of a core that a process takes."""

    def used() -> float:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before = used()
    time.sleep(seconds)
    return (used() - before) / seconds


def memory_of(process: int) -> float:
    """Return the memory of a process [bytes]; what it shares counts in part."""
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return 1024.0 * sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def memory_with_children(process: int) -> float:
    """Return the memory of a process and all that it has started [bytes]."""
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    children = {int(child) for one in tasks for child in one.read_text().split()}
    return memory_of(process) + sum(memory_with_children(child) for child in children)


def watch_memory(browser: Any, url: str, server: int, minutes: int) -> None:
    """Print the memory each minute, with a robot page and the wall open."""
    browser.get(url + "/robot?name=hall_1-arm_1")
    browser.switch_to.new_window("window")
    browser.get(url + "/")
    for minute in range(minutes + 1):
        shown = memory_with_children(browser.service.process.pid)
        print(
            f"{minute:3d} min: server {memory_of(server) / 1e6:.0f} MB, "
            f"browser {shown / 1e6:.0f} MB, processor {share_of(server, 10.0):.0%} of a core",
            flush=True,
        )
        time.sleep(50.0)


def measure(browser: Any, url: str, process: int, seconds: float) -> None:
    """Print the figures."""
    idle = share_of(process, 5.0)
    print(f"server, no page open, three emulated arms: {idle:.0%} of a core")
    paints = []
    for page in ("/", "/robot?name=hall_1-arm_1"):
        for _ in range(5):
            browser.get(url + page)
            time.sleep(2.0)
            paints.append(browser.execute_script(PAINT))
        print(f"first paint of {page}: {max(paints):.0f} ms at most, of {len(paints)}")
        paints.clear()
    browser.get(url + "/")
    time.sleep(5.0)
    shown = len(browser.find_elements("css selector", ".wall li"))
    frames = browser.execute_async_script(FRAMES)
    share = share_of(process, seconds)
    print(f"wall of {shown} robots at 1 Hz: {frames:.0f} frames/s, server {share:.0%} of a core")
    browser.get(url + "/robot?name=hall_1-arm_1")
    time.sleep(5.0)
    ages = sorted(browser.execute_async_script(AGES))
    print(
        f"robot page: reading shown after {1e3 * statistics.median(ages):.0f} ms (median), "
        f"{1e3 * ages[int(0.95 * len(ages))]:.0f} ms (95 %)"
    )
    print(f"robot page open: server {share_of(process, seconds):.0%} of a core")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--minutes", type=int, default=0)
    parser.add_argument("--speed", type=float, default=10.0)
    parser.add_argument("--serve", type=int)
    told = parser.parse_args()
    speed = told.speed if told.minutes else 1.0
    if told.serve:
        serve(told.serve, told.speed)
        return
    from selenium import webdriver

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, __file__, "--serve", str(port), "--speed", str(speed)]
    )
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in FLAGS:
        options.add_argument(flag)
    browser = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    browser.set_script_timeout(60)
    try:
        while socket.socket().connect_ex(("127.0.0.1", port)):
            time.sleep(0.5)
        url = f"http://127.0.0.1:{port}"
        if told.minutes:
            watch_memory(browser, url, server.pid, told.minutes)
        else:
            measure(browser, url, server.pid, told.seconds)
    finally:
        browser.quit()
        server.terminate()


if __name__ == "__main__":
    main()
