"""`failuretwin doctor`, and other verbs on logs that do not fit the profile."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from failuretwin import load_robot
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from little_logs import exact_run

WRONG = "set-up: the log does not fit the profile (over 99.9 % sure): motor 2 turns the other way"


@pytest.fixture(scope="module")
def reversed_log(simulated, tmp_path_factory):
    """Two runs of a log in which motor 2 turns the other way."""
    runs = load_run_set(simulated).isel(run=[0, 2])
    command = runs["command"].values.copy()
    command[..., 1] *= -1.0
    path = tmp_path_factory.mktemp("reversed") / "log.nc"
    save_run_set(runs.assign(command=(runs["command"].dims, command)), path)
    return path


def test_clocks_that_are_apart_show_on_the_way(failuretwin, tmp_path):
    time, knots = 0.02 * np.arange(301), np.arange(0.0, 12.0, 0.9)
    told = CubicSpline(knots, np.random.default_rng(7).uniform(-0.7, 0.7, (len(knots), 4)))
    log, robot = tmp_path / "log.nc", load_robot("armpi_fpv")
    save_run_set(exact_run(robot, told(time), told(time - 0.3), 0.02), log)
    answer = failuretwin("doctor", log, "--calibration", "generic")
    assert answer.returncode == 0, answer.stderr
    (late,) = re.findall(r"the tool trails its commands by ([0-9.]+) s", answer.stdout)
    assert float(late) == pytest.approx(0.3, abs=0.05)


def test_a_log_that_fits_is_said_to_fit(failuretwin, simulated):
    answer = failuretwin("doctor", simulated)
    assert answer.returncode == 0, answer.stderr
    assert "set-up: the log fits the profile" in answer.stdout
    assert "log: 9 runs" in answer.stdout


def test_what_is_found_can_be_accepted(failuretwin, reversed_log, tmp_path):
    fix = tmp_path / "map.toml"
    answer = failuretwin("doctor", reversed_log, "--out", fix)
    assert answer.returncode == 0, answer.stderr
    assert WRONG in answer.stdout
    given = ("diagnose", reversed_log, "--hypotheses", "healthy,motor_2:stuck,motor_3:stuck")
    accepted, alone = failuretwin(*given, "--columns", fix), failuretwin(*given)
    assert "does not fit" not in accepted.stdout
    assert "does not fit" in alone.stdout
    assert "2 of 2 runs right" in accepted.stdout
    assert "2 of 2 runs right" in alone.stdout


def test_a_shift_of_the_tool_is_no_other_robot_and_can_be_accepted(
    failuretwin, simulated, tmp_path
):
    runs = load_run_set(simulated).isel(run=[0, 0, 2])
    runs = runs.assign_coords(run=[f"run_{i}" for i in range(3)])
    off, fix = tmp_path / "off.nc", tmp_path / "map.toml"
    save_run_set(runs.assign(measured=runs["measured"] + [0.0, 0.0, 0.008]), off)
    told = failuretwin("doctor", off, "--out", fix).stdout
    assert told.startswith("set-up: the sensor does not seem to stand where the profile says")
    assert re.search(r"off by the same . mm|in a frame turned by", told)
    assert "fits the profile" not in told
    assert "another robot" not in told
    accepted = failuretwin("doctor", off, "--columns", fix).stdout
    assert accepted.startswith("set-up: the log fits the profile")


def test_a_log_without_a_verdict_does_not_fit(failuretwin, simulated, tmp_path):
    runs = load_run_set(simulated).isel(run=[0, 2])
    save_run_set(runs.assign_coords(time=runs["time"] * 1000.0), tmp_path / "ms.nc")
    told = failuretwin("doctor", tmp_path / "ms.nc").stdout
    assert told.startswith("set-up: cannot tell, because readings come")
    assert "milliseconds" in told.splitlines()[0]
    assert "fits the profile" not in told


def test_calibrate_names_the_set_up_of_logs_that_it_refuses(failuretwin, reversed_log, tmp_path):
    healthy = load_run_set(reversed_log).isel(run=[0, 0])
    healthy = healthy.assign_coords(run=[f"healthy/{i}" for i in range(2)])
    save_run_set(healthy.drop_vars("position", errors="ignore"), tmp_path / "healthy.nc")
    answer = failuretwin("calibrate", tmp_path / "healthy.nc", "--out", tmp_path / "own.toml")
    assert answer.returncode == 2
    assert "motor 2 turns the other way" in answer.stderr
    assert not (tmp_path / "own.toml").exists()


def test_runs_with_a_gap_are_named(failuretwin, simulated, tmp_path):
    runs = load_run_set(simulated).isel(run=[0, 2, 7]).copy(deep=True)
    runs["measured"][1, 300:450] = float("nan")  # 1.5 s
    save_run_set(runs, tmp_path / "gap.nc")
    answer = failuretwin("doctor", tmp_path / "gap.nc")
    remarks = [line for line in answer.stdout.splitlines() if "no readings" in line]
    assert any(line.endswith(f" ({runs['run'].values[1]})") for line in remarks)
    assert all(line.endswith(")") for line in remarks)


def test_a_file_that_exists_is_left_alone(failuretwin, reversed_log, tmp_path):
    taken = tmp_path / "map.toml"
    taken.write_text("mine")
    answer = failuretwin("doctor", reversed_log, "--out", taken)
    assert answer.returncode == 2
    assert "not taken yet" in answer.stderr
    assert taken.read_text() == "mine"


def test_a_correction_of_another_robot_is_refused(failuretwin, reversed_log, tmp_path):
    fix = tmp_path / "map.toml"
    fix.write_text("[correction]\ncommands = [[1]]\nzero = [0]\ntool = [[1,0,0]]\norigin = [0,0,0]")
    answer = failuretwin("diagnose", reversed_log, "--columns", fix)
    assert answer.returncode == 2
    assert "expected 4 rows of 4 numbers in commands" in answer.stderr
