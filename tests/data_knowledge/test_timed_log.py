from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.polyline import resolution, simplify, simplify_motors
from failuretwin.core.runs import STEP_S
from failuretwin.data_knowledge.readers.timed_log import (
    Samples,
    Targets,
    TimedLog,
    as_told,
    timed_run,
)

AT = np.arange(0.0, 6.0, 0.1)


def minimum_jerk(time, begin, duration, travel):
    s = np.clip((time - begin) / duration, 0.0, 1.0)
    return travel * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def log_of(twin, command, at=AT):
    return TimedLog("log", Samples(at, command), Samples(at, twin.path(command)))


def test_a_smooth_command_is_one_movement_from_rest_to_rest(armpi, twin):
    angle = minimum_jerk(AT, 0.5, 1.5, 0.8) + minimum_jerk(AT, 3.0, 1.5, -0.5)
    command = np.outer(angle, [1.0, 0.5, -0.5, 0.2])

    run = timed_run(log_of(twin, command), armpi)
    found = find_movements(run.command, run.time)

    assert found.start.shape[1] == 2
    np.testing.assert_allclose(found.start[0], [0.5, 3.0], atol=0.25)
    np.testing.assert_allclose(found.target[0, :, 0], [0.8, 0.3], atol=0.01)


@pytest.mark.parametrize("quantum", [np.deg2rad(1.0), np.deg2rad(0.1), 1e-5])
def test_rounded_commands_keep_their_movements(armpi, twin, quantum):
    time = np.arange(0.0, 6.0, 0.02)
    angle = np.interp(time, [0.5, 1.3, 3.0, 4.0], [0.0, 0.9, 0.9, -0.3])
    command = np.outer(np.rint(angle / quantum) * quantum, [1.0, 0.0, 0.0, 0.0])

    run = timed_run(log_of(twin, command, time), armpi)
    found = find_movements(run.command, run.time)

    assert found.start.shape[1] == 2
    np.testing.assert_allclose(found.start[0], [0.5, 3.0], atol=0.05)


@pytest.mark.parametrize("quantum_deg", [0.5, 1.0, 2.0])
def test_stairs_of_all_motors_are_the_movements_that_were_rounded(armpi, twin, quantum_deg):
    """Motors that take differently long, some by a step or two: no step is a movement."""
    rng, quantum = np.random.default_rng(3), np.deg2rad(quantum_deg)
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    target = rng.uniform(low, high, (1, 6, 4))
    target[0, 2, 0] = target[0, 1, 0] + 1.2 * quantum
    ramp = rng.choice([0.6, 0.8, 1.0], target.shape)
    told = Movements(np.zeros((1, 4)), target, ramp, 0.1 + 2.04 * np.arange(6.0)[None])
    time = np.arange(0.0, 12.5, 0.02)
    command = np.rint(told.reference(time)[0] / quantum) * quantum

    run = timed_run(log_of(twin, command, time), armpi)
    found = find_movements(run.command, run.time)

    assert found.start.shape[1] == 6
    np.testing.assert_allclose(found.start, told.start, atol=0.05)
    np.testing.assert_allclose(found.target, target, atol=0.51 * quantum)


@pytest.mark.parametrize("step_s", [0.02, 0.25])
@pytest.mark.parametrize("jumps", [True, False])
def test_a_motor_that_pans_while_others_go_keeps_their_movements(step_s, jumps):
    """No time at which all rest for long: each motor is what it is by itself, jumps or ramps."""
    time, rng = np.arange(0.0, 20.0, step_s), np.random.default_rng(0)
    targets = rng.uniform(-1.0, 1.0, (10, 3))
    first = np.repeat(2.0 * np.arange(10), 2) + np.tile([0.0, 1e-9 if jumps else 1.0], 10)
    levels = [np.repeat(np.append(0.0, column), 2)[1:-1] for column in targets.T]
    pan = 0.5 * np.abs(np.mod(time / 7.0, 2.0) - 1.0)
    command = np.stack([pan, *(np.interp(time, first, v) for v in levels)], axis=-1)
    command = np.rint(command / np.deg2rad(1.0)) * np.deg2rad(1.0)
    together = simplify_motors(time, command, 2e-3)
    for (at, values), column in zip(together, command.T, strict=True):
        assert np.abs(np.interp(time, at, values) - column).max() < np.deg2rad(3.0)


def test_stairs_of_a_slow_ramp_are_not_taken_for_rests():
    """Nothing becomes worse than each motor by itself."""
    time = np.arange(0.0, 24.0, 0.02)
    angle = np.interp(time, [1.0, 21.0], [0.0, 0.7])
    command = np.rint(np.outer(angle, [1.0, -0.5, 0.2, 0.0]) / 0.0175) * 0.0175
    together = simplify_motors(time, command, 2e-3)
    for line, column in zip(together, command.T, strict=True):
        np.testing.assert_array_equal(line, simplify(time, column, 2e-3))


def test_the_quantum_of_rounded_values_is_found():
    smooth = np.sin(np.linspace(0.0, 3.0, 200))

    assert resolution(np.rint(smooth / 0.01) * 0.01) == pytest.approx(0.01)
    assert resolution(smooth) == 0.0
    assert resolution(np.repeat([0.0, 1.0], 50)) == 0.0


def test_few_lines_stay_near_the_samples():
    time = np.linspace(0.0, 3.0, 300)
    value = np.sin(time) + np.random.default_rng(0).normal(0.0, 1e-4, 300)

    corner_time, corner_value = simplify(time, value, 2e-3)

    assert len(corner_time) < 40
    assert np.abs(np.interp(time, corner_time, corner_value) - value).max() < 6e-3


@pytest.mark.parametrize("step", [1e-4, 1e-3, 3.5e-3])
@pytest.mark.parametrize("digits", [9, 6])
def test_small_steps_between_rests_are_movements(armpi, twin, step, digits):
    """A motor told to go on by less than a quarter of a degree is off by nothing afterwards."""
    time = np.arange(0.0, 9.0, 0.1)
    angle = np.interp(time, [2.0, 3.0, 5.0, 6.0], [0.5, 0.5 + step, 0.5 + step, 0.5 - step])
    other = np.interp(time, [2.0, 3.0, 5.0, 6.0], [0.0, 0.7, 0.7, 0.2])
    command = np.round(np.stack([angle, other, other, other], axis=1), digits)

    run = timed_run(log_of(twin, command, time), armpi)
    found = find_movements(run.command, run.time)

    assert found.start.shape[1] == 2
    expected = [[0.5 + step, 0.7], [0.5 - step, 0.2]]
    np.testing.assert_allclose(found.target[0, :, :2], expected, atol=1.1 * 10.0**-digits)


def test_rests_of_a_smooth_command_are_where_they_were_told_to_be(armpi, twin):
    time = np.arange(0.0, 6.0, 0.02)
    angle = minimum_jerk(time, 0.5, 1.5, 0.8) + minimum_jerk(time, 3.0, 1.5, -0.5)

    run = timed_run(log_of(twin, np.outer(angle, [1.0, 0.5, -0.5, 0.2]), time), armpi)
    found = find_movements(run.command, run.time)

    np.testing.assert_allclose(found.target[0, :, 0], [0.8, 0.3], atol=2e-5)


def test_even_times_become_the_grid(armpi, twin):
    time = np.arange(1000) * (10 / 999)
    command = np.zeros((1000, 4))

    run = timed_run(log_of(twin, command, time), armpi)

    np.testing.assert_allclose(run.time, time, atol=1e-9)
    np.testing.assert_array_equal(run.measured[0], twin.path(command))


def test_of_rows_with_the_same_time_the_last_one_counts(armpi, twin):
    at = np.array([0.0, 0.1, 0.1, 0.2])
    log = TimedLog("log", Samples(at, np.zeros((4, 4))), Samples(at, np.diag([1, 2, 3, 4])[:, :3]))

    run = timed_run(log, armpi)

    assert run.measured[0, 10].tolist() == [0.0, 0.0, 3.0]


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (TimedLog("a", Samples(AT, np.zeros((60, 4)))), "neither a tool path nor motor readings"),
        (
            TimedLog("b", Samples(AT, np.full((60, 4), np.nan)), Samples(AT, np.zeros((60, 3)))),
            "motor 1 has 0 commands, expected 2 or more",
        ),
        (
            TimedLog("c", Samples(AT[::-1], np.zeros((60, 4))), Samples(AT, np.zeros((60, 3)))),
            "time runs backwards after 5.900 s",
        ),
        (
            TimedLog("d", Samples(AT, np.zeros((60, 4))), Samples(AT[:1], np.zeros((1, 3)))),
            "fewer than two readings of the tool",
        ),
        (
            TimedLog(
                "e",
                Targets(np.zeros(1), np.full((1, 4), np.nan), np.ones((1, 4))),
                Samples(AT, np.zeros((60, 3))),
            ),
            "motor 1 has 0 commands, expected 1 or more",
        ),
    ],
)
def test_a_log_that_says_too_little_is_refused(armpi, log, words):
    with pytest.raises(InputError, match=words):
        timed_run(log, armpi)


@pytest.mark.parametrize(("step_s", "fits"), [(1.9, True), (10.0, False)])
def test_milliseconds_taken_for_seconds_make_no_grid_of_a_million_samples(
    armpi, twin, step_s, fits
):
    time = step_s * np.arange(1100)  # 10 ms a row; as seconds, three hours
    angles = 0.1 * np.sin(0.01 * time)[:, None] * np.ones(4)
    log = log_of(twin, angles, time)
    if fits:
        assert len(timed_run(log, armpi).time) == pytest.approx(1.9 * 1099 / STEP_S, abs=2)
        return
    with pytest.raises(InputError, match=r"milliseconds may have been taken for seconds"):
        timed_run(log, armpi)


def streamed(rate_hz=10.0, seconds=6.0):
    """Set points of a curve that rests from 2 to 4 s: their times and values (sample, motor)."""
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    moved = np.where(time < 2.0, time, np.where(time < 4.0, 2.0, time - 2.0))
    return time, np.stack([np.sin(moved), 0.5 * np.cos(1.3 * moved)], axis=1)


def written_faster(time, value, rate_hz=100.0):
    """The same as a log that repeats each until the next one comes."""
    fast = np.arange(0.0, time[-1] + 1e-9, 1.0 / rate_hz)
    return Samples(fast, value[np.searchsorted(time, fast + 1e-9, side="right") - 1])


@pytest.mark.parametrize("rate_hz", [4.0, 10.0, 30.0])
def test_set_points_that_are_written_more_often_than_told_are_no_stairs(rate_hz):
    time, value = streamed(rate_hz)
    told = as_told(written_faster(time, value))
    fast = np.arange(0.0, time[-1] - 1.0 / rate_hz, 0.01)
    for motor in range(2):
        wanted = np.interp(fast, time, value[:, motor])
        found = np.interp(fast, told.time, told.value[:, motor])
        assert np.abs(found - wanted).max() < 0.015  # a row late at most
    assert len(told.time) < 1.2 * len(time)


def test_commands_that_are_held_stay_steps():
    """Once a second, or as often as they are written."""
    seconds = np.repeat(np.arange(8.0), 100)[:, None]
    slow = Samples(0.01 * np.arange(800), seconds)
    dense = Samples(*streamed(100.0))
    assert as_told(slow) is slow
    assert as_told(dense) is dense
