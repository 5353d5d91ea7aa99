from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from failuretwin.core.errors import InputError
from failuretwin.digital_model.servo import ServoLoop, respond

SAME_RESPONSE_RAD = 1e-6
FREEZE = 49
"""Published stuck responses are constant from this 0-based sample on."""

LOOPS = (
    ServoLoop(0.2957, 40.577, 0.01),
    ServoLoop(0.1953, 34.977, 0.01),
    ServoLoop(0.5, 5.0, 0.03),
)
commands = arrays(
    np.float64, st.tuples(st.integers(2, 30), st.just(3)), elements=st.floats(-2.0, 2.0)
)
steps = st.sampled_from([0.002, 10 / 999, 0.05, 0.3])


def rms(difference):
    return np.sqrt(np.mean(difference**2, axis=0))


@pytest.mark.parametrize("label", range(5))
def test_published_responses_come_out_one_sample_later(twin, simulink, label):
    runs = simulink["label"] == label
    assert runs.sum() == 10
    command, published = (simulink[n][runs][..., :4] for n in ("commands_rad", "responses_rad"))

    ours = twin.respond(command, simulink["t"])[:, 1:]

    for mine, theirs in zip(ours, published[:, :-1], strict=True):
        for motor in range(4):
            valid = slice(FREEZE + 1) if motor + 1 == label else slice(None)
            assert rms(mine[valid, motor] - theirs[valid, motor]) < SAME_RESPONSE_RAD


def test_published_time_bases_are_one_sample_apart(simulink):
    np.testing.assert_allclose(simulink["t_response"][:-1], simulink["t"][1:], atol=1e-12)


def test_published_paths_are_the_kinematics_of_the_angles(twin, simulink):
    for angles, path in (("commands_rad", "desired_m"), ("responses_rad", "realized_m")):
        np.testing.assert_allclose(
            twin.path(simulink[angles][..., :4]), simulink[path], rtol=0, atol=1e-9
        )


@given(command=commands, step=steps)
def test_a_grid_twice_as_fine_gives_the_same_angles(command, step):
    coarse = np.arange(len(command))
    fine = np.arange(2 * len(command) - 1) / 2
    drawn_out = np.stack([np.interp(fine, coarse, column) for column in command.T], axis=-1)

    np.testing.assert_allclose(
        respond(LOOPS, drawn_out, step / 2)[::2], respond(LOOPS, command, step), rtol=0, atol=1e-9
    )


@given(command=commands, step=steps, shift=st.floats(-2.0, 2.0), factor=st.floats(-2.0, 2.0))
def test_loops_are_linear_and_know_no_zero(command, step, shift, factor):
    np.testing.assert_allclose(
        respond(LOOPS, factor * command + shift, step),
        factor * respond(LOOPS, command, step) + shift,
        rtol=0,
        atol=1e-9,
    )


def test_motors_reach_a_constant_target(twin):
    time = np.arange(500) * 0.01
    command = np.where(time[:, None] < 1.0, 0.2, -0.7) * np.ones(4)
    np.testing.assert_allclose(twin.respond(command, time)[-1], -0.7, rtol=0, atol=1e-12)


def test_rest_stays_at_rest(twin):
    time = np.arange(200) * 0.01
    command = np.broadcast_to([0.3, -0.2, 0.1, 1.0], (200, 4))
    np.testing.assert_array_equal(twin.respond(command, time), command)


def test_on_a_long_ramp_motors_run_late_by_one_over_their_integral_gain(twin, armpi):
    time = np.arange(500) * 0.01
    speed = np.array([0.5, -0.4, 0.3, 0.2])
    command = time[:, None] * speed

    lag = (command - twin.respond(command, time))[-1]

    gains = np.array([motor.loop.I for motor in armpi.motors])
    np.testing.assert_allclose(lag, speed / gains, rtol=1e-9)


def test_many_runs_give_what_each_gives_alone(twin):
    time = np.arange(100) * 0.01
    command = np.random.default_rng(1).normal(size=(2, 3, 100, 4)).cumsum(axis=-2) * 0.01
    together = twin.respond(command, time)

    assert together.shape == command.shape
    for row in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[row], twin.respond(command[row], time))


def test_commands_stay_as_they_were(twin):
    command = np.random.default_rng(2).normal(size=(100, 4))
    before = command.copy()
    twin.respond(command, np.arange(100) * 0.01)
    np.testing.assert_array_equal(command, before)


@pytest.mark.parametrize("time", [[0.0, 0.1, 0.3], [0.0, 0.1, 0.1], [0.0, -0.1, -0.2], [0.0]])
def test_grid_must_be_uniform(twin, time):
    with pytest.raises(InputError, match="not a uniform, increasing grid"):
        twin.respond(np.zeros((len(time), 4)), time)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((10, 3), "expected (..., time, 4 motors)"),
        ((9, 4), "expected (..., 10 times, motor)"),
        ((10,), "expected (..., 10 times, motor)"),
    ],
)
def test_wrong_shape_says_what_is_expected(twin, shape, expected):
    with pytest.raises(InputError) as error:
        twin.respond(np.zeros(shape), np.arange(10) * 0.1)
    assert str(error.value) == f"`command` has shape {shape}, {expected}."
