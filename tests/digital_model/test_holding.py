from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.digital_model.settling import hold

STEP = 0.01
LIMIT = np.array([1.5, 4.0])


def motion(runs=3, samples=300, seed=0):
    """Smooth free motions of two motors, (run, time, motor)."""
    rng = np.random.default_rng(seed)
    time = np.arange(samples) * STEP
    phase, rate = rng.uniform(0.5, 6.0, (2, runs, 1, 2))
    return np.sin(rate * time[:, None] + phase), time


def held_and_let_go(position, held, reach):
    """What `hold` does to one motor of one run, a sample at a time."""
    followed, behind = [position[0]], False
    for k in range(1, len(position)):
        here = followed[-1]
        if held[k] and held[k - 1]:
            behind = True
        elif behind:
            way = position[k] - here
            here = position[k] if abs(way) <= reach else here + np.sign(way) * reach
            behind = here != position[k]
        else:
            here = position[k]
        followed.append(here)
    return followed


def test_nothing_held_is_the_free_motion_itself():
    position, time = motion()
    assert hold(position, None, time, LIMIT) is position
    held = np.zeros(position.shape, dtype=bool)
    np.testing.assert_array_equal(hold(position, held, time, LIMIT), position)


@given(first=st.integers(0, 320), run=st.integers(0, 2), motor=st.integers(0, 1))
def test_held_to_the_end_is_frozen_bit_for_bit(first, run, motor):
    position, time = motion()
    held = np.zeros(position.shape, dtype=bool)
    held[run, first:, motor] = True

    followed = hold(position, held, time, LIMIT)

    expected = position.copy()
    expected[run, first:, motor] = position[run, min(first, 299), motor]
    np.testing.assert_array_equal(followed, expected)


@given(
    edges=st.lists(st.integers(0, 299), min_size=1, max_size=8, unique=True), seed=st.integers(0, 9)
)
def test_each_motor_is_held_and_let_go_as_a_plain_loop_does_it(edges, seed):
    position, time = motion(seed=seed)
    held = np.zeros(position.shape, dtype=bool)
    held[1, :, 0] = np.searchsorted(np.sort(edges), np.arange(300), side="right") % 2
    held[2, 40:90, 1] = True

    followed = hold(position, held, time, LIMIT)

    for run in range(3):
        for motor in range(2):
            plain = held_and_let_go(
                position[run, :, motor], held[run, :, motor], LIMIT[motor] * STEP
            )
            np.testing.assert_allclose(followed[run, :, motor], plain, atol=1e-12)


def test_a_motor_let_go_catches_up_at_its_speed_limit():
    """Held at 0.5 rad while the motion goes on to 2 rad: 1.5 rad at 1.5 rad/s take 1 s."""
    time = np.arange(400) * STEP
    position = np.minimum(time, 2.0)[None, :, None]
    held = ((time >= 0.5 - 1e-9) & (time < 2.5 - 1e-9))[None, :, None]

    angle = hold(position, held, time, LIMIT[:1])[0, :, 0]

    assert angle[50:250] == pytest.approx(0.5)
    expected = np.minimum(0.5 + 1.5 * (time[250:] - 2.49), 2.0)
    np.testing.assert_allclose(angle[250:], expected, atol=1e-9)


def test_nothing_given_is_changed():
    position, time = motion()
    held = np.zeros(position.shape, dtype=bool)
    held[:, 50:100] = True
    before = position.copy(), held.copy()
    hold(position, held, time, LIMIT)
    np.testing.assert_array_equal(position, before[0])
    np.testing.assert_array_equal(held, before[1])
