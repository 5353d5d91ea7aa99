from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.together.life_filter import WINDOW
from failuretwin.inference.together.wear_limits import WearLimits

RUNS = 24
AMONG = ("--hypotheses", "healthy,motor_1:stuck,motor_2:steady_state_error")
"""Where what is learned does not depend on what else is offered."""


@pytest.fixture(scope="module")
def healthy(failuretwin, tmp_path_factory):
    """A run set of healthy runs, without the motors' readings."""
    path = tmp_path_factory.mktemp("healthy") / "healthy.nc"
    answer = failuretwin(
        *("simulate", "--out", path, "--hypotheses", "healthy", "--runs-per-class", RUNS),
        *("--calibration", "armpi_fpv"),
    )
    assert answer.returncode == 0, answer.stderr
    save_run_set(load_run_set(path).drop_vars("position"), path)
    return path


@pytest.fixture(scope="module")
def few(healthy):
    """The first six of them."""
    path = healthy.with_name("few.nc")
    save_run_set(load_run_set(healthy).isel(run=slice(0, 6)), path)
    return path


@pytest.fixture(scope="module")
def few_learned(failuretwin, few, tmp_path_factory):
    """A folder with a calibration and its history of the few."""
    folder = tmp_path_factory.mktemp("few")
    own = shutil.copy(load_robot("armpi_fpv").imperfections_file, folder / "cal.toml")
    answer = failuretwin("diagnose", few, "--calibration", own, "--track", *AMONG)
    assert answer.returncode == 0, answer.stderr
    return folder


@pytest.fixture
def few_known(few_learned, calibration):
    """The calibration, with the history of the few."""
    for file in few_learned.iterdir():
        shutil.copy(file, calibration.with_name(file.name))
    return calibration


@pytest.fixture
def calibration(tmp_path):
    """A calibration without a history."""
    return shutil.copy(load_robot("armpi_fpv").imperfections_file, tmp_path / "cal.toml")


@pytest.fixture
def track(failuretwin, calibration):
    def run(*arguments):
        known = ("--calibration", calibration, "--track")
        return failuretwin("diagnose", *arguments, *known, *AMONG)

    return run


def rows_of(calibration):
    path = calibration.with_suffix(".history.jsonl")
    return [json.loads(line) for line in path.read_text().splitlines()][1:]


def test_runs_are_tracked_and_the_history_kept(failuretwin, calibration, healthy, tmp_path):
    """Every class of the paper is offered, each motor's."""
    told = ("--calibration", calibration, "--track", "--json", tmp_path / "x.jsonl")
    answer = failuretwin("diagnose", healthy, *told)
    assert answer.returncode == 0, answer.stderr
    line = answer.stdout.splitlines()[-1]
    assert line.startswith("tracked: 24 runs learned, 24 in all; largest changes: bias of motor_")
    rows = rows_of(calibration)
    records = [json.loads(text) for text in (tmp_path / "x.jsonl").read_text().splitlines()]
    assert [row["run"] for row in rows] == [record["run"] for record in records]
    for row, record in zip(rows, records, strict=True):
        faulty = None if record["diagnosis"] is None else 1 - record["posterior"]["healthy"]
        assert row["probability_faulty"] == pytest.approx(faulty, abs=1e-12)
    assert [record["protocol"] for record in records[:10]] == ["P0c"] * 10
    assert records[-1]["protocol"] == "P1"
    assert records[-1]["method"].endswith("armpi_fpv, tracked")
    # Runs that are judged again only narrow it; each that leaves them adds a step of wear.
    known = load_calibration(None, load_robot("armpi_fpv")).imperfections
    first, later, last = (np.array(rows[k]["bias_deviation"]) for k in (0, 19, -1))
    assert (first < known.variation.bias).all()
    assert (later < first).all()
    walk = WearLimits().rate * np.sqrt(RUNS - WINDOW) * np.array(known.settling.scatter)
    assert (last < np.hypot(known.variation.bias, walk)).all()


def test_advice_of_a_history(track, failuretwin, few_known, calibration, healthy, tmp_path):
    """Of six runs nothing is said; healthy ones show no wear beyond their doubt."""
    history = calibration.with_suffix(".history.jsonl")
    answer = failuretwin("advise", history, "--calibration", calibration)
    assert answer.returncode == 0, answer.stderr
    for k, line in enumerate(answer.stdout.splitlines()[:4], 1):
        assert line == f"motor_{k}: fewer than 20 runs say something of its wear"
    assert track(healthy).returncode == 0
    answer = failuretwin(
        *("advise", history, "--calibration", calibration, "--json", tmp_path / "advice.json")
    )
    assert answer.returncode == 0, answer.stderr
    motors = json.loads((tmp_path / "advice.json").read_text())["motors"]
    assert {"motor_1", "motor_2"} <= {motor["motor"] for motor in motors}
    assert "motor_1: worn by " in answer.stdout
    assert all(abs(motor["level_scatters"]) < 2.0 for motor in motors)
    told = [np.array([row[key] for row in rows_of(calibration)], dtype=float)
            for key in ("bias_alone", "bias_alone_deviation")]  # fmt: skip
    weight = told[1] ** -2.0
    chance = np.nansum(weight, axis=0) ** -0.5
    assert (np.abs(np.nansum(weight * told[0], axis=0)) * chance**2 < 4.0 * chance).all()


def test_a_session_at_a_time_is_as_good_as_all_at_once(track, calibration, healthy, tmp_path):
    """Sessions given in one command or in several leave the same history, byte for byte."""
    runs = load_run_set(healthy).isel(run=slice(0, 6))
    names = [f"session_{i // 3}/{i}" for i in range(6)]
    runs = runs.assign_coords(run=np.array(names, dtype=object))
    parts = [tmp_path / "a.nc", tmp_path / "b.nc"]
    for path, rows in zip(parts, (slice(0, 3), slice(3, 6)), strict=True):
        save_run_set(runs.isel(run=rows), path)
    history = calibration.with_suffix(".history.jsonl")
    assert track(*parts).returncode == 0
    together = history.read_bytes()
    history.unlink()
    calibration.with_suffix(".history.npz").unlink()
    for part in parts:
        assert track(part).returncode == 0
    assert history.read_bytes() == together


def test_runs_are_learned_once(track, few_known, calibration, few):
    history = calibration.with_suffix(".history.jsonl").read_bytes()
    answer = track(few)
    assert answer.returncode == 0
    assert "6 known already" in answer.stdout
    assert calibration.with_suffix(".history.jsonl").read_bytes() == history


def test_a_history_that_failed_to_begin_is_nothing(track, calibration, few):
    calibration.with_suffix(".history.jsonl").write_text('{"history_of": "arm')
    assert track(few).returncode == 0
    assert len(rows_of(calibration)) == 6


def test_runs_without_movements_do_no_harm(track, calibration, healthy, tmp_path):
    """Six runs in which no motor is told to move, between healthy ones."""
    runs = load_run_set(healthy).isel(run=slice(0, 6))
    still = runs.assign(command=runs["command"] * 0.0)
    still = still.drop_vars(["target", "ramp_duration", "movement_start"], errors="ignore")
    moving = runs.drop_vars(["target", "ramp_duration", "movement_start"], errors="ignore")
    parts = []
    for name, part in (("a", still), ("b", moving), ("c", still)):
        names = [f"{name}/{i}" for i in range(6)]
        parts.append(part.assign_coords(run=np.array(names, dtype=object)))
    save_run_set(concatenate(parts), tmp_path / "runs.nc")
    answer = track(tmp_path / "runs.nc")
    assert answer.returncode == 0, answer.stderr
    rows = rows_of(calibration)
    assert len(rows) == 18
    assert all(row["probability_faulty"] is None for row in rows[:6])
    assert all(row["bias"] == rows[0]["bias"] for row in rows[:4])


def test_a_fault_is_told_and_not_learned(track, calibration, failuretwin, tmp_path):
    path = tmp_path / "stuck.nc"
    failuretwin(
        *("simulate", "--out", path, "--hypotheses", "motor_1:stuck", "--runs-per-class", 9),
        *("--calibration", "armpi_fpv"),
    )
    answer = track(path)
    assert "9 runs learned" in answer.stdout
    rows = rows_of(calibration)
    change = np.abs(rows[-1]["bias"][0] - np.array(rows[0]["bias"][0]))
    assert change < 0.5 * np.array(rows[0]["bias_deviation"][0])


# A robot of which nothing is known.


def test_a_life_may_begin_cold_and_go_on(failuretwin, healthy, tmp_path):
    """Its first run is judged by its kind alone; what was learned is a calibration of its own."""
    out, file = tmp_path / "mine.toml", tmp_path / "x.jsonl"
    runs = load_run_set(healthy)
    parts = [tmp_path / "a.nc", tmp_path / "b.nc"]
    for path, rows in zip(parts, (slice(0, 6), slice(6, 14)), strict=True):
        save_run_set(runs.isel(run=rows), path)
    for part, learned in zip(parts, (6, 14), strict=True):
        answer = failuretwin("diagnose", part, "--track", "--out", out, "--json", file, *AMONG)
        assert answer.returncode == 0, answer.stderr
        assert f"{learned} in all" in answer.stdout
    records = [json.loads(text) for text in file.read_text().splitlines()]
    assert {record["protocol"] for record in records} == {"P1"}
    rows = [json.loads(line) for line in (tmp_path / "mine.history.jsonl").read_text().splitlines()]
    assert len(rows) == 15
    assert rows[-1]["friction_deviation"][0] < 0.5 * rows[1]["friction_deviation"][0]
    learned = load_calibration(out, load_robot("armpi_fpv")).imperfections
    assert (learned.protocol, learned.name) == ("P1", "armpi_fpv, self-calibrated")
    assert "14 runs without labels; generic, not calibrated" in learned.source
    true = load_calibration(None, load_robot("armpi_fpv")).imperfections.settling
    off = np.abs(np.array(learned.settling.friction) - true.friction)
    assert (off < 3.5 * np.array(learned.variation.friction)).all()


def test_without_a_file_nothing_is_kept(failuretwin, few, listing, tmp_path):
    answer = failuretwin("diagnose", few, "--track", "--json", "x.jsonl", *AMONG, folder=tmp_path)
    assert answer.returncode == 0, answer.stderr
    protocols = [json.loads(t)["protocol"] for t in (tmp_path / "x.jsonl").read_text().splitlines()]
    assert protocols == ["P0", *["P1"] * 5]
    assert "history:" not in answer.stdout
    assert len(listing(tmp_path)) == 1


def test_a_history_of_another_calibration_is_refused(track, few_known, calibration, few):
    text = calibration.read_text()
    calibration.write_text(text.replace("tail_dof = ", "tail_dof = 1", 1))
    assert calibration.read_text() != text
    answer = track(few)
    assert answer.returncode == 2
    assert "history of another calibration" in answer.stderr


def test_when_results_cannot_be_written_nothing_is_learned(track, calibration, few, tmp_path):
    answer = track(few, "--json", tmp_path / "nowhere" / "x.jsonl")
    assert answer.returncode == 2
    assert not calibration.with_suffix(".history.jsonl").exists()


def test_without_the_flag_no_history_is_kept(failuretwin, calibration, few, listing, tmp_path):
    before = listing(tmp_path)
    assert failuretwin("diagnose", few, "--calibration", calibration, *AMONG).returncode == 0
    assert listing(tmp_path) == before
