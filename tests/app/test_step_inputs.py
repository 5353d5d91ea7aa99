from __future__ import annotations

import tomllib

import numpy as np
import pytest

from failuretwin.app.inputs import learn_loops, split_step_tests
from failuretwin.core.errors import InputError
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
    for seed in range(3):
        write_session(tmp_path / "logs" / f"s{seed}", seed=seed)
    write_tests(tmp_path / "tests", [6, 5, 4, 3])
    out = tmp_path / "own.toml"
    done = failuretwin("calibrate", tmp_path / "logs", tmp_path / "tests", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "loop gain I, motor_3" in done.stdout
    assert "speed limit, motor_1: no step is seen to run at it" in done.stdout
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
