"""What people do with the console, by what they see and click, in a real browser.

Also time zones, units, print, phones and colours, as the browser shows them, and all by keys alone.
The stories are told in their order, on one server and in one browser.
"""

from __future__ import annotations

import json
import re
import time
import urllib.parse
import urllib.request

import pytest

import failuretwin as ft
from console_server import PASSWORD, PICTURES, ConsoleServer

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from console_person import LONGEST_S, Person

TOOL_COLUMNS = """
[tool]
columns = ["a", "b", "c"]
unit = "m"
"""
SICK, LIVE, SILENT, DOUBTED = "hall_2-arm_7", "hall_1-arm_2", "hall_1-arm_3", "hall_2-arm_8"
TRACKED = "hall_2-arm_9"
ROBOTS = 9 if PICTURES else 1
"""Robots whose year is simulated: a full wall for the pictures."""
OPTIONS = ("--demo", "--demo-robots", str(ROBOTS), "--speed", "1")
THEN = "//label[span[text()='Then']]//option"
FRICTION = "//tr[td[normalize-space()='motor 2'] and td[normalize-space()='friction']]"
TUESDAY = "//tr[td[normalize-space()='tuesday']]"
PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
CONTRAST = {"runOnly": {"type": "rule", "values": ["color-contrast"]}}
WIDTH = "return document.documentElement.scrollWidth"
MOST_STOPS = 120
"""Stops of a page that are gone through at most."""
FOCUSED = """const one = document.activeElement;
if (one === document.body) return ['', true];
const seen = (part) => part && getComputedStyle(part).outlineStyle !== 'none' &&
  parseFloat(getComputedStyle(part).outlineWidth) >= 2;
const label = one.labels?.[0]?.textContent || '';
return [one.getAttribute('aria-label') || label || one.textContent || one.name || '',
  seen(one) || seen(one.closest('.q-field'))];"""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    made = ConsoleServer(tmp_path_factory.mktemp("console"), OPTIONS)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def person(browser, server):
    return Person(browser, server.url)


def rate_of(person, fault):
    row = person.find(f"//tr[td[1][normalize-space()='{fault}']]")
    return float(row.find_elements("tag name", "td")[-1].text)


def test_a_wrong_password_lets_nobody_in(person):
    person.sign_in("ada", "wrong")
    person.sees("Name or password is wrong.")
    person.go("/robot?name=" + SICK)
    person.sees("Password")
    assert SICK not in person.text


def test_the_right_one_shows_the_wall_with_the_sick_robot_first(person):
    person.sign_in("ada", PASSWORD)
    person.sees(SICK, "motor 3 stuck", "signed in as ada (move)")
    first = person.find("//ul[@class='wall']/li[1]").text
    assert SICK in first
    assert "alarm" in first


def test_the_wall_is_searched_and_filtered(person):
    person.write("search", "arm_7")
    person.sees("1 of ")
    person.write("search", "nobody")
    person.sees("No robot matches.")
    person.go("/")
    person.sees(DOUBTED)
    person.find("//select[@name='states']/option[contains(., 'set-up uncertain')]").click()
    person.sees("1 of ", DOUBTED, "motor 2 turns the other way")
    for key, value in (("kind", "armpi_fpv"), ("site", "hall_2")):
        person.find(f"//select[@name='{key}']/option[contains(., '{value}')]").click()
        person.sees("1 of ", DOUBTED)
    person.find("//select[@name='site']/option[contains(., 'hall_1')]").click()
    person.sees("No robot matches.")
    person.go("/")


def test_why_a_stored_robot_is_sick_and_the_moment_replayed(person):
    person.sees(SICK)
    person.press(f"//a[strong[text()='{SICK}']]")
    person.sees("What to do now", "Cut the power", "motor 3 stuck")
    person.press(TUESDAY + "//a")
    person.sees("movement 4:", "possible causes", "What to do now")
    person.press("//button[contains(., 'movement 4:')]")
    person.waits(lambda: float(person.find("//p[@role='status']").text.split()[0]) > 3.0)
    person.find("//canvas")
    person.picture("console_replay")


def test_a_confirmation_changes_the_learned_rate_and_is_undone(person):
    person.go(f"/history?name={SICK}")
    before = rate_of(person, "motor 3 stuck")
    person.write("Note", "<b>teeth</b> are gone")
    person.click("Confirm: episode 1")
    person.sees("confirmed, <b>teeth</b> are gone, ada")
    person.waits(lambda: rate_of(person, "motor 3 stuck") > before)
    person.picture("console_history")
    person.click("Undo: episode 1")
    person.sees("finding 'confirmed' withdrawn")
    person.waits(lambda: rate_of(person, "motor 3 stuck") == before)
    person.click("Reject: episode 1")
    person.sees("wrong, ada")
    person.click("Undo: episode 1")
    person.sees("finding 'wrong' withdrawn")
    person.write("Cause", "a loose belt")
    person.click("Other cause: episode 1")
    person.sees("other cause, a loose belt")
    person.click("Undo: episode 1")
    person.sees("finding 'other cause' withdrawn")


def test_a_repair_is_noted_and_undone(person):
    person.write("Part", "gear 7")
    person.click("Repair")
    person.sees("gear 7 replaced")
    person.click("Undo its last repair")
    person.waits(lambda: "gear 7 replaced" not in person.text)


def test_a_log_is_imported(person):
    person.go("/import")
    person.find("//input[@type='file']").send_keys(str(ft.sample_log()))
    person.sees("motor 3 stuck at -7 deg", "Page for technicians")
    person.sees("Not stored: no robot is named")
    assert not person.browser.find_elements("class name", "q-uploader__file")
    page = person.find("//a[normalize-space()='Page for technicians']").get_attribute("href")
    person.browser.get(page)
    person.sees("motor 3")


def test_a_log_that_is_refused_is_mended_in_the_page(person, tmp_path):
    def drop(name, text):
        (tmp_path / name).write_text(text, "utf-8")
        person.find("//input[@type='file']").send_keys(str(tmp_path / name))

    person.go("/import")
    drop("words.txt", "hello")
    person.sees("words.txt is no log that can be read here", "Expected a file that ends in .nc")
    drop("broken.nc", "hello")
    person.sees("broken.nc: cannot be read as a run set")
    log = ft.sample_log().read_text("utf-8")
    header, rows = log.split("\n", 1)
    drop("week.csv", header.replace("tool_x_m,tool_y_m,tool_z_m", "a,b,c") + "\n" + rows)
    person.sees("week.csv: needs a column map", "The field 'Columns' below holds a guess")
    assert "--" not in person.find("//p[@role='alert']").text
    assert "/" not in person.find("//p[@role='alert']").text
    assert not person.browser.find_elements("class name", "q-uploader__file")
    person.find("//textarea").send_keys(TOOL_COLUMNS)
    person.click("Read it again")
    person.sees("week.csv: ", "motor 3 stuck at -7 deg")


def test_a_silent_robot_is_stale_with_its_last_word(person):
    person.go("/")
    person.find(f"//a[strong[text()='{SILENT}'] and contains(@class, 'edge-stale')]")
    assert "last word: " in person.find(f"//a[strong[text()='{SILENT}']]").text


def test_a_fault_arrives_live(person):
    person.go("/")
    person.find(f"//a[strong[text()='{LIVE}'] and contains(@class, 'edge-alarm')]")
    person.press(f"//a[strong[text()='{LIVE}']]")
    person.sees("motor 3 stuck", "alarm number 1", "Probability over time", "nats for motor 3")
    person.sees("open in the store since", "motor 3 stuck, raised (episode 1)")
    since = re.search(r"stuck at .* deg since (\d\d:\d\d:\d\d)", person.text)
    assert since, person.text
    person.find("//canvas")
    person.picture("console_robot")
    person.press("//a[starts-with(normalize-space(), 'movement ')]")
    person.sees("Replay: ", "Angles")


def test_a_check_is_run_and_stopped_while_the_page_hangs(person, server):
    person.go(f"/check?name={LIVE}")
    person.click("Start the check")
    person.sees(f"the check of {LIVE} has begun")
    session = person.browser.get_cookie("failuretwin_session")["value"]
    person.browser.execute_script(
        "setTimeout(() => { const end = Date.now() + 2500; while (Date.now() < end); }, 50)"
    )
    assert "Told to stop." in post(server.url + "/stop", {}, session)
    person.sees("stopped by ada; ")
    person.write("Seconds", "8")
    person.click("Start the check")
    person.sees("the check is over", "RED", "motor 3")
    person.picture("console_check")


def post(url, fields, session="", headers=None):
    """Send a form as a program would, and return the answer."""
    told = {"Cookie": f"failuretwin_session={session}", **(headers or {})}
    data = urllib.parse.urlencode(fields).encode()
    with urllib.request.urlopen(urllib.request.Request(url, data, told), timeout=30) as answer:
        return answer.read().decode()


def test_the_pages_have_no_serious_finding_of_axe(person):
    axe = pytest.importorskip("axe_selenium_python", reason="axe-selenium-python is missing")
    found = {}
    person.go(f"/robot?name={SICK}")
    replay = person.find(TUESDAY + "//a[normalize-space()='Replay']").get_attribute("href")
    replay = replay.removeprefix(person.url)
    pages = ("/", f"/robot?name={LIVE}", f"/history?name={SICK}", replay, "/check", "/import")
    for page in pages:
        person.go(page)
        person.find("//main//h1")
        if page == "/import":  # labelled once the upload field is there
            person.find("//input[contains(@class, 'q-uploader__input') and @aria-label]")
        time.sleep(0.5)
        checker = axe.Axe(person.browser)
        checker.inject()
        for one in checker.run()["violations"]:
            if one["impact"] in ("serious", "critical"):
                found[page, one["id"]] = [node["html"][:300] for node in one["nodes"][:3]]
    assert found == {}, found


# Time zone, units, print, phones and colours.


def tell(person, command, **values):
    return person.browser.execute_cdp_cmd(f"Emulation.{command}", values)


def test_times_are_those_of_the_reader(person):
    hours = {}
    for zone in ("Asia/Tokyo", "America/New_York"):
        tell(person, "setTimezoneOverride", timezoneId=zone)
        person.browser.delete_cookie("zone")
        person.go(f"/robot?name={SICK}")
        person.waits(lambda zone=zone: person.browser.get_cookie("zone")["value"] == zone)
        person.sees("Runs")
        hours[zone] = person.find(TUESDAY + "/td[1]").text.split()[1]
        person.go(f"/history?name={SICK}")
        person.sees("Timeline", hours[zone])
        person.go("/")
        person.sees(SICK)
        assert f"{hours[zone]}:00" in person.find(f"//a[strong[text()='{SICK}']]").text
    # Logs of the demo are of midnight in Greenwich.
    assert hours["Asia/Tokyo"] == "09:00"
    assert hours["America/New_York"] in ("19:00", "20:00")
    tell(person, "setTimezoneOverride", timezoneId="")


def test_angles_are_in_the_unit_of_the_reader(person):
    said = {}
    for unit in ("rad", "counts", "deg"):
        person.browser.add_cookie({"name": "unit", "value": unit})
        person.go(f"/robot?name={SICK}")
        person.sees("Held at [" + unit)
        said[unit] = person.find(TUESDAY).text
    assert "stuck at 26 deg" in said["deg"]
    assert "stuck at 0.454 rad" in said["rad"]  # 26 pi / 180
    assert "stuck at 392 counts" in said["counts"]  # (120 - 26) / 0.24
    person.browser.add_cookie({"name": "unit", "value": "counts"})
    person.go("/import")
    person.find("//input[@type='file']")
    person.go(f"/robot?name={LIVE}")
    person.waits(lambda: "counts" in person.find("//tr[td[normalize-space()='motor 1']]").text)
    person.browser.delete_cookie("unit")


def test_the_page_for_technicians_prints(person):
    person.go(f"/robot?name={SICK}")
    person.press(TUESDAY + "//a[normalize-space()='Page for technicians']")
    person.sees("motor 3", "Next step")
    button = person.find("//button[normalize-space()='Print, or save as PDF']")
    assert button.is_displayed()
    tell(person, "setEmulatedMedia", media="print")
    assert not button.is_displayed()
    tell(person, "setEmulatedMedia", media="")
    person.browser.execute_script("window.print = () => { document.title = 'printed'; }")
    button.click()
    assert person.browser.title == "printed"
    pdf = person.browser.execute_cdp_cmd("Page.printToPDF", {})["data"]
    assert pdf.startswith("JVBER")  # %PDF in base 64


def test_the_wall_fits_a_phone(person):
    tell(person, "setDeviceMetricsOverride", **PHONE)
    person.go("/")
    person.sees(SICK)
    assert person.browser.execute_script(WIDTH) <= PHONE["width"]
    tell(person, "clearDeviceMetricsOverride")


def test_dark_colours_have_contrast(person):
    """Light ones are judged with all else: test_the_pages_have_no_serious_finding_of_axe."""
    axe = pytest.importorskip("axe_selenium_python", reason="axe-selenium-python is missing")
    person.browser.add_cookie({"name": "theme", "value": "dark"})
    found = []
    named = f"name={SICK}"
    person.go(f"/robot?{named}")
    replay = person.find(TUESDAY + "//a[normalize-space()='Replay']").get_attribute("href")
    replay = replay.removeprefix(person.url)
    pages = ("/", f"/robot?{named}", replay)
    for page in pages:
        person.go(page)
        person.find("//main//h1")
        time.sleep(0.5)
        checker = axe.Axe(person.browser)
        checker.inject()
        wrong = checker.run(options=CONTRAST)["violations"]
        found += [(page, node["html"][:200]) for one in wrong for node in one["nodes"]]
    person.browser.delete_cookie("theme")
    assert found == []


# The past of the demo, which it writes while people look at other pages.


def cells(person, row):
    return [one.text for one in person.find(row).find_elements("tag name", "td")]


def test_two_dates_of_a_robot_are_compared(person):
    person.go("/")
    person.sees(TRACKED)
    person.waits(lambda: "The demo simulates" not in person.text)
    person.picture("console_wall")
    person.go(f"/history?name={TRACKED}")
    person.sees("Compare two dates", "Change")
    person.find(FRICTION)
    *_, then, now, change = cells(person, FRICTION)
    assert then.endswith("deg")
    assert then != now
    assert float(change.split()[0]) == pytest.approx(
        float(now.split()[0]) - float(then.split()[0]), abs=0.02
    )
    person.browser.find_elements("xpath", THEN)[1].click()
    person.waits(lambda: float(cells(person, FRICTION)[-1].split()[0]) == 0.0)


def test_sizes_have_no_direction_in_counts(person):
    person.browser.add_cookie({"name": "unit", "value": "counts"})
    person.go(f"/history?name={TRACKED}")
    _, _, then, now, _ = cells(person, FRICTION)
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


# By keys alone: no pointer, and the focus is seen at every stop.


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
def keyboard(browser, server):
    browser.delete_all_cookies()
    found = Keyboard(browser, server.url)
    found.go("/login")
    return found


def test_somebody_signs_in_finds_the_sick_robot_and_confirms(keyboard):
    keyboard.waits(lambda: keyboard.focus == "Name")
    keyboard.keys("ada", Keys.TAB, PASSWORD, Keys.ENTER)
    keyboard.sees(SICK)
    keyboard.tab_to("Search")
    keyboard.keys("stuck")
    keyboard.sees("arm_7")
    keyboard.tab_to("State")
    keyboard.keys("alarm")
    keyboard.open(SICK)
    keyboard.sees("What to do now", "motor 3 stuck")
    keyboard.open("History")
    keyboard.sees("Fault episodes")
    keyboard.tab_to("Note")
    keyboard.keys("by keys")
    keyboard.open("Confirm: episode 1")
    keyboard.sees("confirmed, by keys, ada")
    keyboard.waits(lambda: keyboard.focus == "Confirm: episode 1")
    keyboard.open("Undo: episode 1")
    keyboard.sees("finding 'confirmed' withdrawn")


def test_the_moment_is_replayed(keyboard):
    keyboard.open(SICK)
    keyboard.sees("Runs")
    tuesday = keyboard.find("//tr[td[normalize-space()='tuesday']]//a")
    keyboard.open(tuesday.get_attribute("aria-label"))
    keyboard.sees("possible causes")
    keyboard.find("//input[@type='range']")
    before = clock(keyboard)
    keyboard.tab_to("Time in the run")
    keyboard.keys(*[Keys.ARROW_RIGHT] * 50)
    keyboard.waits(lambda: clock(keyboard) == pytest.approx(before + 1.0, abs=0.05))
    keyboard.open("movement 4:")
    keyboard.waits(lambda: clock(keyboard) > 3.0)
    before = clock(keyboard)
    keyboard.keys(Keys.SHIFT + Keys.TAB)
    keyboard.open("Replay")
    keyboard.waits(lambda: clock(keyboard) > before)
    keyboard.open("Above")


def clock(keyboard):
    return float(keyboard.find("//p[@role='status']").text.split()[0])


def test_a_live_robot_is_followed_while_its_page_is_drawn_anew(keyboard):
    keyboard.open("Robots")
    keyboard.sees(LIVE)
    keyboard.open(LIVE)
    keyboard.sees("motor 3 stuck", "nats for motor 3")
    keyboard.open("movement ")
    keyboard.sees("Replay: ")


def test_a_check_is_begun_and_stopped(keyboard):
    keyboard.open("Check")
    keyboard.sees("Seconds")
    keyboard.tab_to("Seconds")
    keyboard.keys(Keys.CONTROL + "a", "30")
    keyboard.open("Start the check")
    keyboard.sees("has begun")
    keyboard.open("STOP")
    keyboard.sees("stopped by ada; ")


def test_colours_and_units_are_chosen(keyboard):
    keyboard.tab_to("Angles in")
    keyboard.keys(Keys.ARROW_DOWN)
    keyboard.waits(
        lambda: keyboard.browser.get_cookie("unit") and keyboard.focus.startswith("Angles in")
    )
    assert keyboard.browser.get_cookie("unit")["value"] == "rad"


def test_a_log_can_be_chosen(keyboard):
    keyboard.open("Import a log")
    keyboard.sees("Drop a log here")
    keyboard.tab_to("Log file")


# The end: nothing went elsewhere; the server is killed and comes back.


def test_no_request_leaves_the_machine(person, server):
    hosts = set()
    for entry in person.browser.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            url = urllib.parse.urlsplit(message["params"]["request"]["url"])
            hosts.add(url.netloc if url.scheme not in ("data", "blob", "chrome", "about") else "")
    assert hosts - {""} == {f"127.0.0.1:{server.port}"}


def test_a_server_that_was_killed_shows_the_truth_again(person, server):
    person.go("/")
    person.sees(SICK)
    server.kill()
    person.sees("Connection lost.")
    server.start()
    person.sees("Password")  # sessions are held in memory alone
    person.sign_in("eve", PASSWORD)
    person.sees(SICK, "signed in as eve (see)")


def test_who_may_only_see_changes_nothing(person):
    person.go(f"/history?name={SICK}")
    person.sees("Timeline")
    assert not person.browser.find_elements("xpath", "//button[normalize-space()='Confirm']")
    person.go("/check")
    person.find("//button[normalize-space()='STOP']")
    assert "Start the check" not in person.text
