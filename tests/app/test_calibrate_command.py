from __future__ import annotations

import base64
import json
import os
import re
from contextlib import suppress
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from calibration_files import read_calibration
from failuretwin import load_robot
from failuretwin.app.reports.calibration_report import (
    figure,
    left_out_line,
    parameter_table,
    verdict_line,
)
from failuretwin.connection.calibration.result import (
    Calibration,
    HeldOut,
    LeftOut,
    Parameter,
    mean_gain,
    save_calibration,
)
from failuretwin.core.errors import OutputError
from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
from failuretwin.data_knowledge.store import save_run_set
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration

COUNT = np.deg2rad(0.24)
REPORT = "report"


@pytest.fixture(scope="module")
def learned(failuretwin, data, tmp_path_factory):
    """A calibration from one real session, judged on another, with its page."""
    folder = tmp_path_factory.mktemp("learned")
    logs = [data / "real_robot_b_20241003" / label for label in ("label_0", "label_1")]
    answer = failuretwin(
        "calibrate",
        *logs,
        *("--hold-out", "label_1", "--out", "twin.toml", "--report", REPORT),
        folder=folder,
    )
    assert answer.returncode == 0, answer.stderr
    return folder, answer.stdout


def held_out(gain, error, movements=30):
    return HeldOut("day", movements, (0.01,) * 4, (0.005,) * 4, gain, error)


@pytest.fixture
def small(armpi):
    """A calibration made by hand."""
    generic = generic_imperfections(armpi)
    settling = replace(generic.settling, compliance=(0.0, 0.14, 0.17, 0.19))
    return Calibration(
        imperfections=replace(generic, name="small", source="made up", settling=settling),
        parameters=(
            Parameter("bias", "motor_1", "rad", 2.0 * COUNT, COUNT, 3.0 * COUNT),
            Parameter("bias", "motor_2", "rad", 0.0, -1.0, 1.0, False, "the logs do not say"),
            Parameter("lost commands", "motor_1", "share", 0.02, 0.0, 0.04),
            Parameter("lag", "", "s", 0.031, 0.028, 0.034),
            Parameter("lost commands", "motor_1+motor_2", "share", 0.01, 0.0, 0.03),
        ),
        sessions=("day_0",),
        runs=4,
        movements=20,
        used_readings=True,
    )


# Learning


def test_a_real_robot_is_learned(learned, armpi):
    folder, told = learned
    found = read_calibration(folder / "twin.toml", armpi)
    assert found.sessions == ("20241003_220728_label_0",)
    assert [entry.session for entry in found.held_out] == ["20241003_222107_label_1"]
    assert found.used_readings
    assert found.runs == 10
    settling = found.imperfections.settling
    # Least squares by hand over five sessions, in raw counts: friction 1.54 1.01 2.49 2.64; the
    # scatter of a Student t is smaller than the standard deviation of what is left.
    np.testing.assert_allclose(np.divide(settling.friction, COUNT), [1.5, 1.0, 2.5, 2.6], atol=1.0)
    assert np.all(np.divide(settling.scatter, COUNT) < [1.8, 1.8, 1.8, 1.2])
    assert "on unseen sessions the calibrated twin beats the uncalibrated one" in told
    (row,) = [line for line in told.splitlines() if line.startswith("compliance, motor_1")]
    assert "not identified: gravity does not load this motor" in row
    (judged,) = found.held_out
    assert np.all(np.divide(judged.after, COUNT) <= [1.6, 1.9, 2.0, 1.2])
    assert np.all(np.array(judged.after) < judged.before)


def test_diagnose_uses_it(learned, failuretwin, data):
    folder, _ = learned
    session = data / "real_robot_b_20241003" / "label_6"
    answer = failuretwin(
        *("diagnose", session, "--calibration", folder / "twin.toml", "--json", "out.jsonl"),
        folder=folder,
    )
    assert answer.returncode == 0, answer.stderr
    records = [json.loads(line) for line in (folder / "out.jsonl").read_text().splitlines()]
    assert len(records) == 10
    assert sum("twin" in record["method"] for record in records) >= 8
    right = [record["diagnosis"] == "motor_2:steady_state_error" for record in records]
    assert sum(right) >= 8


def test_a_faulty_session_among_healthy_ones_is_left_out(failuretwin, data, armpi, tmp_path):
    labels = ("label_0", "label_1", "label_2", "label_6")
    logs = [data / "real_robot_b_20241003" / label for label in labels]
    some = read_runs(logs, armpi, ReadOptions()).isel(run=slice(None, None, 4))
    save_run_set(some, tmp_path / "logs.nc")
    answer = failuretwin("calibrate", "logs.nc", "--out", "twin.toml", folder=tmp_path)
    assert answer.returncode == 0, answer.stderr
    found = read_calibration(tmp_path / "twin.toml", armpi)
    runs = [entry.run for entry in found.left_out if entry.movement == 0]
    assert len(runs) >= 2
    assert all("label_6" in run for run in runs)


# The page


class Page(HTMLParser):
    """What a page shows and what it loads."""

    def __init__(self, text):
        super().__init__()
        self.open, self.unpaired, self.loaded, self.words = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "col", "link", "br"):
            self.open.append(tag)
        self.loaded += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        if self.open.pop() != tag:
            self.unpaired.append(tag)

    def handle_data(self, text):
        self.words += text.split()


def test_the_report_is_one_page_that_needs_nothing_else(learned, listing):
    folder, _ = learned
    assert listing(folder / REPORT) == ["index.html"]
    text = (folder / REPORT / "index.html").read_text()
    page = Page(text)
    assert page.open == page.unpaired == []
    assert len(page.loaded) == 1
    for source in page.loaded:
        kind, _, data = source.partition(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data, validate=True).startswith(b"\x89PNG\r\n")
    assert re.search(r"url\(|@import|<script|https?:", text) is None


def test_the_page_says_what_an_engineer_asks(learned, armpi):
    folder, _ = learned
    words = " ".join(Page((folder / REPORT / "index.html").read_text()).words)
    found = read_calibration(folder / "twin.toml", armpi)
    assert "On unseen sessions the calibrated twin beats the uncalibrated one" in words
    assert found.imperfections.source in words
    assert "20241003_222107_label_1" in words
    assert f"{found.movements} settled movements of 10 runs, by the motors' own readings" in words
    assert "not identified: gravity does not load this motor" in words
    assert left_out_line(found) in words
    for entry in found.left_out:
        assert f"{entry.run} {entry.movement}" in words
    friction = found.imperfections.settling.friction[0] / COUNT
    assert f"{friction:.2f}" in words


def test_the_page_works_with_the_tool_path_alone(failuretwin, data, armpi, tmp_path):
    """And without the runs that are labelled faulty."""
    logs = [data / "real_robot_b_20241003" / label for label in ("label_0", "label_3")]
    labelled = ReadOptions("measured", published_labels=True)
    runs = read_runs(logs, armpi, labelled).drop_vars("position").isel(run=slice(None, None, 3))
    save_run_set(runs, tmp_path / "tool.nc")
    answer = failuretwin(
        *("calibrate", "tool.nc", "--out", "twin.toml", "--report", REPORT), folder=tmp_path
    )
    assert answer.returncode == 0, answer.stderr
    assert "3 runs: labelled motor_3:stuck" in answer.stdout
    assert "not checked on unseen logs" in answer.stdout
    page = Page((tmp_path / REPORT / "index.html").read_text())
    words = " ".join(page.words)
    assert "by the tool path alone" in words
    assert "Not checked on unseen logs" in words
    assert "there is no other session" in words
    assert len(page.loaded) == 1


def test_parameters_are_told_in_counts(small, armpi):
    assert parameter_table(small.parameters, armpi).rows == [
        ("bias, motor_1", "2.0", "1.0 to 3.0", "counts", ""),
        ("bias, motor_2", "0", "-239 to 239", "counts", "not identified: the logs do not say"),
        ("lost commands, motor_1", "2.0", "0.0 to 4.0", "%", ""),
        ("lag", "31.0", "28.0 to 34.0", "ms", ""),
        ("lost commands, motor_1+motor_2", "1.0", "0.0 to 3.0", "%", ""),
    ]


@pytest.mark.parametrize("robot", ["ur5e", None])
def test_motors_without_counts_are_told_in_degrees(small, robot):
    first = parameter_table(small.parameters, robot and load_robot(robot)).rows[0]
    assert first == ("bias, motor_1", "0.48", "0.24 to 0.72", "deg", "")


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (32.7812, 3.1, "32.8"),
        (32.7812, 300.0, "33"),
        (0.00351, 0.018, "0.0035"),
        (-0.0, 1.0, "0.00"),
        (5.123456, 0.0, "5.12"),
    ],
)
def test_figures_have_as_many_digits_as_are_known(value, width, text):
    assert figure(value, width) == text


# What is said of it


def test_sessions_count_by_their_movements():
    gain, half = mean_gain((held_out(1.0, 0.1, 30), held_out(2.0, 0.2, 10)))
    assert gain == pytest.approx(1.25)
    assert half == pytest.approx(1.96 * np.hypot(0.75 * 0.1, 0.25 * 0.2))


def test_a_fit_that_does_not_beat_none_is_said_to_be_so(small):
    assert "does NOT beat" in verdict_line(replace(small, held_out=(held_out(0.1, 0.1),)))
    assert "does NOT beat" in verdict_line(replace(small, held_out=(held_out(-1.0, 0.1),)))
    assert " beats " in verdict_line(replace(small, held_out=(held_out(1.0, 0.1),)))
    assert "not checked" in verdict_line(small)


def test_what_was_left_out_is_counted(small):
    entries = (
        LeftOut("a", 1, "motor_1", "did not get its command"),
        LeftOut("b", 3, "motor_1", "did not get its command"),
        LeftOut("c", 0, "", "looks faulty"),
    )
    told = left_out_line(replace(small, left_out=entries))
    assert told == "2 movements: motor_1 did not get its command; 1 run: looks faulty"


# Refusals


def test_faulty_sessions_are_refused(failuretwin, data, tmp_path, listing):
    log = data / "real_robot_b_20241003" / "label_7"
    answer = failuretwin(
        "calibrate", log, "--out", "twin.toml", "--report", REPORT, folder=tmp_path
    )
    assert answer.returncode == 2
    reasons = ("error: motor_3 misses its targets", "runs look faulty")
    assert any(reason in answer.stderr for reason in reasons)
    assert "give logs of a healthy robot" in answer.stderr.lower()
    assert listing(tmp_path) == []


def test_too_many_suspects_among_healthy_runs_are_refused(
    failuretwin, data, armpi, tmp_path, listing
):
    logs = [data / "real_robot_b_20241003" / label for label in ("label_0", "label_1", "label_7")]
    save_run_set(
        read_runs(logs, armpi, ReadOptions()).isel(run=slice(None, None, 3)), tmp_path / "logs.nc"
    )
    answer = failuretwin("calibrate", "logs.nc", "--out", "twin.toml", folder=tmp_path)
    assert answer.returncode == 2
    found = re.search(r"error: (\d+) of 10 runs look faulty \((.*)\)", answer.stderr)
    assert 2 <= int(found.group(1)) <= 3
    assert all("label_7" in run for run in found.group(2).split(", "))
    assert listing(tmp_path) == ["logs.nc"]


def test_logs_labelled_faulty_are_refused(failuretwin, data, tmp_path, listing):
    log = data / "real_robot_b_20241003" / "label_2"
    answer = failuretwin(
        "calibrate", log, "--published-labels", "--out", "twin.toml", folder=tmp_path
    )
    assert answer.returncode == 2
    assert "every run is labelled faulty. Expected healthy logs" in answer.stderr
    assert listing(tmp_path) == []


@pytest.fixture(scope="module")
def two_days(write_session, tmp_path_factory):
    folder = tmp_path_factory.mktemp("days")
    for day in range(2):
        write_session(folder / f"day_{day}", seed=day)
    return folder


def refused(answer, *texts):
    assert answer.returncode == 2
    assert answer.stdout == ""
    assert answer.stderr.startswith("error: ")
    assert answer.stderr.count("\n") == 1
    for text in texts:
        assert text in answer.stderr


def test_too_short_logs_are_refused(failuretwin, two_days, tmp_path, listing):
    answer = failuretwin("calibrate", two_days / "day_0", "--out", tmp_path / "twin.toml")
    refused(answer, "only 5 of 5 movements", "expected 6 at least", "Give longer logs")
    assert listing(tmp_path) == []


def test_an_unknown_session_to_hold_out_is_refused(failuretwin, two_days, tmp_path):
    answer = failuretwin(
        "calibrate", two_days, "--hold-out", "Monday", "--out", tmp_path / "twin.toml"
    )
    refused(answer, "--hold-out 'Monday' is in no session's name", "day_0, day_1")
    answer = failuretwin(
        "calibrate", two_days, "--hold-out", "day", "--out", tmp_path / "twin.toml"
    )
    refused(answer, "--hold-out 'day' leaves nothing to learn from")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("twin.json", "twin.json: a calibration ends in .toml"),
        ("nowhere/twin.toml", "does not exist. Make it first"),
        ("folder.toml", "is a folder. Give the name of a file"),
    ],
)
def test_a_bad_destination_is_refused_before_any_work(failuretwin, tmp_path, name, text):
    (tmp_path / "folder.toml").mkdir()
    answer = failuretwin("calibrate", tmp_path / "no_log", "--out", name, folder=tmp_path)
    refused(answer, text)


@pytest.mark.parametrize(
    ("robot", "name", "text"),
    [
        (
            "ur5e",
            "twin",
            "calibration 'twin' of robot 'ur5e', expected 'twin' of 'armpi_fpv'",
        ),
        ("armpi_fpv", "robot B", "calibration 'robot B' of robot 'armpi_fpv', expected 'twin' of"),
    ],
)
def test_the_calibration_of_another_robot_is_not_replaced(
    failuretwin, two_days, small, armpi, tmp_path, robot, name, text
):
    path = tmp_path / "twin.toml"
    named = replace(small, imperfections=replace(small.imperfections, name=name))
    save_calibration(named, replace(armpi, profile=replace(armpi.profile, name=robot)), path)
    before = path.read_bytes()
    answer = failuretwin("calibrate", two_days, "--out", path)
    refused(answer, text, "Choose another --out; if it is the same robot, remove the file first")
    assert path.read_bytes() == before


def test_a_file_that_is_no_calibration_is_not_replaced(failuretwin, two_days, tmp_path):
    path = tmp_path / "topics.toml"
    path.write_text('command = "/command"\n')
    refused(failuretwin("calibrate", two_days, "--out", path), "expected 'topics' of 'armpi_fpv'")
    assert path.read_text() == 'command = "/command"\n'


def test_a_robot_is_calibrated_again(failuretwin, two_days, small, armpi, tmp_path):
    path = tmp_path / "twin.toml"
    named = replace(small, imperfections=replace(small.imperfections, name="twin"))
    save_calibration(replace(named, runs=99), armpi, path)
    answer = failuretwin("calibrate", two_days, "--out", path)
    assert answer.returncode == 0, answer.stderr
    assert read_calibration(path, armpi).runs < 99
    assert f"use it with `failuretwin diagnose LOG --calibration {path}`" in answer.stdout


def test_a_robot_has_its_own_calibration(failuretwin, learned, two_days, small, armpi, tmp_path):
    path = tmp_path / "small.toml"
    other = replace(armpi, profile=replace(armpi.profile, name="armpi_two"))
    save_calibration(small, other, path)
    answer = failuretwin("diagnose", two_days, "--calibration", path)
    refused(answer, "is a calibration of robot 'armpi_two', not of 'armpi_fpv'", "--robot")


def test_imperfections_typed_by_hand_are_used(armpi, tmp_path):
    path = tmp_path / "typed.toml"
    path.write_text('name = "typed"\nsource = "by hand"\n')
    assert load_calibration(path, armpi).imperfections.name == "typed"


# The file


def test_a_file_holds_what_was_learned_and_is_read_as_imperfections(small, armpi, tmp_path):
    entries = (LeftOut("a", 1, "motor_1", "did not get its command"),)
    full = replace(small, held_out=(held_out(1.0, 0.1),), left_out=entries, remarks=("a remark",))
    save_calibration(full, armpi, tmp_path / "twin.toml")
    found = read_calibration(tmp_path / "twin.toml", armpi)
    for before, after in zip(full.parameters, found.parameters, strict=True):
        assert after.value == pytest.approx(before.value, rel=1e-5)
        assert replace(after, value=0.0, low=0.0, high=0.0) == replace(
            before, value=0.0, low=0.0, high=0.0
        )
    assert replace(found, parameters=()) == replace(full, parameters=())
    assert load_calibration(tmp_path / "twin.toml", armpi) == found.applied_to(armpi)


def test_a_write_that_dies_leaves_the_old_file(small, armpi, tmp_path, listing, monkeypatch):
    path = tmp_path / "twin.toml"
    save_calibration(small, armpi, path)
    before = path.read_bytes()

    def half(self, text, encoding):
        with self.open("w", encoding=encoding) as file:
            file.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OutputError, match="No space left on device"):
        save_calibration(replace(small, runs=99), armpi, path)
    assert path.read_bytes() == before
    assert listing(tmp_path) == ["twin.toml"]


def test_a_process_killed_while_writing_leaves_the_old_file(small, armpi, tmp_path):
    path = tmp_path / "twin.toml"
    save_calibration(small, armpi, path)
    before = path.read_bytes()
    child = os.fork()
    if child == 0:
        write = Path.write_text

        def die(self, text, encoding):
            write(self, text[: len(text) // 2], encoding)
            os._exit(9)

        Path.write_text = die
        with suppress(BaseException):  # the child must not go on as a second test run
            save_calibration(replace(small, runs=99), armpi, path)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert path.read_bytes() == before
    assert read_calibration(path, armpi).runs == 4


def test_a_full_disk_leaves_the_old_file(failuretwin, two_days, small, armpi, tmp_path, listing):
    path = tmp_path / "twin.toml"
    save_calibration(small, armpi, path)
    before = path.read_bytes()
    named = ("--name", small.imperfections.name)
    answer = failuretwin("calibrate", two_days, "--out", path, *named, disk_full=True)
    refused(answer, "could not be written")
    assert path.read_bytes() == before
    assert listing(tmp_path) == ["twin.toml"]
