"""Checks of an arm on a network: only with --move, and stopped whatever hangs.

The arm is an emulated one behind a real roscore.
"""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
pytest.importorskip("mujoco")
from console_person import Person
from console_server import PASSWORD, ConsoleServer
from executed import command_line
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.connection.links.ros1 import Ros1Transport
from failuretwin.connection.links.ros_link import RosSource
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.decision.acting.work import HOLD_S, STANDS
from waiting import wait_for

pytestmark = [
    # rospy of Debian 12 leaves sockets to the collector and calls what Python 3.11 deprecates.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
PAGE = "/check?name=armpi_fpv"
QUIET_S = 3.0
"""Time in which a check sends an order or more [s]."""
SCRIPTS_END = """for (let k = 0; k < 100000; k++) clearInterval(k);
window.socket.io.reconnection(false); window.socket.disconnect();"""
HANG = "setTimeout(() => { const end = Date.now() + 9000; while (Date.now() < end); }, 50)"


class Listener:
    """Hears the orders that an arm gets and the angles that it reports."""

    def __init__(self, source):
        self._source, self.orders, self.angle = source, [], None

    def hear(self, seconds=0.0):
        """Take what comes; return the number of orders so far."""
        time.sleep(seconds)
        while (event := self._source.poll(0.0)) is not None:
            if isinstance(event, CommandSent):
                self.orders.append(event)
            elif isinstance(event, Reading) and event.position is not None:
                self.angle = event.position
        return len(self.orders)


@pytest.fixture(scope="module")
def arm(armpi, roscore):
    process = command_line().begin("emulate", "--to", "ros1", "--obey", out=os.devnull)
    with Ros1Transport() as transport:
        listener = Listener(RosSource(armpi, RosTopics(), transport))
        wait_for(lambda: listener.hear() == 0 and listener.angle is not None)
        yield listener
    process.terminate()
    process.wait(20)


@pytest.fixture(scope="module")
def person(request, browser, arm, tmp_path_factory):
    """Somebody signed in at a console that watches the arm."""
    folder = tmp_path_factory.mktemp("console")
    server = ConsoleServer(folder, ("ros1", *request.param))
    found = Person(browser, server.url)
    found.moves = bool(request.param)
    found.sign_in("ada", PASSWORD)
    found.sees("armpi_fpv")
    yield found
    server.stop()


def begin(person, arm, seconds):
    """Begin a check, and wait until it moves an arm that it may move."""
    person.go(PAGE)
    person.write("Seconds", seconds)
    before = arm.hear()
    person.click("Start the check")
    person.sees("armpi_fpv has begun")
    return before


def stands(arm):
    """Return whether the arm gets no order any more, was told to stay, and does not move."""
    before, was = arm.hear(), arm.angle
    same = arm.hear(QUIET_S) == before
    told_to_stay = arm.orders[-1].duration.max() <= HOLD_S
    return same and told_to_stay and np.abs(arm.angle - was).max() < 0.02


WATCHED, MOVED = pytest.param((), id="watched"), pytest.param(("--move",), id="moved")


@pytest.mark.parametrize("person", [WATCHED, MOVED], indirect=True)
def test_only_a_server_that_may_move_an_arm_moves_it(person, arm):
    before = begin(person, arm, "5")
    person.sees("the check is over", "healthy")
    assert (arm.hear() > before) is person.moves
    assert ("started without --move" in person.text) is not person.moves
    assert ("the real arm at ros1" in person.text) is person.moves


@pytest.mark.parametrize("person", [MOVED], indirect=True)
def test_the_stop_button_works_when_the_scripts_have_ended(person, arm):
    before = begin(person, arm, "15")
    wait_for(lambda: arm.hear() > before)
    person.browser.execute_script(SCRIPTS_END)
    person.find("//button[normalize-space()='STOP']").click()
    wait_for(lambda: stands(arm))
    person.go(PAGE)
    person.sees(f"stopped by ada; {STANDS}. Nothing more is sent")


@pytest.mark.parametrize("person", [MOVED], indirect=True)
def test_an_arm_stops_by_itself_when_its_page_hangs(person, arm):
    before = begin(person, arm, "15")
    wait_for(lambda: arm.hear() > before)
    person.browser.execute_script(HANG)
    wait_for(lambda: stands(arm))
    person.sees("the page that started the check is closed, or hangs")
