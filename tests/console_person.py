"""Somebody at the browser, who reads, clicks and types."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from selenium.common.exceptions import WebDriverException
from selenium.webdriver.common.keys import Keys

from console_server import PICTURES

LONGEST_S = 500.0
"""Longest wait [s]: ends what hangs, not what is slow."""
LOOK_S = 0.25
"""Time between two looks at a page [s]: each makes the browser work."""


class Person:
    """Somebody at the browser."""

    def __init__(self, browser, url):
        self.browser, self.url = browser, url

    def go(self, page):
        self.browser.get(self.url + page)

    def find(self, xpath):
        """Return what is found, once it is there."""
        deadline = time.monotonic() + LONGEST_S
        while not (found := self.browser.find_elements("xpath", xpath)):
            assert time.monotonic() < deadline, f"{xpath} is not there: {self.text[:2000]}"
            time.sleep(LOOK_S)
        return found[0]

    def click(self, words):
        """Click a link or button with some words."""
        said = f"[normalize-space()='{words}' or @aria-label='{words}']"
        self.press(f"//a{said}|//button{said}")

    def press(self, xpath):
        """Click what is found; where it is drawn anew meanwhile, click the new one."""

        def clicked():
            target = self.find(xpath)
            self.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", target)
            target.click()
            return True

        self.waits(clicked)

    def write(self, label, words):
        field = self.find(f"//input[@aria-label='{label}' or @name='{label}']")
        field.send_keys(Keys.CONTROL + "a")
        field.send_keys(words)

    @property
    def text(self):
        return self.browser.find_element("tag name", "body").text

    def sees(self, *words):
        """Wait until words are there."""

        def seen():
            text = self.text
            return all(one in text for one in words)

        self.waits(seen, words)

    def waits(self, truth, words=""):
        """Wait until something holds; a page may be drawn anew meanwhile."""
        deadline = time.monotonic() + LONGEST_S
        while True:
            with suppress(WebDriverException):
                if truth():
                    return
            assert time.monotonic() < deadline, f"{words} in vain: {self.text[:2000]}"
            time.sleep(LOOK_S)

    def sign_in(self, name, password):
        self.go("/login")
        self.write("name", name)
        self.write("password", password)
        self.click("Sign in")

    def picture(self, name):
        if PICTURES:
            time.sleep(1.0)
            self.browser.save_screenshot(str(Path(PICTURES) / f"{name}.png"))
