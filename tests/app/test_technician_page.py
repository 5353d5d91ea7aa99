"""The technician's page, read as HTML: what its card says, what is folded, how large it grows."""

from __future__ import annotations

import re
import struct
import zlib
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.app.reports.technician_page import (
    MOST_PICTURES,
    Mark,
    arm_sketch,
    chosen_runs,
    joint_places,
    resting_pose,
    write_page,
)
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, MovementEvidence, paper_hypotheses
from failuretwin.decision.robot_state import robot_state
from failuretwin.inference.explanation import worded

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

VOID = {"meta", "br", "img", "circle", "path", "polyline", "link"}


class Page(HTMLParser):
    """Text of a page: of the card, of what is folded, and of what is seen at once."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.seen, self.card = [], [], [], []
        self.tags, self.badges = [], []
        self.feed(text)
        if self.open:
            raise ValueError(f"not closed: {self.open}")

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append((tag, dict(attrs)))

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self.open or self.open.pop()[0] != tag:
            raise ValueError(f"</{tag}> closes nothing that is open")

    def handle_data(self, data):
        inside = [tag for tag, _ in self.open]
        if "style" in inside or not data.strip():
            return
        self.words.append(data)
        if "details" not in inside or "summary" in inside:
            self.seen.append(data)
        if any(attrs.get("id") == "state" for _, attrs in self.open):
            self.card.append(data)

    def text(self, part):
        return " ".join(" ".join(part).split())


def synthetic(robot, name, hypothesis, chance, movements=5, **fields):
    """Return a diagnosis of such probability; the rest goes to healthy, or to motor 1 stuck."""
    classes = [str(h) for h in paper_hypotheses(robot.motor_names)]
    other = "healthy" if hypothesis != "healthy" else f"{robot.motor_names[0]}:stuck"
    posterior = dict.fromkeys(classes, 0.0) | {hypothesis: chance, other: 1.0 - chance}
    nats = np.log(chance / max(1.0 - chance, 1e-9)) / 2.0
    evidence = tuple(MovementEvidence(m + 1, float(nats)) for m in range(movements))
    found = Diagnosis(name, posterior, evidence=evidence, method="synthetic", **fields)
    return worded(found, [*map(Hypothesis.parse, found.ranked)])


def page_of(diagnoses, robot, folder, **options):
    path = folder / "index.html"
    write_page(diagnoses, robot_state(diagnoses, robot), robot, path, **options)
    return Page(path.read_text("utf-8")), path.stat().st_size


@pytest.mark.parametrize(
    ("robot", "at_87", "at_99"),
    [
        ("armpi_fpv", "Record again, with motor 2 moving", "Replace the servo"),
        ("so101", "Record again, with motor 2 (shoulder lift) moving", "Replace the servo"),
        ("ur5e", "Record again, with motor 2 (shoulder lift) moving", "holding brake"),
    ],
)
def test_the_next_step_is_as_sure_as_the_diagnosis(robot, at_87, at_99, tmp_path):
    robot = load_robot(robot)
    unsure, _ = page_of([synthetic(robot, "a", "motor_2:stuck", 0.87)], robot, tmp_path)
    card = unsure.text(unsure.card)
    assert at_87 in card
    assert "likely, but not sure (87 %)" in card
    assert "cannot tell" in card
    assert "replace" not in unsure.text(unsure.words).lower()
    sure, _ = page_of([synthetic(robot, "a", "motor_2:stuck", 0.99)], robot, tmp_path)
    card = sure.text(sure.card)
    assert at_99 in card
    assert "Record again" not in card
    assert "sure (99 %)" in card
    assert "faulty" in card
    assert robot.motors[1].joint in card


def test_one_movement_alone_is_recorded_again_however_sure(tmp_path):
    robot = load_robot("armpi_fpv")
    found = synthetic(robot, "a", "motor_2:stuck", 0.995, movements=1)
    page, _ = page_of([found], robot, tmp_path)
    assert "One movement alone shows it: record again" in page.text(page.card)
    assert "Replace the servo" not in page.text(page.words)


def test_the_page_says_what_the_command_line_says(tmp_path):
    robot = load_robot("armpi_fpv")
    for hypothesis, chance in (("motor_3:steady_state_error", 0.99), ("motor_1:stuck", 0.7)):
        found = synthetic(robot, "a", hypothesis, chance)
        step = found.explanation[-1].removeprefix("what to do: ")
        assert step != found.explanation[-1]
        page, _ = page_of([found], robot, tmp_path)
        assert f"Next step: {step}" in page.text(page.card)


def test_a_healthy_robot_has_no_marked_motor_and_nothing_to_do(tmp_path):
    robot = load_robot("so101")
    runs = [synthetic(robot, f"run {i}", "healthy", 0.98) for i in range(3)]
    page, _ = page_of(runs, robot, tmp_path)
    card = page.text(page.card)
    assert "Nothing to do now" in card
    assert "Motor:" not in card
    assert any("no joint marked" in attrs.get("alt", "") for _, attrs in page.tags)


def test_states_differ_in_shape_and_word_as_well_as_in_colour(tmp_path):
    robot = load_robot("armpi_fpv")
    runs = [
        synthetic(robot, "a", "healthy", 0.98),
        synthetic(robot, "b", "motor_2:stuck", 0.99),
        synthetic(robot, "c", "motor_3:stuck", 0.6),
    ]
    write_page(runs, robot_state(runs, robot), robot, tmp_path / "index.html")
    text = (tmp_path / "index.html").read_text("utf-8")
    badges = set(re.findall(r'<span class="badge ([\w-]+)"><svg[^>]*>(<\w+ [^>]*>)', text))
    assert {kind for kind, _ in badges} == {"healthy", "faulty", "cannot-tell"}
    assert len({shape for _, shape in badges}) == 3
    for kind in ("healthy", "faulty", "cannot tell"):
        assert f"</svg>{kind}</span>" in text


def test_nats_and_methods_are_folded(tmp_path):
    robot = load_robot("armpi_fpv")
    runs = [synthetic(robot, f"run {i}", "motor_2:stuck", 0.99, truth="healthy") for i in range(2)]
    page, _ = page_of(runs, robot, tmp_path)
    assert "nats" in page.text(page.words)
    assert "nats" not in page.text(page.seen)
    assert "Protocol" not in page.text(page.seen)
    assert not any("open" in attrs for tag, attrs in page.tags if tag == "details")
    assert ("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}) in (
        page.tags
    )


def noise_png(path, size=360):
    """Write a picture that does not compress, as large as those of runs are."""
    rows = np.random.default_rng(0).integers(0, 256, (size, size), dtype=np.uint8)
    raw = b"".join(b"\x00" + row.tobytes() for row in rows)

    def chunk(kind, data):
        checked = kind + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    head = struct.pack(">IIBBBBB", size, size, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    return path


def pictures_of_runs(page):
    return sum(tag == "img" and attrs.get("class") != "arm" for tag, attrs in page.tags)


def test_900_runs_make_a_page_that_opens(tmp_path):
    robot = load_robot("armpi_fpv")
    classes = [str(h) for h in paper_hypotheses(robot.motor_names)]
    runs = [
        synthetic(robot, f"session_{i:04d}/trajectory_monitoring", classes[i % 9], 0.97)
        for i in range(900)
    ]
    picture = noise_png(tmp_path / "picture.png")
    assert picture.stat().st_size > 120_000
    chosen = chosen_runs(runs, robot, MOST_PICTURES)
    page, size = page_of(runs, robot, tmp_path, pictures=dict.fromkeys(chosen, picture))
    assert size < 5_000_000
    text = page.text(page.words)
    assert all(run.run in text for run in runs)
    shown = pictures_of_runs(page)
    assert 9 <= shown <= MOST_PICTURES
    assert {runs[i].diagnosis.split(":")[0] for i in chosen} == {"healthy", *robot.motor_names}
    assert "Different states in different runs" in page.text(page.card)


def test_every_state_is_among_the_runs_that_are_shown():
    robot = load_robot("armpi_fpv")
    faulty = [f"{motor}:stuck" for motor in robot.motor_names]
    wrong = [synthetic(robot, f"w{i}", faulty[i % 4], 0.6, truth="healthy") for i in range(40)]
    wrong += [synthetic(robot, f"v{i}", faulty[i % 4], 0.99, truth="healthy") for i in range(40)]
    right = [synthetic(robot, "h", "healthy", 0.99, truth="healthy")]
    right += [synthetic(robot, name, name, 0.99, truth=name) for name in faulty]
    right += [synthetic(robot, "o", "motor_1:stuck", 0.8, truth="motor_1:stuck")]
    chosen = chosen_runs([*wrong, *right], robot, 6)
    assert chosen == list(range(80, 86))
    assert len(chosen_runs([*wrong, *right], robot, MOST_PICTURES)) == MOST_PICTURES


def test_pictures_are_left_out_before_the_page_grows_too_large(tmp_path):
    robot = load_robot("armpi_fpv")
    runs = [synthetic(robot, f"run {i}", "motor_2:stuck", 0.99) for i in range(MOST_PICTURES)]
    picture = noise_png(tmp_path / "large.png", 900)
    page, size = page_of(runs, robot, tmp_path, pictures=dict.fromkeys(range(len(runs)), picture))
    assert size < 5_000_000
    assert 0 < pictures_of_runs(page) < MOST_PICTURES


def test_names_of_runs_are_text(tmp_path):
    robot = load_robot("armpi_fpv")
    page, _ = page_of([synthetic(robot, "<b>&run", "healthy", 0.99)], robot, tmp_path)
    assert "<b>&run" in page.text(page.words)


# The sketch.


@pytest.mark.parametrize("name", ["armpi_fpv", "so101", "ur5e", "panda"])
def test_places_are_those_of_the_kinematics(name):
    robot = load_robot(name)
    pose = resting_pose(robot)
    places = joint_places(robot.loads.chain, pose)
    assert places.shape == (len(robot.motors) + 2, 3)
    np.testing.assert_allclose(places[-1], robot.loads.chain.position(pose), atol=1e-9)
    _, jacobian = robot.loads.chain.position_and_jacobian(pose)
    arms = places[-1] - places[1:-1]
    for k in np.flatnonzero(~robot.slides):  # dp/dq_k = axis x arm, at right angles to the arm
        assert abs(jacobian[:, k] @ arms[k]) < 1e-9


def test_the_marked_joint_is_larger_and_named():
    robot = load_robot("ur5e")
    (panel,) = arm_sketch(robot, {"motor_3": Mark("#c8402f", "!", "elbow <joint>")}).axes
    assert {"!", "elbow <joint>"} <= {text.get_text() for text in panel.texts}
    dots = [line for line in panel.lines if line.get_marker() == "o"]
    (marked,) = [dot for dot in dots if dot.get_color() == "#c8402f"]
    assert len(dots) == len(robot.motors)
    assert all(marked.get_markersize() > 2 * dot.get_markersize() for dot in dots if dot != marked)
    points = panel.lines[0].get_xydata()
    np.testing.assert_allclose(points[3], marked.get_xydata()[0])
    ratio = [np.linalg.norm(b - a) for a, b in pairwise(points[2:5])]
    assert ratio[0] / ratio[1] == pytest.approx(0.425 / 0.392, rel=0.02)  # links of the maker
