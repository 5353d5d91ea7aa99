"""The technician's page in a real browser without a window, as wide as a phone and as a desk."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess

import pytest

from failuretwin import load_robot
from failuretwin.app.reports.technician_page import write_page
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.decision.robot_state import robot_state
from failuretwin.inference.explanation import worded

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
BROWSER = os.environ.get("FAILURETWIN_BROWSER") or next(filter(None, map(shutil.which, NAMES)), "")
PHONE, DESK = 360, 1200
"""Widths [px]. A window of the browser is no narrower than 500 px: pages are laid in a frame."""
MEASURE = """<script>
const at = id => document.querySelector(id).getBoundingClientRect();
const [words, arm] = document.querySelectorAll('#state > div');
const place = [words, arm].map(part => part.getBoundingClientRect());
const folded = [...document.querySelectorAll('details')].every(one => !one.open);
document.title = JSON.stringify({
  wide: document.documentElement.scrollWidth, inner: window.innerWidth,
  below: place[1].top >= place[0].bottom, beside: place[1].left >= place[0].right,
  step: at('.step').bottom, size: parseFloat(getComputedStyle(document.body).fontSize),
  arm: at('img.arm').height, folded: folded});
parent.postMessage(document.title, '*');
</script>"""
FRAME = """<!doctype html><pre id="found"></pre>
<script>
onmessage = event => { document.getElementById('found').textContent = event.data; };
</script>
<iframe src="page.html" style="width:{width}px;height:900px;border:0"></iframe>"""

pytestmark = pytest.mark.skipif(
    not BROWSER, reason=f"no browser: none of {', '.join(NAMES)} is installed, and "
    "FAILURETWIN_BROWSER names none"
)  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page of twelve runs with a faulty motor, which also measures itself."""
    robot, runs = load_robot("ur5e"), []
    for i in range(12):
        posterior = {"motor_2:stuck": 0.99, "healthy": 0.01}
        found = Diagnosis(f"a_session_of_a_long_name_{i:04d}/trajectory", posterior, method="test")
        runs.append(worded(found, [*map(Hypothesis.parse, found.ranked)]))
    folder = tmp_path_factory.mktemp("page")
    write_page(runs, robot_state(runs, robot), robot, folder / "page.html")
    text = (folder / "page.html").read_text("utf-8")
    (folder / "page.html").write_text(text.replace("</body>", f"{MEASURE}</body>"), "utf-8")
    return folder


def opened(folder, width):
    """Return what the browser measures of the page in a frame of this width."""
    frame = folder / "frame.html"
    frame.write_text(FRAME.replace("{width}", str(width)), "utf-8")
    done = subprocess.run(
        [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000",
         f"--user-data-dir={folder / 'profile'}", "--window-size=1400,1000", "--dump-dom",
         frame.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    found = re.search(r'<pre id="found">(\{.*?\})</pre>', done.stdout)
    assert found, done.stdout + done.stderr
    return json.loads(found[1])


def test_a_phone_shows_one_column_and_no_sideways_scrolling(page):
    seen = opened(page, PHONE)
    assert seen["inner"] == PHONE
    assert seen["wide"] <= PHONE
    assert seen["below"]
    assert not seen["beside"]
    assert seen["step"] < 900, "the next step is not on the first screen"
    assert seen["size"] >= 16
    assert seen["folded"]


def test_a_desk_shows_the_arm_beside_the_words(page):
    seen = opened(page, DESK)
    assert seen["beside"]
    assert not seen["below"]
    assert seen["arm"] > 150
