"""The demo as people start it: its past in the browser, and its end however it comes."""

from __future__ import annotations

import re
import socket
import tempfile

import psutil
import pytest

pytest.importorskip("nicegui")
pytest.importorskip("selenium", reason="selenium is not installed")

import failuretwin as ft
from console_person import Person
from console_server import PICTURES, ConsoleServer
from waiting import wait_for

TRACKED, SICK, LIVE = "hall_2-arm_9", "hall_2-arm_7", "hall_1-arm_2"
THEN = "//label[span[text()='Then']]//option"
ROBOTS = 9 if PICTURES else 1
"""Robots whose year is simulated: a full wall for the pictures."""
OPTIONS = ("--demo", "--demo-robots", str(ROBOTS), "--speed", "0.5")
"""Arms that move slowly leave the processor to the history that is waited for."""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    made = ConsoleServer(tmp_path_factory.mktemp("demo"), OPTIONS, guarded=False)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def person(browser, server):
    found = Person(browser, server.url)
    found.go("/")
    found.sees(SICK)
    return found


def cells(person, row):
    return [one.text for one in person.find(row).find_elements("tag name", "td")]


def test_a_fault_arrives_live_and_is_open_in_the_store(person):
    person.find(f"//a[strong[text()='{LIVE}'] and contains(@class, 'edge-alarm')]")
    person.press(f"//a[strong[text()='{LIVE}']]")
    person.sees("motor 3 stuck", "alarm number 1", "Probability over time")
    person.sees("open in the store since", "motor 3 stuck, raised (episode 1)")
    since = re.search(r"stuck at .* deg since (\d\d:\d\d:\d\d)", person.text)
    assert since, person.text
    person.find("//canvas")
    person.picture("console_robot")


def test_two_dates_of_a_robot_are_compared(person):
    person.go("/")
    person.sees(TRACKED)
    person.waits(lambda: "The demo simulates" not in person.text)
    person.picture("console_wall")
    person.go(f"/history?name={TRACKED}")
    person.sees("Compare two dates", "Change")
    row = "//tr[td[normalize-space()='motor 2'] and td[normalize-space()='friction']]"
    person.find(row)
    *_, then, now, change = cells(person, row)
    assert then.endswith("deg")
    assert then != now
    assert float(change.split()[0]) == pytest.approx(
        float(now.split()[0]) - float(then.split()[0]), abs=0.02
    )
    person.browser.find_elements("xpath", THEN)[1].click()
    person.waits(lambda: float(cells(person, row)[-1].split()[0]) == 0.0)


def test_sizes_have_no_direction_in_counts(person):
    person.browser.add_cookie({"name": "unit", "value": "counts"})
    person.go(f"/history?name={TRACKED}")
    row = "//tr[td[normalize-space()='motor 2'] and td[normalize-space()='friction']]"
    _, _, then, now, _ = cells(person, row)
    assert "counts" in then
    assert "-" not in then + now
    person.browser.delete_cookie("unit")


def test_the_remaining_life_is_estimated(person):
    person.go(f"/robot?name={TRACKED}")
    person.click("Estimate")
    person.sees("motor 1: ", "motor 4: ")
    person.go(f"/robot?name={SICK}")
    person.click("Estimate")
    person.sees("the wear of this robot has not been tracked yet")


def test_a_robot_whose_year_was_simulated_says_why_it_has_no_replay(person):
    person.go("/")
    person.sees("armpi_fpv_00000")
    person.press("//a[strong[text()='armpi_fpv_00000']]")
    person.sees("Runs without links have no log on this computer")
    days = {row.text.split()[0] for row in person.browser.find_elements("xpath", "//tbody/tr")}
    assert len([day for day in days if day.startswith("20")]) > 50


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
