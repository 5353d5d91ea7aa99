"""The magnitude in the truth is what a ruler finds in the motion, in the declared unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.registry import MODES

ENDS = np.arange(200, 1001, 200) - 1
"""Last samples of the five plateaus."""
TIME = np.arange(1000) * 0.01
BUILT_IN = tuple(MODES)


def held_angle(angle, healthy, command):
    return angle[:, -1]


def rms_of_settled_errors(angle, healthy, command):
    return np.sqrt(np.mean((angle - command)[:, ENDS] ** 2, axis=1))


def mean_settled_error(angle, healthy, command):
    return (angle - command)[:, ENDS].mean(axis=1)


def proportion(angle, healthy, command):
    return np.sum(angle * healthy, axis=1) / np.sum(healthy**2, axis=1) - 1.0


def slope(angle, healthy, command):
    return np.polyfit(TIME[100:], (angle - healthy)[:, 100:].T, 1)[0]


def time_behind(angle, healthy, command):
    """How long ago the healthy motor was here, in the middle of the first ramp."""
    return (healthy - angle)[:, 55] / ((healthy[:, 55] - healthy[:, 50]) / 0.05)


def width_between_directions(angle, healthy, command):
    """Twice the settled error; movements that turn back within the play settle nearer."""
    return 2.0 * np.abs(angle - command)[:, ENDS].max(axis=1)


def speed_lost(angle, healthy, command):
    return 1.0 - (angle[:, 50] - angle[:, 40]) / (healthy[:, 50] - healthy[:, 40])


def share_of_time_held(angle, healthy, command):
    return np.mean(np.diff(angle, axis=1) == 0.0, axis=1)


def error_per_sine(angle, healthy, command):
    ratio = np.sin(6.0 * command[:, ENDS])
    return np.sum((angle - command)[:, ENDS] * ratio, axis=1) / np.sum(ratio**2, axis=1)


RULERS = {
    "stuck": held_angle,
    "steady_state_error": rms_of_settled_errors,
    "slow": speed_lost,
    "lag": time_behind,
    "backlash": width_between_directions,
    "drift": slope,
    "intermittent": share_of_time_held,
    "encoder_bias": mean_settled_error,
    "encoder_scale": proportion,
    "bent_shaft": error_per_sine,
}
MEASURED_BELOW = {"torque_loss", "lost_commands"}


def at_once(mode):
    """Return the mode as a step at the start, or as it is where it has no steps."""
    if "step" not in mode.allowed_profiles:
        return replace(mode, onset_s=(0.0, 0.0))
    begin = 1.0 if mode.mode == "stuck" else 0.0  # at the very start all are at zero
    return replace(mode, profiles=("step",), onset_s=(begin, begin))


def test_every_mode_is_measured():
    assert set(BUILT_IN) | {"bent_shaft"} == set(RULERS) | MEASURED_BELOW


@pytest.mark.parametrize("name", RULERS)
def test_magnitude_is_what_the_ruler_says(name, runs_of, template):
    mode = template if name == template.mode else MODES[name]
    # Held is told from standing at a target only where the motor never stands.
    ramps = (1.0,) if name == "intermittent" else ()
    runs = runs_of(at_once(mode), count=20, ramps=ramps)
    healthy = runs_of(count=20, ramps=ramps)
    motions = (runs.position, healthy.position, runs.command)

    measured = RULERS[name](*(motion[..., 1] for motion in motions))

    np.testing.assert_allclose(measured, runs.truth.magnitude, rtol=0.01, atol=2e-3)
    assert np.ptp(runs.truth.magnitude) > 0.02


def test_a_weak_motor_sags_further(runs_of, sagging):
    rigid, healthy, weak = (
        runs_of(mode, imperfections=world, count=20)
        for mode, world in (
            (None, NO_IMPERFECTIONS),
            (None, sagging),
            (at_once(MODES["torque_loss"]), sagging),
        )
    )
    sag, further = ((runs.position - rigid.position)[:, ENDS, 1] for runs in (healthy, weak))
    factor = 1.0 / (1.0 - weak.truth.magnitude)
    # As the motor gives way, its load changes with the pose.
    np.testing.assert_allclose(further, sag * factor[:, None], rtol=0.35, atol=5e-3)
    assert np.abs(sag).max() > 0.03


def test_lost_commands_are_those_of_the_truth(runs_of):
    mode = replace(at_once(MODES["lost_commands"]), magnitude=(0.4, 0.4))
    runs = runs_of(mode, count=200)
    settled = runs.position[:, ENDS, 1]
    moved = np.abs(np.diff(settled, axis=1, prepend=0.0))
    lost = np.array([detail["faults"][0]["lost"] for detail in runs.truth.detail])

    # Targets are drawn evenly over 100 degrees, so a few lie next to the one before.
    assert moved[lost].max() < 1e-4
    assert (moved[~lost] < 1e-4).mean() < 0.01
    assert stats.binomtest(int(lost.sum()), lost.size, 0.4).pvalue > 0.01
    assert (runs.truth.magnitude == 0.4).all()


def test_error_of_movements_that_were_not_struck_is_no_error(runs_of):
    late = replace(MODES["steady_state_error"], onset_s=(3.0, 3.0))
    runs = runs_of(late, count=10)
    error = (runs.position - runs.command)[:, ENDS, 1]
    offsets = [detail["faults"][0]["offset_rad"] for detail in runs.truth.detail]

    np.testing.assert_allclose(error, offsets, atol=1e-4)
    assert np.abs(error[:, :2]).max() < 1e-4
    rms = np.sqrt(np.mean(error[:, 2:] ** 2, axis=1))
    np.testing.assert_allclose(runs.truth.magnitude, rms, atol=1e-4)
