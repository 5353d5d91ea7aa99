"""The console by keys alone: no pointer, and the focus is seen at every stop."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from console_person import LONGEST_S, Person
from console_server import PASSWORD

SICK, LIVE = "hall_2-arm_7", "hall_1-arm_2"
MOST_STOPS = 120
"""Stops of a page that are gone through at most."""
FOCUSED = """const one = document.activeElement;
if (one === document.body) return ['', true];
const seen = (part) => part && getComputedStyle(part).outlineStyle !== 'none' &&
  parseFloat(getComputedStyle(part).outlineWidth) >= 2;
const label = one.labels?.[0]?.textContent || '';
return [one.getAttribute('aria-label') || label || one.textContent || one.name || '',
  seen(one) || seen(one.closest('.q-field'))];"""


class Keyboard(Person):
    """Somebody who has no pointer."""

    def keys(self, *keys):
        ActionChains(self.browser).send_keys(*keys).perform()

    @property
    def focus(self):
        """Words of what has the focus, which must be seen to have it."""
        words, seen = self.browser.execute_script(FOCUSED)
        assert seen, f"the focus on {words!r} is not seen"
        return words.strip()

    def tab_to(self, words):
        """Go on by Tab until something with some words has the focus."""
        stops = []
        deadline = time.monotonic() + LONGEST_S
        while time.monotonic() < deadline and len(stops) < MOST_STOPS:
            self.keys(Keys.TAB)
            stops.append(self.focus)
            if words in stops[-1]:
                return
        raise AssertionError(f"{words!r} is not among {stops}")

    def open(self, words):
        self.tab_to(words)
        self.keys(Keys.ENTER)


@pytest.fixture(scope="module")
def person(browser, server):
    found = Keyboard(browser, server.url)
    found.go("/login")
    return found


def test_somebody_signs_in_finds_the_sick_robot_and_confirms(person):
    person.waits(lambda: person.focus == "Name")
    person.keys("ada", Keys.TAB, PASSWORD, Keys.ENTER)
    person.sees(SICK)
    person.tab_to("Search")
    person.keys("stuck")
    person.sees("arm_7")
    person.tab_to("State")
    person.keys("alarm")
    person.open(SICK)
    person.sees("What to do now", "motor 3 stuck")
    person.open("History")
    person.sees("Fault episodes")
    person.tab_to("Note")
    person.keys("by keys")
    person.open("Confirm: episode 1")
    person.sees("confirmed, by keys, ada")
    person.waits(lambda: person.focus == "Confirm: episode 1")
    person.open("Undo: episode 1")
    person.sees("finding 'confirmed' withdrawn")


def test_the_moment_is_replayed(person):
    person.open(SICK)
    person.sees("Runs")
    tuesday = person.find("//tr[td[normalize-space()='tuesday']]//a")
    person.open(tuesday.get_attribute("aria-label"))
    person.sees("possible causes")
    person.find("//input[@type='range']")
    before = clock(person)
    person.tab_to("Time in the run")
    person.keys(*[Keys.ARROW_RIGHT] * 50)
    person.waits(lambda: clock(person) == pytest.approx(before + 1.0, abs=0.05))
    person.open("movement 4:")
    person.waits(lambda: clock(person) > 3.0)
    before = clock(person)
    person.keys(Keys.SHIFT + Keys.TAB)
    person.open("Replay")
    person.waits(lambda: clock(person) > before)
    person.open("Above")


def clock(person):
    return float(person.find("//p[@role='status']").text.split()[0])


def test_a_live_robot_is_followed_while_its_page_is_drawn_anew(person):
    person.open("Robots")
    person.sees(LIVE)
    person.open(LIVE)
    person.sees("motor 3 stuck", "nats for motor 3")
    person.open("movement ")
    person.sees("Replay: ")


def test_a_check_is_begun_and_stopped(person):
    person.open("Check")
    person.sees("Seconds")
    person.tab_to("Seconds")
    person.keys(Keys.CONTROL + "a", "30")
    person.open("Start the check")
    person.sees("has begun")
    person.open("STOP")
    person.sees("stopped by ada; ")


def test_colours_and_units_are_chosen(person):
    person.tab_to("Angles in")
    person.keys(Keys.ARROW_DOWN)
    person.waits(lambda: person.browser.get_cookie("unit") and person.focus.startswith("Angles in"))
    assert person.browser.get_cookie("unit")["value"] == "rad"


def test_a_log_can_be_chosen(person):
    person.open("Import a log")
    person.sees("Drop a log here")
    person.tab_to("Log file")
