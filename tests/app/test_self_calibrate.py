"""`failuretwin diagnose --self-calibrate`: runs that are judged together."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import pytest
from click.testing import CliRunner

from calibration_files import read_calibration
from failuretwin.app.cli import cli
from failuretwin.connection.calibration.result import save_calibration
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.settling import Settling

TRUTHS = ["healthy", "motor_2:stuck", "motor_3:steady_state_error"]
ROBOT = Settling(
    (0.0, 0.02, 0.0, 0.0), (0.0, 0.09, 0.14, 0.35), (0.007,) * 4, (0.006,) * 4, 5.0, "made up"
)


AMONG = ("--hypotheses", ",".join(TRUTHS))
"""Where what is learned does not depend on what else is offered."""


def diagnose(*arguments):
    given = ["diagnose", *(str(argument) for argument in arguments)]
    return CliRunner().invoke(cli, given, catch_exceptions=False, standalone_mode=False)


@pytest.fixture(scope="module")
def runs(armpi, tmp_path_factory):
    """Runs of a robot whose motor 2 is 0.02 rad off for good."""
    path = tmp_path_factory.mktemp("runs") / "runs.nc"
    known = Imperfections("made up", "test", settling=ROBOT)
    save_run_set(simulate(Plan(armpi, TRUTHS, 2, 4, known)), path)
    return path


def records(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def together(runs, tmp_path_factory):
    """What is said and written of the runs when they are judged together."""
    folder = tmp_path_factory.mktemp("together")
    written = ("--out", folder / "own.toml", "--json", folder / "out.jsonl")
    tables = ("--csv", folder / "out.csv", "--report", folder / "page")
    return diagnose(runs, "--self-calibrate", *written, *tables), folder


def test_runs_are_judged_together_and_the_robot_is_kept(together, runs, armpi, tmp_path):
    answer, folder = together
    out, file = folder / "own.toml", tmp_path / "out.jsonl"
    found = records(folder / "out.jsonl")
    assert [r["diagnosis"] for r in found] == [name for name in TRUTHS for _ in range(2)]
    assert {r["protocol"] for r in found} == {"P1"}
    learned = read_calibration(out, armpi)
    bias, doubt = learned.imperfections.settling.bias[1], learned.imperfections.variation.bias[1]
    assert abs(bias - 0.02) < 3.0 * doubt < 0.01  # three deviations off its class: pulled there
    told = [line for line in answer.output.splitlines() if line.startswith("self-calibrated: ")]
    assert [line.removeprefix("self-calibrated: ") for line in told] == list(learned.remarks)
    assert "6 of 6 runs right" in answer.output
    # The file is a calibration like any other, and may be learned from again.
    diagnose(runs, "--self-calibrate", "--calibration", out, "--json", file, *AMONG)
    assert {r["protocol"] for r in records(file)} == {"P1"}


def test_the_page_tells_what_was_learned_of_the_robot(together, armpi):
    """Sentences, every offset beside such robots, every run; the motor that is off stands out."""
    _, folder = together
    page = (folder / "page" / "index.html").read_text()
    section = page[page.index("What the runs taught") : page.index("<h2>Runs</h2>")]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in section.split("<tr>")]
    of_bias = {row[0]: row for row in rows if row and row[0].startswith("bias")}
    learned = read_calibration(folder / "own.toml", armpi)
    for p in learned.parameters:
        spread = generic_imperfections(armpi).variation.bias[0]
        if p.name == "bias":
            assert p.deviations == pytest.approx(p.value / spread, rel=1e-4)
            assert of_bias[f"bias, {p.motor}"][4] == f"{p.deviations:+.1f} deviations"
    off = {p.motor: abs(p.deviations) for p in learned.parameters if p.name == "bias"}
    assert max(off, key=off.get) == "motor_2"
    taught = [row for row in rows if len(row) == 2]
    assert len(taught) == 6
    assert all(float(nats) > 0.0 for _, nats in taught)
    assert section.count("<li>") == len(learned.remarks)


@pytest.fixture(scope="module")
def tracked(runs, tmp_path_factory):
    """The same when each is judged by those before it."""
    folder = tmp_path_factory.mktemp("tracked")
    tables = ("--json", folder / "out.jsonl", "--csv", folder / "out.csv")
    return diagnose(runs, "--track", *tables, *AMONG), folder


@pytest.mark.parametrize("way", ["together", "tracked"])
def test_what_all_runs_say_of_each_is_written_too(request, runs, tmp_path, way):
    answer, folder = request.getfixturevalue(way)
    file, table, alone = folder / "out.jsonl", folder / "out.csv", tmp_path / "alone.jsonl"
    option = {"together": "--self-calibrate", "tracked": "--track"}[way]
    told, (header, *cells) = records(file), csv.reader(table.read_text().splitlines())
    assert "over all runs: " in answer.output
    assert all(0.0 < r["course_probability"] <= 1.0 for r in told)
    assert [row[header.index("course")] for row in cells] == [r["course"] for r in told]
    assert {r["course"] for r in told} <= {*told[0]["posterior"]}
    diagnose(runs, option, "--independent", "--json", alone, *AMONG)
    assert not any("course" in r for r in records(alone))
    assert all(list(r["posterior"]) == TRUTHS for r in records(alone))


def test_runs_of_two_robots_are_noticed_on_the_way(armpi, tmp_path):
    """Six healthy runs of a robot, then six of one whose motors 2 and 3 are 2.3 degrees off."""
    other = replace(ROBOT, bias=(0.0, -0.02, 0.04, 0.0))
    made = [
        simulate(Plan(armpi, ["healthy"], 6, seed, Imperfections("made up", "test", settling=own)))
        for seed, own in enumerate((ROBOT, other))
    ]
    for name, some in zip(("a.nc", "b.nc"), made, strict=True):
        save_run_set(some.assign_coords(run=[f"{name[0]}{i}" for i in range(6)]), tmp_path / name)
    one = diagnose(tmp_path / "a.nc", "--track", *AMONG)
    assert "two robots" not in one.output
    both = diagnose(tmp_path / "a.nc", tmp_path / "b.nc", "--track", *AMONG)
    assert "the runs seem to be of two robots" in both.output


def test_the_calibration_of_another_robot_is_not_replaced(together, runs, armpi, tmp_path):
    """One that healthy logs taught may be of any arm; it may be begun with, and the own renewed."""
    path = tmp_path / "mine.toml"
    learned = read_calibration(together[1] / "own.toml", armpi)
    named = replace(learned, imperfections=replace(learned.imperfections, name="robot B"))
    save_calibration(named, armpi, path)
    before = path.read_bytes()
    refusal = "holds calibration 'robot B' of robot 'armpi_fpv', expected 'armpi_fpv, self-calibra"
    for how in ("--self-calibrate", "--track"):
        with pytest.raises(OSError, match=refusal):
            diagnose(runs, how, "--out", path)
    assert path.read_bytes() == before
    one = tmp_path / "one.nc"
    save_run_set(load_run_set(runs).isel(run=[0]), one)
    for begun in (("--calibration", path), ()):
        assert diagnose(one, "--self-calibrate", *begun, "--out", path, *AMONG).exit_code == 0
        name = read_calibration(path, armpi).imperfections.name
        assert name == "armpi_fpv, self-calibrated"


def test_without_it_nothing_is_learned(runs, tmp_path):
    file = tmp_path / "out.jsonl"
    answer = diagnose(runs, "--json", file, *AMONG)
    assert "self-calibrated" not in answer.output
    assert "P1" not in {r["protocol"] for r in records(file)}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--out", "own.toml"], "nothing is learned without --track or --self-calibrate"),
        (["--track", "--self-calibrate"], "--track judges each run by those before it, --self"),
        (
            ["--track", "--out", "own.toml", "--calibration", "armpi_fpv"],
            "--track keeps what it learns beside the calibration that it began with",
        ),
        (["--self-calibrate", "--out", "own.json"], "own.json: a calibration ends in .toml"),
        (["--self-calibrate", "--out", "no/own.toml"], "does not exist. Make it first"),
    ],
)
def test_what_contradicts_itself_is_refused(runs, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((InputError, OSError)) as refusal:
        diagnose(runs, *options)
    assert words in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--self-calibrate", "--track"])
def test_runs_without_a_tool_position_are_refused(armpi, tmp_path, option):
    made = simulate(
        Plan(armpi, ["healthy"], 1, 4, Imperfections("a", "b"), sensors=["accelerometer"])
    )
    save_run_set(made.assign(measured=made["measured"] * float("nan")), tmp_path / "runs.nc")
    with pytest.raises(InputError, match="no tool position, but only what accelerometer read"):
        diagnose(tmp_path / "runs.nc", option)


def test_errors_that_were_ruled_out_are_told(runs, armpi, tmp_path):
    few = tmp_path / "few.nc"
    save_run_set(load_run_set(runs).isel(run=[0, 4]), few)
    among = (few, "--hypotheses", "healthy,motor_3:steady_state_error", "--error-range")
    narrow = diagnose(*among, "0.01", "0.02", "deg")
    assert "would look otherwise without the range of errors that was given" in narrow.stderr
    assert "motor 3 misses its targets" in narrow.stderr
    assert "look otherwise" not in diagnose(*among, "2", "15", "deg").stderr


def test_a_network_cannot_be_told_to(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "network.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"only the Bayesian diagnosis .* --self-calibrate"):
        diagnose(runs, "--method", "network.npz", "--self-calibrate")
