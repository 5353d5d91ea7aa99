"""Time zone, units, print, phones and colours, as the browser shows them."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
from console_person import Person
from console_server import PASSWORD

SICK, LIVE = "hall_2-arm_7", "hall_1-arm_2"
TUESDAY = "//tr[td[normalize-space()='tuesday']]"
PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
CONTRAST = {"runOnly": {"type": "rule", "values": ["color-contrast"]}}
WIDTH = "return document.documentElement.scrollWidth"


@pytest.fixture(scope="module")
def person(browser, server):
    found = Person(browser, server.url)
    found.sign_in("ada", PASSWORD)
    found.sees(SICK)
    yield found
    tell(found, "setEmulatedMedia", media="", features=[])
    tell(found, "clearDeviceMetricsOverride")


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
    pages = ("/", f"/robot?{named}", f"/history?{named}", replay, "/check")
    for page in pages:
        person.go(page)
        person.find("//main//h1")
        time.sleep(1.0)
        checker = axe.Axe(person.browser)
        checker.inject()
        wrong = checker.run(options=CONTRAST)["violations"]
        found += [(page, node["html"][:200]) for one in wrong for node in one["nodes"]]
    person.browser.delete_cookie("theme")
    assert found == []
