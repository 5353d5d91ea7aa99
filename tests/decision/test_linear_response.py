"""What runs say near one theta, to first order, against the same computed anew at another one."""

from __future__ import annotations

import numpy as np
import pytest
from shared_runs import FAULTS, scene, some_theta, whole


@pytest.fixture(scope="module")
def scenes(twin):
    return {name: scene(twin, name) for name in ("healthy", *FAULTS[:2])}


CAUSES = [("healthy", range(4)), ("motor_2:stuck", [1]), ("motor_3:steady_state_error", [2])]
"""Scenes and the motors that may explain them; for the others, residuals are too long."""


@pytest.mark.parametrize(("name", "motors"), CAUSES)
def test_at_its_own_theta_a_response_says_what_the_runs_say(scenes, name, motors):
    one, nowhere = scenes[name], np.zeros((2, 19))
    found, expected = one.response().whole_at(nowhere), whole(one, np.zeros(19))
    np.testing.assert_allclose(found.log_healthy, expected.log_healthy, atol=1e-9)
    for motor in motors:
        ours, theirs = found.profile(motor), expected.profile(motor)
        for part in ("mode", "precision", "expected", "faulty_baseline"):
            np.testing.assert_allclose(getattr(ours, part), getattr(theirs, part), atol=1e-9)
        np.testing.assert_allclose(ours.log_weight, theirs.log_weight, atol=0.06)
        np.testing.assert_allclose(ours.min_distance2, theirs.min_distance2, atol=0.02)


@pytest.mark.parametrize(("name", "motors"), CAUSES)
def test_near_it_first_order_is_what_a_computation_anew_gives(scenes, name, motors):
    """A motor that is off sags where it really is; where it would be if healthy tells little."""
    one, step = scenes[name], some_theta(1, 0.02)
    response = one.response()
    near = response.whole_at(np.tile(step, (2, 1)))
    here, there = response.whole_at(np.zeros((2, 19))), whole(one, step)

    def close(ours, theirs, before, share=0.05):
        change, off = np.abs(theirs - before), np.abs(ours - theirs)
        assert change.max() > 0.0
        assert off.mean() < share * change.mean()
        assert off.max() < 2.0 * share * change.max()

    close(near.log_healthy, there.log_healthy, here.log_healthy)
    for motor in motors:
        profiles = [each.profile(motor) for each in (near, there, here)]
        width = np.sqrt(profiles[0].precision)  # where the lever is short, the mode says little
        close(*(width * profile.mode for profile in profiles))
        if name == "healthy":
            close(*(profile.expected for profile in profiles))
        else:  # it sags a little less as theta moves where it is
            close(*(profile.faulty_baseline for profile in profiles), share=0.2)
        close(*(profile.min_distance2 for profile in profiles))


def test_some_of_the_runs_say_what_they_say_among_others(scenes):
    one, step = scenes["motor_2:stuck"], np.array([some_theta(2, 0.05), some_theta(3, 0.05)])
    response = one.response()
    both = response.at(step, (1,))
    second = response[np.array([1])].at(step[1:], (1,))
    np.testing.assert_array_equal(second.log_healthy[0], both.log_healthy[1])
    np.testing.assert_array_equal(second.profile(1).mode[0], both.profile(1).mode[1])
