from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements, find_movements

SAME_REFERENCE_RAD = 1e-9


@dataclass(frozen=True)
class Schedule:
    movements: Movements
    time: np.ndarray


@st.composite
def schedules(draw) -> Schedule:
    """Runs of movements with plateaus between them; starts and ramp ends lie anywhere on the grid.

    Times are whole thousandths of a step, so that no ramp begins a rounding error before a sample.
    """
    step = draw(st.sampled_from([0.01, 10 / 999, 0.05]))
    motors = draw(st.integers(1, 4))
    runs = [_draw_run(draw, motors) for _ in range(draw(st.integers(1, 3)))]
    movements = _stack(runs, step)
    samples = int(np.nan_to_num(movements.start).max(initial=0) / step) + 100
    return Schedule(movements, np.arange(samples) * step)


def _draw_run(draw, motors):
    """Draw (initial, [(start, ramps, targets), ...]) with times in steps."""
    angles = st.integers(-140, 140)
    initial = here = [draw(angles) for _ in range(motors)]
    start, movements = 0, []
    for _ in range(draw(st.integers(0, 5))):
        start += draw(st.integers(0, 20_000)) + (0 if not movements else 53_000)
        mover = draw(st.integers(0, motors - 1))
        target = [draw(angles) if draw(st.booleans()) else angle for angle in here]
        target[mover] = draw(angles.filter(lambda x, at=here[mover]: x != at))
        ramps = [draw(st.integers(3_000, 50_000)) for _ in range(motors)]
        movements.append((start, ramps, target))
        here = target
    return initial, movements


def _stack(runs, step):
    count, motors = max(len(movements) for _, movements in runs), len(runs[0][0])
    start = np.full((len(runs), count), np.nan)
    ramp, target = np.full((2, len(runs), count, motors), np.nan)
    for run, (_, movements) in enumerate(runs):
        for m, movement in enumerate(movements):
            start[run, m], ramp[run, m], target[run, m] = movement
    initial = np.array([initial for initial, _ in runs]) / 100
    scale = step / 1000
    return Movements(initial, target / 100, ramp * scale, start * scale)


@given(schedules())
def test_found_movements_ask_for_the_same_reference(schedule):
    command = schedule.movements.reference(schedule.time)

    found = find_movements(command, schedule.time)

    np.testing.assert_allclose(
        found.reference(schedule.time), command, rtol=0, atol=SAME_REFERENCE_RAD
    )


@given(schedules())
def test_found_movements_are_those_that_were_asked_for(schedule):
    asked = schedule.movements
    found = find_movements(asked.reference(schedule.time), schedule.time)
    moves = np.abs(asked.target - asked.origin()) > 1e-9

    np.testing.assert_allclose(found.start, asked.start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.target, asked.target, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.initial, asked.initial)
    np.testing.assert_allclose(found.ramp_duration[moves], asked.ramp_duration[moves], atol=1e-9)
    assert (found.ramp_duration[asked.exists[..., None] & ~moves] == 0).all()


def test_every_published_reference_is_five_movements(simulink):
    command, time = simulink["commands_rad"], simulink["t"]

    found = find_movements(command, time)

    assert found.exists.all(axis=1).tolist() == [True] * 90
    assert found.target.shape == (90, 5, 5)
    np.testing.assert_allclose(found.reference(time), command, rtol=0, atol=SAME_REFERENCE_RAD)


def test_shorter_runs_are_padded_with_nan_at_the_end():
    time = np.arange(500) * 0.01
    command = np.zeros((2, 500, 1))
    command[0, :, 0] = np.interp(time, [0.5, 1.0, 2.5, 3.5], [0.0, 0.4, 0.4, -0.2])
    command[1, :, 0] = np.interp(time, [1.0, 2.0], [0.0, 0.3])

    found = find_movements(command, time)

    np.testing.assert_array_equal(found.exists, [[True, True], [True, False]])
    np.testing.assert_allclose(found.start, [[0.5, 2.5], [1.0, np.nan]], atol=1e-9)
    np.testing.assert_allclose(found.target[..., 0], [[0.4, -0.2], [0.3, np.nan]], atol=1e-12)
    np.testing.assert_allclose(found.ramp_duration[..., 0], [[0.5, 1.0], [1.0, np.nan]], atol=1e-9)
    np.testing.assert_allclose(found.reference(time), command, rtol=0, atol=SAME_REFERENCE_RAD)


def test_a_held_command_has_no_movements():
    time = np.arange(50) * 0.1
    command = np.broadcast_to([0.3, -0.2], (3, 50, 2))

    found = find_movements(command, time)

    assert found.start.shape == (3, 0)
    assert found.target.shape == (3, 0, 2)
    np.testing.assert_array_equal(found.initial, [[0.3, -0.2]] * 3)
    np.testing.assert_array_equal(found.reference(time), command)


def test_one_held_run_among_others_keeps_its_command():
    time = np.arange(200) * 0.01
    command = np.zeros((2, 200, 1))
    command[0, :, 0] = np.interp(time, [0.5, 1.0], [0.0, 0.4])
    command[1] = 0.7

    found = find_movements(command, time)

    np.testing.assert_array_equal(found.exists, [[True], [False]])
    np.testing.assert_allclose(found.reference(time), command, rtol=0, atol=SAME_REFERENCE_RAD)


def interrupted_ramp(next_start):
    """Motor 1 is on its way from 0 to 1 in 2 s when it is called back; motor 2 sets out anew."""
    return Movements(
        initial=np.zeros((1, 2)),
        target=np.array([[[1.0, 0.2], [0.0, -0.3]]]),
        ramp_duration=np.array([[[2.0, 0.5], [1.0, 0.5]]]),
        start=np.array([[0.5, next_start]]),
    )


@pytest.mark.parametrize(("next_start", "reached"), [(1.5, 0.5), (0.7, 0.1), (3.0, 1.0)])
def test_a_ramp_ends_where_the_next_movement_interrupts_it(next_start, reached):
    movements = interrupted_ramp(next_start)

    assert movements.origin()[0, 1, 0] == pytest.approx(reached)
    at = np.array([next_start - 0.1, next_start, next_start + 0.5, next_start + 1.0])
    path = movements.reference(at)[0, :, 0]
    before = min(reached, (next_start - 0.6) / 2)
    np.testing.assert_allclose(path, [before, reached, reached / 2, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    "next_start",
    [1.5, 1.503],
)
def test_a_ramp_interrupted_while_another_motor_sets_out_is_found(next_start):
    time = np.arange(400) * 0.01
    command = interrupted_ramp(next_start).reference(time)

    found = find_movements(command, time)

    assert found.start[0] == pytest.approx([0.5, next_start])
    np.testing.assert_allclose(found.reference(time), command, rtol=0, atol=SAME_REFERENCE_RAD)


def test_a_ramp_turned_back_on_the_spot_is_found():
    time = np.arange(400) * 0.01
    command = np.interp(time, [0.5, 1.5, 2.5], [0.0, 1.0, 0.2])[None, :, None]

    found = find_movements(command, time)

    assert found.start[0] == pytest.approx([0.5, 1.5])
    np.testing.assert_allclose(found.reference(time), command, rtol=0, atol=SAME_REFERENCE_RAD)


def test_motors_served_one_after_another_move_together():
    time = np.arange(400) * 0.01
    first = np.interp(time, [0.5, 1.5], [0.0, 1.0])
    second = np.interp(time, [0.58, 1.08], [0.0, -0.4])

    found = find_movements(np.stack([first, second], axis=-1)[None], time)

    np.testing.assert_allclose(found.start, [[0.5]], atol=1e-9)
    np.testing.assert_allclose(found.target, [[[1.0, -0.4]]], atol=1e-12)
    np.testing.assert_allclose(found.ramp_duration, [[[1.0, 0.5]]], atol=1e-9)


def test_motors_far_apart_make_movements_of_their_own():
    time = np.arange(400) * 0.01
    first = np.interp(time, [0.5, 0.8], [0.0, 1.0])
    second = np.interp(time, [1.0, 1.5], [0.0, -0.4])

    found = find_movements(np.stack([first, second], axis=-1)[None], time)

    np.testing.assert_allclose(found.start, [[0.5, 1.0]], atol=1e-9)
    np.testing.assert_allclose(found.target, [[[1.0, 0.0], [1.0, -0.4]]], atol=1e-12)
    np.testing.assert_allclose(found.ramp_duration, [[[0.3, 0.0], [0.0, 0.5]]], atol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_that_is_not_finite_is_refused(value):
    command = np.zeros((1, 10, 1))
    command[0, 5] = value
    with pytest.raises(InputError, match=r"not finite.*hold the last command"):
        find_movements(command, np.arange(10) * 0.1)


# References that a hand guides.


def guided(stops, seed=0):
    """Return a wandering reference of two motors at 30 Hz with stops, and its times [s].

    It wanders for 2 s before each stop; stops are their lengths [s].
    """
    rng, parts, here = np.random.default_rng(seed), [np.zeros((15, 2))], np.zeros(2)
    for stop in stops:
        steps = rng.normal(0.0, 0.03, (60, 2))
        way = here + np.cumsum(steps, axis=0)
        here = way[-1]
        parts += [way, np.repeat(here[None], round(30 * stop), axis=0)]
    command = np.concatenate(parts)
    return command, np.arange(len(command)) / 30.0


def test_what_a_hand_guides_is_one_movement_from_rest_to_rest():
    command, time = guided([1.0, 0.6, 1.0])

    found = find_movements(command[None], time)

    np.testing.assert_allclose(found.start[0], [0.467, 3.467, 6.067], atol=0.04)
    np.testing.assert_allclose(found.target[0], command[[80, 170, -1]], atol=1e-3)
    np.testing.assert_allclose(found.ramp_duration[0].max(axis=1), 2.0, atol=0.1)


def test_a_hand_that_halts_for_a_moment_is_not_at_rest():
    command, time = guided([0.15, 1.0])

    found = find_movements(command[None], time)

    assert found.start.shape == (1, 1)
    np.testing.assert_allclose(found.target[0, 0], command[-1], atol=1e-3)
