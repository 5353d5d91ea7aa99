from __future__ import annotations

import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin.app.cli import cli
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.calibration.result import save_calibration
from failuretwin.connection.calibration.step_parameters import (
    learn_loops,
    split_step_tests,
    with_step_tests,
)
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.read import read_runs
from failuretwin.data_knowledge.store import save_run_set
from failuretwin.inference.diagnoser import BayesDiagnoser
from step_writers import step_rows, write_step_test

LOOP = (0.1, 20.0, 0.011, 1050.0)


@pytest.fixture
def write_tests():
    def write(folder, servos):
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(0)
        return [
            write_step_test(folder / f"motor_{k}.csv", step_rows(rng, LOOP, (50, -50), 0.01))
            for k in servos
        ]

    return write


def test_step_tests_are_told_from_sessions(tmp_path, write_tests, write_session):
    tests = write_tests(tmp_path / "tests", [6])
    write_session(tmp_path / "logs" / "session")
    inside = write_tests(tmp_path / "logs" / "more", [5])
    logs = [tmp_path / "tests", tmp_path / "logs"]
    assert split_step_tests(logs, None) == ([*tests, *inside], [tmp_path / "logs"])
    assert split_step_tests([*tests, tmp_path / "runs.nc"], None) == (tests, [tmp_path / "runs.nc"])


def test_step_tests_alone_are_no_calibration(tmp_path, write_tests):
    write_tests(tmp_path, [6, 5])
    with pytest.raises(InputError, match="2 step tests and no other log"):
        split_step_tests([tmp_path], None)


def test_loops_of_some_motors_are_told_but_not_used(tmp_path, write_tests, armpi):
    found = learn_loops(write_tests(tmp_path, [6]), armpi)
    assert [fit.motor for fit in found.fits] == ["motor_1"]
    assert found.robot == armpi


def test_without_a_sound_step_there_is_a_reason(tmp_path, armpi):
    rows = step_rows(np.random.default_rng(0), LOOP, (50,), 0.01)
    still = [(t, p if c else 500.0, c) for t, p, c in rows]
    path = write_step_test(tmp_path / "motor_6.csv", still)
    with pytest.raises(InputError, match="step 1 does not move although commanded"):
        learn_loops([path], armpi)


def test_a_calibration_with_step_tests(tmp_path, write_tests, write_session, failuretwin):
    for seed in range(2):
        write_session(tmp_path / "logs" / f"s{seed}", seed=seed)
    write_tests(tmp_path / "tests", [6, 5, 4, 3])
    out = tmp_path / "own.toml"
    done = failuretwin("calibrate", tmp_path / "logs", tmp_path / "tests", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "loop gain I, motor_3" in done.stdout
    (row,) = [row for row in done.stdout.splitlines() if row.startswith("speed limit, motor_1")]
    assert "not identified: no step reaches it" in row
    loops = tomllib.loads(out.read_text())["calibration"]["loops"]
    assert [loop["motor"] for loop in loops] == ["motor_1", "motor_2", "motor_3", "motor_4"]
    assert [loop["I"] for loop in loops] == pytest.approx([20.0] * 4, rel=0.35)


def test_step_tests_alone_end_with_one_message(tmp_path, write_tests, failuretwin):
    write_tests(tmp_path / "tests", [6])
    out = tmp_path / "own.toml"
    done = failuretwin("calibrate", tmp_path / "tests", "--out", out)
    assert done.returncode == 2
    assert "1 step tests and no other log" in done.stderr
    assert not out.exists()


# The loops of a calibration in use


SLOW_LOOPS = """
name = "slow"
source = "made up"
[timing]
delay_s = [0.004, 0.008]
lag_s = [0.003, 0.003]
[calibration]
robot = "armpi_fpv"
"""
LOOP_TABLE = """
[[calibration.loops]]
motor = "motor_{}"
P = 0.1
I = 20.0
filter_s = 0.01
speed_limit = 4.0
"""


@pytest.fixture
def expected_lag(monkeypatch):
    """Run a command and return the lag [s] that its diagnoser expects of a healthy robot."""
    used = []
    make = BayesDiagnoser.__init__

    def noted(diagnoser, *arguments, **named):
        used.append(diagnoser)
        make(diagnoser, *arguments, **named)

    monkeypatch.setattr(BayesDiagnoser, "__init__", noted)

    def run(*arguments):
        CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
        (lag,) = {diagnoser.healthy_model.lag_s for diagnoser in used}
        return lag

    return run


@pytest.mark.parametrize("command", [("diagnose",), ("watch", "--speed", "0")], ids=lambda c: c[0])
def test_what_a_command_expects_has_the_loops_of_the_calibration(
    tmp_path, write_session, expected_lag, command
):
    file = tmp_path / "slow.toml"
    file.write_text(SLOW_LOOPS + "".join(LOOP_TABLE.format(k) for k in (1, 2, 3, 4)))
    session = write_session(tmp_path / "s")
    lag = expected_lag(*command, session, "--calibration", file)
    assert lag == pytest.approx(1.0 / 20.0 + 0.006 + 0.003)


def test_diagnose_expects_the_loops_of_real_step_tests(tmp_path, data, armpi, expected_lag):
    """With the loops of the profile under the file's timing it would expect 0.024 s."""
    folder = data / "real_robot_b_20241003"
    tests, _ = split_step_tests([data / "motor_step_tests", folder], None)
    steps = learn_loops(tests, armpi)
    runs = read_runs(folder / "label_0", steps.robot).isel(run=slice(4))
    save_run_set(runs, tmp_path / "runs.nc")
    found = fit_calibration(runs, steps.robot, "own", "label 0 and step tests", thorough=False)
    save_calibration(with_step_tests(found, steps), armpi, tmp_path / "own.toml")
    lag = expected_lag("diagnose", tmp_path / "runs.nc", "--calibration", tmp_path / "own.toml")
    assert lag == pytest.approx(0.057, abs=0.004)
