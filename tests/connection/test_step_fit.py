from __future__ import annotations

import numpy as np
import pytest

from failuretwin.connection.calibration.step_parameters import (
    fit_steps,
    mean_interval,
    overshoot,
    settling_time,
)
from failuretwin.data_knowledge.step_tests import StepTest, find_step_tests, read_step_test
from step_writers import step_rows, write_step_test

SIZES = (50, -50, 150, -150, 400, -400)
NAMES = ("loop gain P", "loop gain I", "filter time", "speed limit", "dead time")
COUNT = np.deg2rad(0.24)


def fit_file(folder, armpi, rng, truth, sizes=SIZES):
    """Fit simulated tests of motor 1 and return its parameters by name."""
    P, I, tau, limit, dead = truth  # noqa: E741
    rows = step_rows(rng, (P, I, tau, limit / COUNT), sizes, dead)
    (fit,), left_out = fit_steps(
        read_step_test(write_step_test(folder / "motor_6.csv", rows), armpi), armpi
    )
    assert (fit.motor, fit.steps, left_out) == ("motor_1", len(sizes), ())
    return {parameter.name: parameter for parameter in fit.parameters}


def random_motor(rng):
    ranges = ((0.05, 0.5), (12.0, 40.0), (0.007, 0.016), (3.0, 5.5), (-0.01, 0.03))
    return [float(rng.uniform(low, high)) for low, high in ranges]


def covered(folder, armpi, motors, seed):
    """Return which intervals hold the truth, which are identified and how far off values are.

    (motor, parameter) each, the latter in deviations: 1.96 on either side are an interval of 95 %.
    """
    off, learned = np.zeros((motors, len(NAMES))), np.zeros((motors, len(NAMES)), dtype=bool)
    inside = learned.copy()
    for k in range(motors):
        rng = np.random.default_rng([seed, k])
        truth = random_motor(rng)
        found = fit_file(folder, armpi, rng, truth)
        for j, (name, true) in enumerate(zip(NAMES, truth, strict=True)):
            inside[k, j] = found[name].low <= true <= found[name].high
            learned[k, j] = found[name].identified
            off[k, j] = 3.92 * (found[name].value - true) / (found[name].high - found[name].low)
    return inside, learned, off


def test_intervals_cover_the_truth(tmp_path, armpi):
    inside, learned, _ = covered(tmp_path, armpi, motors=4, seed=1)
    assert 17 <= inside.sum() <= 20  # of 20
    assert learned[:, 1:].mean() > 0.9


@pytest.mark.slow
def test_intervals_cover_the_truth_at_the_stated_rate(tmp_path, armpi):
    inside, _, _ = covered(tmp_path, armpi, motors=120, seed=2)
    assert np.all(inside.mean(axis=0) > 0.89)
    assert 0.92 < inside.mean() < 0.99


def test_known_gains_come_back(tmp_path, armpi):
    truth = (0.02, 18.0, 0.0115, 4.3, 0.01)
    found = fit_file(tmp_path, armpi, np.random.default_rng(3), truth, SIZES * 2)
    values = [found[name].value for name in NAMES]
    assert values[1:4] == pytest.approx(truth[1:4], rel=0.1)
    assert values[0] == pytest.approx(truth[0], abs=0.1)
    assert values[4] == pytest.approx(truth[4], abs=0.003)
    assert found["speed limit"].value == pytest.approx(4.3, rel=0.005)


@pytest.mark.parametrize("sizes", [(50, -50), (25, -25, 50, -50)])
def test_small_steps_do_not_say_the_speed_limit(tmp_path, armpi, sizes):
    truth = (0.1, 18.0, 0.0115, 4.3, 0.01)
    limit = fit_file(tmp_path, armpi, np.random.default_rng(4), truth, sizes)["speed limit"]
    assert not limit.identified
    assert limit.low < 4.3 < limit.high
    assert "the largest is 12 deg in 5 ms; needed is one of" in limit.note


def test_what_is_not_known_stays_at_the_profile(tmp_path, armpi):
    truth = (0.1, 18.0, 0.0115, 4.3, 0.01)
    found = fit_file(tmp_path, armpi, np.random.default_rng(4), truth, (50, -50))
    assert found["speed limit"].value == pytest.approx(armpi.motors[0].speed_limit, rel=0.02)
    assert not found["loop gain P"].identified
    assert "more steps of different sizes" in found["loop gain P"].note


def shaped(position):
    """Return a step of ten counts from zero, read every 10 ms from its command on."""
    position = np.asarray(position, dtype=float) * COUNT
    time = 0.01 * np.arange(len(position))
    return StepTest("s", 1, "motor_1", 0.0, 0.02, 0.0, 10 * COUNT, time, position, "")


def test_overshoot_is_a_share_of_the_travel():
    assert overshoot(shaped([0, 4, 9, 12, 11, 10, 10])) == pytest.approx(0.2)
    assert overshoot(shaped([0, 4, 9, 10, 10])) == 0.0


def test_a_motor_has_settled_when_it_stays_within_two_counts():
    assert settling_time(shaped([0, 4, 9, 13, 12, 10, 7, 8, 10]), COUNT) == pytest.approx(0.04)
    assert settling_time(shaped([9, 10, 10]), COUNT) == 0.0


def test_the_interval_of_a_mean_is_that_of_student_or_of_rounding():
    mean, low, high = mean_interval([1.0, 2.0, 3.0], [0.0] * 3)
    assert (mean, high - mean) == (2.0, pytest.approx(4.302653 / np.sqrt(3.0), rel=1e-6))
    assert low == pytest.approx(2.0 - (high - 2.0))
    mean, low, high = mean_interval([1.0, 1.0], [0.1, 0.1])
    assert (high - low) / 2.0 == pytest.approx(1.96 * 0.1 / np.sqrt(2.0))
    assert mean_interval([1.0], [0.1])[1:] == pytest.approx((0.804, 1.196))


@pytest.fixture(scope="module")
def robot_a(data, armpi):
    files = find_step_tests(data / "motor_step_tests" / "robot_a")
    return fit_steps([step for file in files for step in read_step_test(file, armpi)], armpi)


def test_the_real_motors(robot_a, armpi):
    fits, left_out = robot_a
    assert [(fit.motor, fit.steps) for fit in fits] == [
        ("motor_1", 10), ("motor_2", 2), ("motor_3", 2), ("motor_4", 2),
    ]  # fmt: skip
    assert all(fit.residual < 2.0 * COUNT for fit in fits)
    assert {entry.run for entry in left_out} == {
        "robot_a/collected_data.csv",
        "robot_a/collected_data_resistance.csv",
        "robot_a/collected_data_motor_2_550.csv",
    }


def test_the_real_speed_limit_is_a_tenth_below_the_data_sheet(robot_a):
    first = {parameter.name: parameter for parameter in robot_a[0][0].parameters}
    limit = first["speed limit"]
    assert limit.identified
    # Straight through the readings half way of the step of 500 counts: 1030 counts/s.
    assert limit.low - 5 * COUNT < 1030 * COUNT < limit.high + 5 * COUNT
    assert 0.85 < limit.value / np.deg2rad(272.0) < 0.95


def test_real_loops_are_half_as_fast_as_the_published_ones(robot_a, armpi):
    for fit, motor in zip(robot_a[0], armpi.motors, strict=True):
        gain = next(p for p in fit.parameters if p.name == "loop gain I")
        assert gain.identified
        assert gain.high < 0.7 * motor.loop.I
