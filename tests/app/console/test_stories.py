"""What people do with the console, by what they see and click, in a real browser.

The stories are told in their order, on one server and in one browser.
"""

from __future__ import annotations

import json
import time
import urllib.parse
import urllib.request

import pytest

import failuretwin as ft
from console_server import PASSWORD

pytest.importorskip("selenium", reason="selenium is not installed")
from console_person import Person

TOOL_COLUMNS = """
[tool]
columns = ["a", "b", "c"]
unit = "m"
"""
SICK, LIVE, SILENT, DOUBTED = "hall_2-arm_7", "hall_1-arm_2", "hall_1-arm_3", "hall_2-arm_8"
TUESDAY = "//tr[td[normalize-space()='tuesday']]"


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


def test_a_silent_robot_is_stale_with_its_last_word(person):
    person.go("/")
    person.find(f"//a[strong[text()='{SILENT}'] and contains(@class, 'edge-stale')]")
    assert "last word: " in person.find(f"//a[strong[text()='{SILENT}']]").text


def test_a_fault_arrives_live(person):
    person.go("/")
    person.find(f"//a[strong[text()='{LIVE}'] and contains(@class, 'edge-alarm')]")
    person.press(f"//a[strong[text()='{LIVE}']]")
    person.sees("motor 3 stuck", "alarm number 1", "Probability over time", "nats for motor 3")
    person.find("//canvas")
    person.press("//a[starts-with(normalize-space(), 'movement ')]")
    person.sees("Replay: ", "Angles")


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


def test_a_check_is_run_and_stopped_while_the_page_hangs(person, server):
    person.go(f"/check?name={LIVE}")
    person.click("Start the check")
    person.sees(f"the check of {LIVE} has begun")
    session = person.browser.get_cookie("failuretwin_session")["value"]
    person.browser.execute_script(
        "setTimeout(() => { const end = Date.now() + 4000; while (Date.now() < end); }, 50)"
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
        time.sleep(1.0)
        checker = axe.Axe(person.browser)
        checker.inject()
        for one in checker.run()["violations"]:
            if one["impact"] in ("serious", "critical"):
                found[page, one["id"]] = [node["html"][:300] for node in one["nodes"][:3]]
    assert found == {}, found


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
