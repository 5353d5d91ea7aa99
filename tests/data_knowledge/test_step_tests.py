from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.step_tests import find_step_tests, is_step_test, read_step_test
from step_writers import HEADER, step_rows, write_step_test

LOOP = (0.1, 20.0, 0.011, 1050.0)
"""P, I [1/s], filter time [s], speed limit [counts/s]."""


@pytest.fixture
def rows():
    return step_rows(np.random.default_rng(1), LOOP, (50, -50), dead_s=0.01)


def read(tmp_path, armpi, rows, name="test_motor_6.csv"):
    return read_step_test(write_step_test(tmp_path / name, rows), armpi)


def test_a_step_in_the_units_of_the_twin(tmp_path, armpi, rows):
    there, back = read(tmp_path, armpi, rows)
    assert (there.motor, there.number, there.flaw, back.flaw) == ("motor_1", 1, "", "")
    assert there.source == f"{tmp_path.name}/test_motor_6.csv"
    assert there.duration == 0.005
    count = np.deg2rad(0.24)
    assert there.target == pytest.approx(np.deg2rad(120.0) - 550 * count)
    assert there.start == pytest.approx(np.deg2rad(120.0) - 500 * count, abs=1.01 * count)
    assert there.travel == pytest.approx(-50 * count, abs=1.01 * count)
    assert back.travel == pytest.approx(50 * count, abs=1.01 * count)


def test_commands_are_put_back_to_their_time(tmp_path, armpi, rows):
    there, _ = read(tmp_path, armpi, rows)
    assert np.all(np.diff(there.time) >= 0.0)
    moved = np.abs(there.position - there.start) > 0.5 * abs(there.travel)
    assert 0.03 < there.time[moved][0] < 0.1


@pytest.mark.parametrize(("servo", "motor"), [(5, "motor_2"), (4, "motor_3"), (3, "motor_4")])
def test_the_name_says_which_servo(tmp_path, armpi, rows, servo, motor):
    steps = read(tmp_path, armpi, rows, f"20240506_motor_{servo}_550.csv")
    assert [step.motor for step in steps] == [motor] * 2


def flaw(tmp_path, armpi, rows, name="test_motor_6.csv"):
    return read(tmp_path, armpi, rows, name)[0].flaw


def test_a_servo_that_is_no_motor_of_the_robot(tmp_path, armpi, rows):
    assert flaw(tmp_path, armpi, rows, "motor_2.csv").startswith("is of servo motor_2")
    assert "does not say which servo" in flaw(tmp_path, armpi, rows, "step.csv")


def test_a_motor_that_does_not_move(tmp_path, armpi, rows):
    still = [(t, p if c else 500.0, c) for t, p, c in rows]
    assert flaw(tmp_path, armpi, still) == "does not move although commanded"


def test_a_motor_that_is_held_back(tmp_path, armpi, rows):
    held = [(t, p if c else min(p, 530.0), c) for t, p, c in rows]
    assert flaw(tmp_path, armpi, held) == "is held back: it covers 60 % of its travel"


def test_readings_that_are_too_slow(tmp_path, armpi):
    slow = step_rows(np.random.default_rng(1), LOOP, (50,), dead_s=0.01, period_s=0.05)
    assert flaw(tmp_path, armpi, slow).startswith("was read every 0.050 s, expected 0.03 s")


def test_a_gap_in_the_readings(tmp_path, armpi):
    rng = np.random.default_rng(1)
    holed = step_rows(rng, LOOP, (50,), dead_s=0.01, gap=(0.02, 0.14))
    assert flaw(tmp_path, armpi, holed).startswith("has a gap of 0.1")


def test_a_log_that_ends_too_early(tmp_path, armpi, rows):
    short = [row for row in rows if row[0] < 0.1]
    assert flaw(tmp_path, armpi, short).startswith("has too few readings")


def test_a_step_of_a_few_counts(tmp_path, armpi):
    small = step_rows(np.random.default_rng(1), LOOP, (6,), dead_s=0.01)
    assert flaw(tmp_path, armpi, small) == "is told to move by 6 counts only"


@pytest.mark.parametrize("wrong", [-3000.0, 900.0])
def test_spoilt_readings_are_dropped(tmp_path, armpi, rows, wrong):
    hit = [i for i, row in enumerate(rows) if not row[2]][105]
    spoilt = [(t, wrong if i == hit else p, c) for i, (t, p, c) in enumerate(rows)]
    clean, dropped = read(tmp_path, armpi, rows)[0], read(tmp_path, armpi, spoilt)[0]
    assert len(dropped.time) == len(clean.time) - 1
    assert dropped.flaw == ""


def test_a_fast_motion_is_not_spoilt(tmp_path, armpi):
    fast = step_rows(np.random.default_rng(1), LOOP, (450,), dead_s=0.01)
    step = read(tmp_path, armpi, fast)[0]
    inside = [t for t, _, c in fast if not c and -0.4 < t <= 1.5]
    assert len(step.time) == len(inside)


def test_only_the_very_header_is_a_step_test(tmp_path, rows):
    (tmp_path / "deep").mkdir()
    path = write_step_test(tmp_path / "deep" / "motor_6.csv", rows)
    other = tmp_path / "other.csv"
    other.write_text(HEADER + ",more\n")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    assert is_step_test(path)
    assert not is_step_test(other)
    assert not is_step_test(tmp_path / "missing.csv")
    assert find_step_tests(tmp_path) == [path]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1600000000.0,five,0.0,0.0,0.0", "line 2, column position: got 'five', expected a number"),
        ("1600000000.0,500,0.0,0.0,0.0", "no row has a command"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, armpi, line, said):
    path = tmp_path / "motor_6.csv"
    path.write_text(f"{HEADER}\n{line}\n")
    with pytest.raises(InputError, match=said):
        read_step_test(path, armpi)


def test_the_real_ones(data, armpi):
    files = find_step_tests(data / "motor_step_tests")
    assert len(files) == 13
    steps = [step for file in files for step in read_step_test(file, armpi)]
    assert len(steps) == 26
    sound = [step.motor for step in steps if not step.flaw]
    assert [sound.count(name) for name in armpi.motor_names] == [14, 2, 2, 2]
    still = [step for step in steps if step.flaw.startswith("does not move")]
    assert {step.source for step in still} == {"robot_a/collected_data.csv"}
    resisted = [step for step in steps if "resistance" in step.source]
    assert all("does not say which servo" in step.flaw for step in resisted)
